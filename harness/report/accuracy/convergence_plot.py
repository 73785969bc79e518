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
from springbench.harness.report.accuracy.accuracy_data import (
    AccuracyData,
    ConvergenceCurve,
    FloatArray,
    SnapshotProblem,
    is_stale,
)
from springbench.harness.report.accuracy.plot_sheet import (
    PANEL_LEFT,
    PANEL_RIGHT,
    PANEL_TOP,
    add_panel,
    draw_legend,
    draw_line,
    draw_notes,
    format_iteration_axis,
    format_log_axis,
    log_limits,
    notes_top,
    plot_sheet,
    sheet_paths,
)
from springbench.harness.report.number_format import format_count, format_quantity, format_time_step
from springbench.harness.report.page_layout import draw_text
from springbench.harness.report.plot_style import (
    BACKGROUND_COLOUR,
    MUTED_COLOUR,
    PAGE_WIDTH,
    STALE_NOTE,
    TEXT_COLOUR,
    WARNING_COLOUR,
    SeriesStyle,
    assign_label_styles,
)

INITIAL_GUESS_LABELS: dict[str, str] = {
    "previous": "from the previous positions",
    "inertial": "from the inertial target",
    "extrapolated": "from extrapolated positions",
    "assignment": "as in the assignment",
}
"""Initial guesses in words."""

_MIN_ERROR = 1e-16  # what is smaller is drawn there: double precision knows nothing below


@dataclass(frozen=True, slots=True)
class _PanelRow:
    """A row of panels: label, plotted values of a curve, and share of the height."""

    label: str
    get_values: Callable[[ConvergenceCurve], FloatArray]
    height_share: float


_PANEL_ROWS = (
    _PanelRow("energy gap  (g − g*) / (g0 − g*)", lambda curve: curve.gap, 0.44),
    _PanelRow("largest vertex error, in mean rest lengths", lambda curve: curve.max_vertex_error, 0.28),
    _PanelRow("stationarity  |Q⁻¹ ∇g|, relative to the current positions", lambda curve: curve.stationarity, 0.28),
)


def draw_convergence(table: AccuracyData, folder: Path) -> list[Path]:
    """Draw a picture for each problem that solvers were measured on, and return the files.

    Args:
        table: data of an accuracy measurement.
        folder: folder that the files are written to.
    """
    drawn: list[Path] = []
    marked = assign_label_styles((curve.label, curve.solver) for curve in table.curves)
    for problem in table.problems:
        curves = [curve for curve in table.curves if curve.problem is problem]
        if curves:
            stem = folder / "-".join((problem.scene, str(problem.size), problem.snapshot, problem.problem_digest))
            _draw_problem(stem, problem, curves, marked, table.machine_words)
            drawn += sheet_paths(stem)
    return drawn


def _group_remarks(curves: Sequence[ConvergenceCurve]) -> list[str]:
    """Group the remarks on curves that ended early or in another minimum.

    There is one sentence per kind of early end and per minimum, with all curves concerned.
    """
    ends: dict[str, list[str]] = {}
    for curve in curves:
        cause = f"{curve.status}: {curve.reason}" if curve.status in ("failed", "unsupported") else curve.status
        if curve.status != "ok":
            ends.setdefault(f"× ended early ({cause})", []).append(_list_labels(curve, curves))
        if curve.minimum_index:
            words = f"in minimum {curve.minimum_index}, higher than the lowest known; vertex errors refer to it"
            ends.setdefault(words, []).append(_list_labels(curve, curves))
    return [f"{words}: {', '.join(dict.fromkeys(who))}" for words, who in ends.items()]


def _list_labels(curve: ConvergenceCurve, curves: Sequence[ConvergenceCurve]) -> str:
    several = len({one.initial_guess for one in curves}) > 1
    return (
        f"{curve.label} ({INITIAL_GUESS_LABELS.get(curve.initial_guess, curve.initial_guess)})"
        if several
        else curve.label
    )


def describe_failures(curves: Sequence[ConvergenceCurve]) -> list[str]:
    """Describe failures and convergence to another minimum, one sentence each."""
    words: list[str] = []
    for curve in curves:
        if curve.status != "ok":
            why = f": {curve.reason}" if curve.reason else ""
            words.append(
                f"× {curve.label}, {INITIAL_GUESS_LABELS.get(curve.initial_guess, curve.initial_guess)}, "
                f"{curve.status}{why}"
            )
        if curve.minimum_index:
            words.append(
                f"{curve.label}, {INITIAL_GUESS_LABELS.get(curve.initial_guess, curve.initial_guess)}, "
                f"ended in minimum {curve.minimum_index}, "
                "higher than the lowest known (minimum 0); its vertex errors refer to the minimum that it reached"
            )
    return words


