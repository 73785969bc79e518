# pyright: reportUnknownMemberType=false
# Matplotlib's stubs do not type most keywords.
"""Convergence on a step snapshot, against iterations and wall time.

The panels show energy gap, largest error and stationarity.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from harness.report.accuracy.measured import Curve, Measurements, Problem, Values, older
from harness.report.accuracy.sheet import (
    LEFT,
    RIGHT,
    TOP,
    files,
    foot,
    iteration_axis,
    legend,
    limits,
    line,
    log_axis,
    notes,
    panel,
    sheet,
)
from harness.report.page import count, quantity, step_words, text
from harness.report.style import INK, MUTED, OLDER, PAGE, WARNING, WIDTH, Mark, looks

GUESSES: dict[str, str] = {
    "current": "from the current positions",
    "inertial": "from the inertial target",
    "motion": "from where the motion leads",
    "assignment": "as in the assignment",
}
"""Initial guesses in words."""

_LEAST = 1e-16  # what is smaller is drawn there: double precision knows nothing below


@dataclass(frozen=True, slots=True)
class _Row:
    """A row of panels: label, plotted values of a curve, and share of the height."""

    name: str
    values: Callable[[Curve], Values]
    share: float


_ROWS = (
    _Row("energy gap  (g − g*) / (g0 − g*)", lambda curve: curve.gap, 0.44),
    _Row("largest vertex error, in mean rest lengths", lambda curve: curve.largest, 0.28),
    _Row("stationarity  |Q⁻¹ ∇g|, relative to the current positions", lambda curve: curve.stationarity, 0.28),
)


def draw_convergence(table: Measurements, folder: Path) -> list[Path]:
    """Draw a picture for each problem that solvers were measured on, and return the files.

    Args:
        table: data of an accuracy measurement.
        folder: folder that the files are written to.
    """
    drawn: list[Path] = []
    marked = looks((curve.label, curve.solver) for curve in table.curves)
    for problem in table.problems:
        curves = [curve for curve in table.curves if curve.problem is problem]
        if curves:
            stem = folder / "-".join((problem.scene, str(problem.size), problem.moment, problem.digest))
            _draw(stem, problem, curves, marked, table.machine)
            drawn += files(stem)
    return drawn


def _grouped(curves: Sequence[Curve]) -> list[str]:
    """Group the remarks on curves that ended early or in another minimum.

    There is one sentence per kind of early end and per minimum, with all curves concerned.
    """
    ends: dict[str, list[str]] = {}
    for curve in curves:
        cause = f"{curve.status}: {curve.reason}" if curve.status in ("failed", "unsupported") else curve.status
        if curve.status != "ok":
            ends.setdefault(f"× ended early ({cause})", []).append(_who(curve, curves))
        if curve.branch:
            words = f"in minimum {curve.branch}, higher than the lowest known; vertex errors refer to it"
            ends.setdefault(words, []).append(_who(curve, curves))
    return [f"{words}: {', '.join(dict.fromkeys(who))}" for words, who in ends.items()]


def _who(curve: Curve, curves: Sequence[Curve]) -> str:
    several = len({one.first_guess for one in curves}) > 1
    return f"{curve.label} ({GUESSES.get(curve.first_guess, curve.first_guess)})" if several else curve.label


def remarks(curves: Sequence[Curve]) -> list[str]:
    """Describe failures and convergence to another minimum, one sentence each."""
    words: list[str] = []
    for curve in curves:
        if curve.status != "ok":
            why = f": {curve.reason}" if curve.reason else ""
            words.append(f"× {curve.label}, {GUESSES.get(curve.first_guess, curve.first_guess)}, {curve.status}{why}")
        if curve.branch:
            words.append(
                f"{curve.label}, {GUESSES.get(curve.first_guess, curve.first_guess)}, ended in minimum {curve.branch}, "
                "higher than the lowest known (minimum 0); its vertex errors refer to the minimum that it reached"
            )
    return words


def _draw(stem: Path, problem: Problem, curves: list[Curve], marked: dict[str, Mark], machine: Sequence[str]) -> None:
    facts = [
        f"{count(problem.vertices)} vertices",
        f"{problem.integrator}, dt {step_words(problem.time_step)}",
        f"k dt²/m = {quantity(problem.stiffness_ratio)}",
        "median and quartiles of all rounds",
        *machine,
    ]
    words = ([f"Reference not certified: {problem.doubt}"] if problem.doubt else []) + _grouped(curves)
    words += [OLDER] if any(map(older, curves)) else []
    guesses = [guess for guess in GUESSES if any(curve.first_guess == guess for curve in curves)]
    timed = [curve.seconds[:, 1:].ravel() for curve in curves]
    first, last = limits(np.concatenate([*timed, [np.nan]]))
    longest = max((curve.iterations[-1] for curve in curves if len(curve.iterations)), default=10.0)
    with sheet(stem, f"Convergence: {problem.name}", facts) as page:
        width = (RIGHT - LEFT - 62 - 44) / (2 * max(len(guesses), 1)) - 16
        height = foot(words) - (TOP + 34) - 2 * 26 - 46
        for column, (guess, against) in enumerate((g, a) for g in guesses for a in ("iterations", "seconds")):
            left, top = LEFT + 62 + column * (width + 16), TOP + 34.0
            if against == "iterations":
                text(page, left, TOP + 2, GUESSES[guess], size=11, weight="bold")
            for row in _ROWS:
                ax = panel(page, left, top, width, row.share * height, row.name if column == 0 else "")
                here = [curve for curve in curves if curve.first_guess == guess]
                _panel(ax, row, here, marked, against)
                if against == "iterations":
                    iteration_axis(ax, longest)
                else:
                    log_axis(ax.xaxis, first, last, unit="time")
                _vertical(ax, row, curves, problem, column, last=column == 2 * len(guesses) - 1)
                if row is _ROWS[-1]:
                    ax.set_xlabel({"iterations": "iterations", "seconds": "wall time"}[against], fontsize=9, loc="left")
                else:
                    ax.tick_params(labelbottom=False)
                top += row.share * height + 26
        if problem.doubt:
            text(page, WIDTH - LEFT, 50, "reference not certified", size=13, color=WARNING, ha="right", weight="bold")
        used = {curve.label for curve in curves}
        legend(page, {label: mark for label, mark in marked.items() if label in used}, below=_meanings(words))
        notes(page, words)


def _panel(ax: Axes, row: _Row, curves: Sequence[Curve], marked: dict[str, Mark], against: str) -> None:
    """Draw the curves of one initial guess, with failures marked at their ends."""
    for curve in curves:
        if not len(curve.iterations):
            continue
        look = marked[curve.label]
        values = np.maximum(row.values(curve), _LEAST)
        x = curve.iterations
        if against == "seconds":
            early, x, late = np.quantile(curve.seconds, (0.25, 0.5, 0.75), axis=0)
            ax.fill_betweenx(values, early, late, color=look.color, alpha=0.18, linewidth=0)
        line(ax, x, values, look, older=older(curve))
        ends = np.flatnonzero(np.isfinite(values) & np.isfinite(x))
        if not len(ends):
            continue
        at = x[ends[-1]], values[ends[-1]]
        if curve.status != "ok":
            ax.plot(*at, "x", color=look.color, markersize=9, markeredgewidth=2.2, clip_on=False, zorder=5)
        if curve.branch and row is _ROWS[0]:
            ax.annotate(
                f"minimum {curve.branch}",
                at,
                (-4, 5),
                textcoords="offset points",
                fontsize=8,
                color=look.color,
                ha="right",
                bbox={"facecolor": PAGE, "alpha": 0.8, "edgecolor": "none", "pad": 0.8},
            )


def _vertical(ax: Axes, row: _Row, curves: Sequence[Curve], problem: Problem, column: int, *, last: bool) -> None:
    """Set the same scale in all panels of a row.

    Round-off is shaded, and metres are shown at the right of the errors.
    """
    all_values = np.concatenate([np.maximum(row.values(curve), _LEAST) for curve in curves] or [[np.nan]])
    low, high = limits(all_values, margin=2.0)
    if row is _ROWS[0] and np.isfinite(problem.round_off):
        low = min(low, problem.round_off / 10) if low < 100 * problem.round_off else low
        ax.axhspan(low, max(problem.round_off, low), color=MUTED, alpha=0.16, linewidth=0)
    log_axis(ax.yaxis, low, high)
    if column:
        ax.tick_params(labelleft=False)
    if last and row is _ROWS[1]:
        scale = problem.mean_rest_length
        metres = ax.secondary_yaxis(
            "right", functions=(lambda y: np.asarray(y) * scale, lambda y: np.asarray(y) / scale)
        )
        metres.tick_params(length=3, labelsize=8.5)
        ax.text(1.0, 1.03, "metres", transform=ax.transAxes, fontsize=8.5, color=MUTED)


def _meanings(words: Sequence[str]) -> list[tuple[Line2D | Patch, str]]:
    """Build the legend entries of the other marks."""
    shaded: list[tuple[Line2D | Patch, str]] = [(Patch(color=MUTED, alpha=0.16, linewidth=0), "round-off")]
    if any(word.startswith("×") for word in words):
        cross = Line2D([], [], color=INK, marker="x", linestyle="", markersize=8, markeredgewidth=2)
        shaded.append((cross, "ended early, see foot"))
    return shaded
