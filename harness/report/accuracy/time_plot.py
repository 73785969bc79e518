# pyright: reportUnknownMemberType=false
# Matplotlib's stubs do not type most keywords.
"""Time to each accuracy for every solver on a mesh.

Panels show the time of the step only, and with set-up amortised over many steps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import inf
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedFormatter, FixedLocator, NullLocator
from numpy.typing import NDArray

from harness.report.accuracy.convergence import GUESSES
from harness.report.accuracy.measured import Curve, Measurements, Problem, older
from harness.report.accuracy.sheet import (
    LEFT,
    RIGHT,
    TOP,
    files,
    foot,
    legend,
    limits,
    line,
    log_axis,
    mark,
    notes,
    panel,
    sheet,
)
from harness.report.accuracy.times import STEPS, TARGETS, askable, crossings, left_out, power, seconds_to
from harness.report.page import count, text
from harness.report.style import INK, OLDER, Mark, looks

_COLUMNS = {None: "the step alone", **{n: f"set-up over {count(n)} step{'s' if n > 1 else ''}" for n in STEPS}}


def draw_times(table: Measurements, folder: Path) -> list[Path]:
    """Draw a picture for each mesh, and return the files.

    Only problems with a certified minimum are included.
    """
    drawn: list[Path] = []
    marked = looks((curve.label, curve.solver) for curve in table.curves)
    for mesh in dict.fromkeys(problem.mesh for problem in table.problems):
        sure = [curve for curve in table.curves if curve.problem.mesh == mesh and not curve.problem.doubt]
        if sure:
            stem = folder / mesh.replace(" ", "-")
            doubtful = left_out(problem for problem in table.problems if problem.mesh == mesh)
            _draw(stem, mesh, sure, marked, doubtful, table.machine)
            drawn += files(stem)
    return drawn


_ALIKE = 2.0
"""Factor between times below which two panels would look alike."""


def differing(series: Mapping[str, Mapping[str, Sequence[Curve]]]) -> tuple[dict[int | None, str], str]:
    """Select the columns in which some time differs from the previously shown one.

    Args:
        series: curves by initial guess, then by label.
    Returns: the columns by number of steps, and a sentence about the others.
    """
    groups = [curves for group in series.values() for curves in group.values()]

    def found(steps: int | None) -> NDArray[np.float64]:
        return np.array([middle(curves, target, steps) for curves in groups for target in TARGETS])

    # From many steps to few: set-up contributes least where it is amortised over most steps.
    kept, last, alike = [None], found(None), list[int]()
    for steps in sorted(STEPS, reverse=True):
        times = found(steps)
        both = np.isfinite(times) & np.isfinite(last) & (last > 0.0)
        if (times[both] > _ALIKE * last[both]).any():
            kept, last = [*kept, steps], times
        else:
            alike.append(steps)
    listed = ", ".join(count(steps) for steps in sorted(alike))
    same = f"Not shown, as no time doubles: set-up over {listed} step{'s' if alike != [1] else ''}" if alike else ""
    return {steps: _COLUMNS[steps] for steps in kept}, same


def middle(curves: Sequence[Curve], target: float, steps: int | None = None) -> float:
    """Return the median time over a solver's solvable problems [s].

    It is infinite if half of them are unsolved.
    """
    times = [seconds_to(curve, target, steps) for curve in curves if askable(curve.problem, target)]
    # The upper of the two middle values: a mean with infinity would hide the solved half.
    return sorted(times)[len(times) // 2] if times else np.nan


def _draw(
    stem: Path,
    mesh: str,
    curves: list[Curve],
    marked: dict[str, Mark],
    doubtful: Sequence[str],
    machine: Sequence[str],
) -> None:
    problems: list[Problem] = list({curve.problem.digest: curve.problem for curve in curves}.values())
    over = f"median over {len(problems)} steps" if len(problems) > 1 else problems[0].name
    guesses = [guess for guess in GUESSES if any(curve.first_guess == guess for curve in curves)]
    series = {
        guess: {
            label: [curve for curve in curves if (curve.label, curve.first_guess) == (label, guess)]
            for label in marked
            if any((curve.label, curve.first_guess) == (label, guess) for curve in curves)
        }
        for guess in guesses
    }
    words = [*_words(curves, guesses), *doubtful]
    times = [middle(c, t, n) for group in series.values() for c in group.values() for t in TARGETS for n in _COLUMNS]
    low, high = limits([*times, *(curve.warm for curve in curves)])
    facts = [f"{count(problems[0].vertices)} vertices", over, "gap of the energy", *machine]
    shown, same = differing(series)
    words += [same] if same else []
    words += [OLDER] if any(map(older, curves)) else []
    with sheet(stem, f"Time to accuracy: {mesh}", facts) as page:
        width, gap = (RIGHT - LEFT - 62) / len(shown) - 16, 84
        height = (foot(words) - TOP - len(guesses) * gap) / max(len(guesses), 1)
        for row, guess in enumerate(guesses):
            top = TOP + 42 + row * (height + gap)
            text(page, LEFT + 62, top - 32, GUESSES[guess], size=11, weight="bold")
            for column, (steps, name) in enumerate(shown.items()):
                ax = panel(page, LEFT + 62 + column * (width + 16), top, width, height, name)
                _panel(ax, series[guess], marked, steps, (low, high * (high / low) ** 0.12))
                if column:
                    ax.tick_params(labelleft=False)
        used = {curve.label for curve in curves}
        cross = Line2D([], [], color=INK, marker="x", linestyle="", markersize=7, markeredgewidth=2)
        legend(page, {k: m for k, m in marked.items() if k in used}, below=[(cross, "no longer reached")])
        notes(page, words)


def _panel(
    ax: Axes, series: dict[str, list[Curve]], marked: dict[str, Mark], steps: int | None, span: tuple[float, float]
) -> None:
    """Draw times to all accuracies.

    A cross at the upper edge marks the first accuracy that a solver fails to reach.
    """
    ticks = [power(target) for target in TARGETS]
    taken: dict[int, int] = {}
    for label, curves in series.items():
        look = marked[label]
        times = np.array([middle(curves, target, steps) for target in TARGETS])
        seen, hollow = np.where((times > 0) & np.isfinite(times), times, np.nan), any(map(older, curves))
        line(ax, np.arange(len(TARGETS)), seen, look, spaced=False, older=hollow)
        failed = np.flatnonzero(times == inf)
        if len(failed):
            at = int(failed[0])
            place = taken[at] = taken.get(at, -1) + 1
            x, y = at - 0.3 + 0.15 * (place % 5), 0.975 - 0.04 * (place // 5)
            ax.plot(x, y, "x", color=look.color, transform=ax.get_xaxis_transform(), markersize=6, markeredgewidth=1.8)
        if steps is None:
            warm = np.median([curve.warm for curve in curves])
            ax.plot(-1, warm, look.marker, markersize=5, **mark(look, hollow=hollow))
    log_axis(ax.yaxis, *span, unit="time")
    first = -1 if steps is None else 0
    ax.set_xlim(first - 0.4, len(TARGETS) - 0.6)
    ax.xaxis.set_major_locator(FixedLocator(range(first, len(TARGETS))))
    ax.xaxis.set_major_formatter(FixedFormatter((["set-up"] if steps is None else []) + ticks))
    ax.xaxis.set_minor_locator(NullLocator())
    if steps is None:
        ax.axvline(-0.5, color=INK, linewidth=0.6, alpha=0.4)


def _words(curves: Sequence[Curve], guesses: Sequence[str]) -> list[str]:
    """Describe the crossings on the last snapshot, the hardest step, from each initial guess."""
    words: list[str] = []
    for guess in guesses:
        race = [curve for curve in curves if curve.problem is curves[-1].problem and curve.first_guess == guess]
        sentences = crossings(race)
        if sentences:
            words.append(f"{curves[-1].problem.moment}, {GUESSES[guess]}: {'; '.join(sentences)}")
    return words
