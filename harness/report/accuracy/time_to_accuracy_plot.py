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
from springbench.harness.report.accuracy.accuracy_data import AccuracyData, ConvergenceCurve, SnapshotProblem, is_stale
from springbench.harness.report.accuracy.convergence_plot import INITIAL_GUESS_LABELS
from springbench.harness.report.accuracy.plot_sheet import (
    PANEL_LEFT,
    PANEL_RIGHT,
    PANEL_TOP,
    add_panel,
    draw_legend,
    draw_line,
    draw_notes,
    format_log_axis,
    log_limits,
    notes_top,
    plot_sheet,
    sheet_marker_style,
    sheet_paths,
)
from springbench.harness.report.accuracy.time_to_accuracy import (
    AMORTISATION_STEPS,
    GAP_TARGETS,
    amortised_seconds,
    describe_crossings,
    describe_excluded_steps,
    format_gap,
    is_solvable,
)
from springbench.harness.report.number_format import format_count
from springbench.harness.report.page_layout import draw_text
from springbench.harness.report.plot_style import STALE_NOTE, TEXT_COLOUR, SeriesStyle, assign_label_styles

_COLUMN_TITLES = {
    None: "the step alone",
    **{n: f"set-up over {format_count(n)} step{'s' if n > 1 else ''}" for n in AMORTISATION_STEPS},
}


def draw_times_to_accuracy(table: AccuracyData, folder: Path) -> list[Path]:
    """Draw a picture for each mesh, and return the files.

    Only problems with a certified minimum are included.
    """
    drawn: list[Path] = []
    marked = assign_label_styles((curve.label, curve.solver) for curve in table.curves)
    for mesh in dict.fromkeys(problem.mesh_label for problem in table.problems):
        sure = [
            curve for curve in table.curves if curve.problem.mesh_label == mesh and not curve.problem.uncertified_reason
        ]
        if sure:
            stem = folder / mesh.replace(" ", "-")
            doubtful = describe_excluded_steps(problem for problem in table.problems if problem.mesh_label == mesh)
            _draw_mesh_times(stem, mesh, sure, marked, doubtful, table.machine_words)
            drawn += sheet_paths(stem)
    return drawn


_SIMILAR_RATIO = 2.0
"""Factor between times below which two panels would look alike."""


def distinct_columns(
    series: Mapping[str, Mapping[str, Sequence[ConvergenceCurve]]],
) -> tuple[dict[int | None, str], str]:
    """Select the columns in which some time differs from the previously shown one.

    Args:
        series: curves by initial guess, then by label.
    Returns: the columns by number of steps, and a sentence about the others.
    """
    groups = [curves for group in series.values() for curves in group.values()]

    def found(steps: int | None) -> NDArray[np.float64]:
        return np.array([median_time(curves, target, steps) for curves in groups for target in GAP_TARGETS])

    # From many steps to few: set-up contributes least where it is amortised over most steps.
    distinct, last, alike = [None], found(None), list[int]()
    for steps in sorted(AMORTISATION_STEPS, reverse=True):
        times = found(steps)
        both = np.isfinite(times) & np.isfinite(last) & (last > 0.0)
        if (times[both] > _SIMILAR_RATIO * last[both]).any():
            distinct, last = [*distinct, steps], times
        else:
            alike.append(steps)
    listed = ", ".join(format_count(steps) for steps in sorted(alike))
    same = f"Not shown, as no time doubles: set-up over {listed} step{'s' if alike != [1] else ''}" if alike else ""
    return {steps: _COLUMN_TITLES[steps] for steps in distinct}, same