def _draw_problem(
    stem: Path,
    problem: SnapshotProblem,
    curves: list[ConvergenceCurve],
    styles: dict[str, SeriesStyle],
    machine: Sequence[str],
) -> None:
    facts = [
        f"{format_count(problem.vertices)} vertices",
        f"{problem.integrator}, dt {format_time_step(problem.time_step)}",
        f"k dt²/m = {format_quantity(problem.stiffness_ratio)}",
        "median and quartiles of all rounds",
        *machine,
    ]
    words = (
        [f"Reference not certified: {problem.uncertified_reason}"] if problem.uncertified_reason else []
    ) + _group_remarks(curves)
    words += [STALE_NOTE] if any(map(is_stale, curves)) else []
    guesses = [guess for guess in INITIAL_GUESS_LABELS if any(curve.initial_guess == guess for curve in curves)]
    timed = [curve.seconds[:, 1:].ravel() for curve in curves]
    first, last = log_limits(np.concatenate([*timed, [np.nan]]))
    longest = max((curve.iterations[-1] for curve in curves if len(curve.iterations)), default=10.0)
    with plot_sheet(stem, f"Convergence: {problem.problem_label}", facts) as page:
        width = (PANEL_RIGHT - PANEL_LEFT - 62 - 44) / (2 * max(len(guesses), 1)) - 16
        height = notes_top(words) - (PANEL_TOP + 34) - 2 * 26 - 46
        for column, (guess, against) in enumerate((g, a) for g in guesses for a in ("iterations", "seconds")):
            left, top = PANEL_LEFT + 62 + column * (width + 16), PANEL_TOP + 34.0
            if against == "iterations":
                draw_text(page, left, PANEL_TOP + 2, INITIAL_GUESS_LABELS[guess], size=11, weight="bold")
            for row in _PANEL_ROWS:
                ax = add_panel(page, left, top, width, row.height_share * height, row.label if column == 0 else "")
                here = [curve for curve in curves if curve.initial_guess == guess]
                _draw_panel(ax, row, here, styles, against)
                if against == "iterations":
                    format_iteration_axis(ax, longest)
                else:
                    format_log_axis(ax.xaxis, first, last, unit="time")
                _format_error_axis(ax, row, curves, problem, column, last=column == 2 * len(guesses) - 1)
                if row is _PANEL_ROWS[-1]:
                    ax.set_xlabel({"iterations": "iterations", "seconds": "wall time"}[against], fontsize=9, loc="left")
                else:
                    ax.tick_params(labelbottom=False)
                top += row.height_share * height + 26
        if problem.uncertified_reason:
            draw_text(
                page,
                PAGE_WIDTH - PANEL_LEFT,
                50,
                "reference not certified",
                size=13,
                color=WARNING_COLOUR,
                ha="right",
                weight="bold",
            )
        used = {curve.label for curve in curves}
        draw_legend(
            page,
            {label: mark for label, mark in styles.items() if label in used},
            extra_entries=_build_legend_entries(words),
        )
        draw_notes(page, words)


def _draw_panel(
    ax: Axes, row: _PanelRow, curves: Sequence[ConvergenceCurve], styles: dict[str, SeriesStyle], against: str
) -> None:
    """Draw the curves of one initial guess, with failures marked at their ends."""
    for curve in curves:
        if not len(curve.iterations):
            continue
        look = styles[curve.label]
        values = np.maximum(row.get_values(curve), _MIN_ERROR)
        x = curve.iterations
        if against == "seconds":
            early, x, late = np.quantile(curve.seconds, (0.25, 0.5, 0.75), axis=0)
            ax.fill_betweenx(values, early, late, color=look.color, alpha=0.18, linewidth=0)
        draw_line(ax, x, values, look, stale=is_stale(curve))
        ends = np.flatnonzero(np.isfinite(values) & np.isfinite(x))
        if not len(ends):
            continue
        at = x[ends[-1]], values[ends[-1]]
        if curve.status != "ok":
            ax.plot(*at, "x", color=look.color, markersize=9, markeredgewidth=2.2, clip_on=False, zorder=5)
        if curve.minimum_index and row is _PANEL_ROWS[0]:
            ax.annotate(
                f"minimum {curve.minimum_index}",
                at,
                (-4, 5),
                textcoords="offset points",
                fontsize=8,
                color=look.color,
                ha="right",
                bbox={"facecolor": BACKGROUND_COLOUR, "alpha": 0.8, "edgecolor": "none", "pad": 0.8},
            )


def _format_error_axis(
    ax: Axes, row: _PanelRow, curves: Sequence[ConvergenceCurve], problem: SnapshotProblem, column: int, *, last: bool
) -> None:
    """Set the same scale in all panels of a row.

    Round-off is shaded, and metres are shown at the right of the errors.
    """
    all_values = np.concatenate([np.maximum(row.get_values(curve), _MIN_ERROR) for curve in curves] or [[np.nan]])
    low, high = log_limits(all_values, margin=2.0)
    if row is _PANEL_ROWS[0] and np.isfinite(problem.roundoff_gap):
        low = min(low, problem.roundoff_gap / 10) if low < 100 * problem.roundoff_gap else low
        ax.axhspan(low, max(problem.roundoff_gap, low), color=MUTED_COLOUR, alpha=0.16, linewidth=0)
    format_log_axis(ax.yaxis, low, high)
    if column:
        ax.tick_params(labelleft=False)
    if last and row is _PANEL_ROWS[1]:
        scale = problem.mean_rest_length
        metres = ax.secondary_yaxis(
            "right", functions=(lambda y: np.asarray(y) * scale, lambda y: np.asarray(y) / scale)
        )
        metres.tick_params(length=3, labelsize=8.5)
        ax.text(1.0, 1.03, "metres", transform=ax.transAxes, fontsize=8.5, color=MUTED_COLOUR)


def _build_legend_entries(words: Sequence[str]) -> list[tuple[Line2D | Patch, str]]:
    """Build the legend entries of the other marks."""
    shaded: list[tuple[Line2D | Patch, str]] = [(Patch(color=MUTED_COLOUR, alpha=0.16, linewidth=0), "round-off")]
    if any(word.startswith("×") for word in words):
        cross = Line2D([], [], color=TEXT_COLOUR, marker="x", linestyle="", markersize=8, markeredgewidth=2)
        shaded.append((cross, "ended early, see foot"))
    return shaded