def median_time(curves: Sequence[ConvergenceCurve], target: float, steps: int | None = None) -> float:
    """Return the median time over a solver's solvable problems [s].

    It is infinite if half of them are unsolved.
    """
    times = [amortised_seconds(curve, target, steps) for curve in curves if is_solvable(curve.problem, target)]
    # The upper of the two middle values: a mean with infinity would hide the solved half.
    return sorted(times)[len(times) // 2] if times else np.nan


def _draw_mesh_times(
    stem: Path,
    mesh: str,
    curves: list[ConvergenceCurve],
    styles: dict[str, SeriesStyle],
    doubtful: Sequence[str],
    machine: Sequence[str],
) -> None:
    problems: list[SnapshotProblem] = list({curve.problem.problem_digest: curve.problem for curve in curves}.values())
    over = f"median over {len(problems)} steps" if len(problems) > 1 else problems[0].problem_label
    guesses = [guess for guess in INITIAL_GUESS_LABELS if any(curve.initial_guess == guess for curve in curves)]
    series = {
        guess: {
            label: [curve for curve in curves if (curve.label, curve.initial_guess) == (label, guess)]
            for label in styles
            if any((curve.label, curve.initial_guess) == (label, guess) for curve in curves)
        }
        for guess in guesses
    }
    words = [*_describe_crossings(curves, guesses), *doubtful]
    times = [
        median_time(c, t, n)
        for group in series.values()
        for c in group.values()
        for t in GAP_TARGETS
        for n in _COLUMN_TITLES
    ]
    low, high = log_limits([*times, *(curve.warm_seconds for curve in curves)])
    facts = [f"{format_count(problems[0].vertices)} vertices", over, "gap of the energy", *machine]
    shown, same = distinct_columns(series)
    words += [same] if same else []
    words += [STALE_NOTE] if any(map(is_stale, curves)) else []
    with plot_sheet(stem, f"Time to accuracy: {mesh}", facts) as page:
        width, gap = (PANEL_RIGHT - PANEL_LEFT - 62) / len(shown) - 16, 84
        height = (notes_top(words) - PANEL_TOP - len(guesses) * gap) / max(len(guesses), 1)
        for row, guess in enumerate(guesses):
            top = PANEL_TOP + 42 + row * (height + gap)
            draw_text(page, PANEL_LEFT + 62, top - 32, INITIAL_GUESS_LABELS[guess], size=11, weight="bold")
            for column, (steps, name) in enumerate(shown.items()):
                ax = add_panel(page, PANEL_LEFT + 62 + column * (width + 16), top, width, height, name)
                _draw_panel(ax, series[guess], styles, steps, (low, high * (high / low) ** 0.12))
                if column:
                    ax.tick_params(labelleft=False)
        used = {curve.label for curve in curves}
        cross = Line2D([], [], color=TEXT_COLOUR, marker="x", linestyle="", markersize=7, markeredgewidth=2)
        draw_legend(page, {k: m for k, m in styles.items() if k in used}, extra_entries=[(cross, "no longer reached")])
        draw_notes(page, words)


def _draw_panel(
    ax: Axes,
    series: dict[str, list[ConvergenceCurve]],
    styles: dict[str, SeriesStyle],
    steps: int | None,
    span: tuple[float, float],
) -> None:
    """Draw times to all accuracies.

    A cross at the upper edge marks the first accuracy that a solver fails to reach.
    """
    ticks = [format_gap(target) for target in GAP_TARGETS]
    taken: dict[int, int] = {}
    for label, curves in series.items():
        look = styles[label]
        times = np.array([median_time(curves, target, steps) for target in GAP_TARGETS])
        seen, hollow = np.where((times > 0) & np.isfinite(times), times, np.nan), any(map(is_stale, curves))
        draw_line(ax, np.arange(len(GAP_TARGETS)), seen, look, spaced_markers=False, stale=hollow)
        failed = np.flatnonzero(times == inf)
        if len(failed):
            at = int(failed[0])
            place = taken[at] = taken.get(at, -1) + 1
            x, y = at - 0.3 + 0.15 * (place % 5), 0.975 - 0.04 * (place // 5)
            ax.plot(x, y, "x", color=look.color, transform=ax.get_xaxis_transform(), markersize=6, markeredgewidth=1.8)
        if steps is None:
            warm = np.median([curve.warm_seconds for curve in curves])
            ax.plot(-1, warm, look.marker, markersize=5, **sheet_marker_style(look, is_stale=hollow))
    format_log_axis(ax.yaxis, *span, unit="time")
    first = -1 if steps is None else 0
    ax.set_xlim(first - 0.4, len(GAP_TARGETS) - 0.6)
    ax.xaxis.set_major_locator(FixedLocator(range(first, len(GAP_TARGETS))))
    ax.xaxis.set_major_formatter(FixedFormatter((["set-up"] if steps is None else []) + ticks))
    ax.xaxis.set_minor_locator(NullLocator())
    if steps is None:
        ax.axvline(-0.5, color=TEXT_COLOUR, linewidth=0.6, alpha=0.4)


def _describe_crossings(curves: Sequence[ConvergenceCurve], guesses: Sequence[str]) -> list[str]:
    """Describe the crossings on the last snapshot, the hardest step, from each initial guess."""
    words: list[str] = []
    for guess in guesses:
        race = [curve for curve in curves if curve.problem is curves[-1].problem and curve.initial_guess == guess]
        sentences = describe_crossings(race)
        if sentences:
            words.append(f"{curves[-1].problem.snapshot}, {INITIAL_GUESS_LABELS[guess]}: {'; '.join(sentences)}")
    return words
