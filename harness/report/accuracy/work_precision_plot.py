# pyright: reportUnknownMemberType=false
# Matplotlib's stubs do not type most keywords.
"""Work-precision diagram: error of a simulation against its wall time, and the Pareto front."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from springbench.harness.report.accuracy.accuracy_data import AccuracyData, WorkPoint, is_stale
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
    marker_scale,
    notes_top,
    plot_sheet,
    sheet_paths,
)
from springbench.harness.report.accuracy.time_to_accuracy import format_duration, format_gap
from springbench.harness.report.number_format import format_quantity, format_time_step
from springbench.harness.report.page_layout import draw_text
from springbench.harness.report.plot_style import (
    BACKGROUND_COLOUR,
    MUTED_COLOUR,
    STALE_NOTE,
    TEXT_COLOUR,
    SeriesStyle,
    assign_label_styles,
)
from springbench.solvers.iteration.solver_info import LOCAL_GLOBAL_FAMILY
from springbench.solvers.model.integrators import INTEGRATORS

MAX_COLUMNS = 4
"""Number of panels in a row."""

_MARKER_SIZE, _SUBSTEP_MARKER_SIZE = 4.4, 7.0
"""Marker sizes: the smallest of a tolerance, and that of substepping methods, which have no connected line."""

_MAX_DRAWN_ERROR = 1e3
"""Relative errors beyond it belong to motions that exploded, even if finite: they are above the panel."""

ERROR_TARGETS = (0.1, 0.03, 0.01, 0.003, 0.001)
"""Errors at which the Pareto front is described in words."""


def is_default_setting(work: WorkPoint) -> bool:
    """Return whether this is the most common setting.

    It is implicit Euler at 1/30 s with 50 iterations of local-global.
    """
    same_method = work.family == LOCAL_GLOBAL_FAMILY and work.integrator == "implicit-euler"
    return (
        same_method and work.residual_rtol is None and work.max_iterations == 50 and abs(30 * work.time_step - 1) < 1e-9
    )


def find_default_setting(works: Iterable[WorkPoint]) -> WorkPoint | None:
    """Find the most common setting among these, by the fastest of its backends."""
    return min(
        (w for w in works if is_default_setting(w) and _is_complete(w)),
        key=lambda w: w.seconds_per_simulated_second,
        default=None,
    )


def pareto_front(works: Iterable[WorkPoint]) -> list[WorkPoint]:
    """Return the Pareto front in time and error, the cheapest first."""
    front: list[WorkPoint] = []
    for work in sorted((w for w in works if _is_complete(w)), key=lambda w: (w.seconds_per_simulated_second, w.error)):
        if not front or work.error < front[-1].error:
            front.append(work)
    return front


def describe_cheapest_settings(works: Sequence[WorkPoint]) -> list[str]:
    """Describe the cheapest setting for each error, compared with the default setting's method."""
    base = find_default_setting(works)
    words: list[str] = []
    if base:
        words.append(
            f"the default ({base.setting_label}) has an error of {100 * base.error:.2g} % "
            f"for {format_duration(base.seconds_per_simulated_second)} a simulated second"
        )
    for error in ERROR_TARGETS:
        best = next((work for work in pareto_front(works) if work.error <= error), None)
        if best:
            euler = min(
                (w for w in works if is_same_method(w, base) and _is_complete(w) and w.error <= error),
                key=lambda w: w.seconds_per_simulated_second,
                default=None,
            )
            against = (
                f", 1/{format_quantity(euler.seconds_per_simulated_second / best.seconds_per_simulated_second)} "
                "of what the default's method needs"
                if euler
                else ""
            )
            words.append(
                f"{100 * error:g} %: {best.setting_label}: {format_duration(best.seconds_per_simulated_second)} "
                f"a simulated second{against}"
            )
    return words


def is_same_method(work: WorkPoint, base: WorkPoint | None) -> bool:
    """Return whether it differs from the default only in the time step."""
    return base is not None and (work.label, work.integrator, work.residual_rtol, work.max_iterations) == (
        base.label,
        base.integrator,
        base.residual_rtol,
        base.max_iterations,
    )


def draw_work_precision(table: AccuracyData, folder: Path) -> list[Path]:
    """Draw a picture for each mesh, one panel per integrator; return the files."""
    drawn: list[Path] = []
    marked = assign_label_styles((work.label, work.solver) for work in table.work_points)
    for mesh in dict.fromkeys(work.mesh_label for work in table.work_points):
        here = [work for work in table.work_points if work.mesh_label == mesh]
        if any(_is_complete(work) for work in here):
            stem = folder / mesh.replace(" ", "-")
            _draw_mesh(stem, mesh, here, marked, table.machine_words)
            drawn += sheet_paths(stem)
    return drawn


def _is_complete(work: WorkPoint) -> bool:
    return work.status == "ok" and 0.0 < work.error < np.inf and 0.0 < work.seconds_per_simulated_second < np.inf


def _draw_mesh(
    stem: Path, mesh: str, works: list[WorkPoint], styles: dict[str, SeriesStyle], machine: Sequence[str]
) -> None:
    words = _collect_notes(works)
    there = {work.integrator for work in works}
    integrators = [*(name for name in INTEGRATORS if name in there), *sorted(there - set(INTEGRATORS))]
    known = [work for work in works if _is_complete(work)]
    sizes = _assign_marker_sizes(works)
    across = log_limits([w.seconds_per_simulated_second for w in known], margin=1.6)
    down = log_limits([w.error for w in known if w.error < _MAX_DRAWN_ERROR] or [w.error for w in known], margin=1.6)
    facts = [f"{format_quantity(works[0].t_end)} s simulated", "time stepping and solver together", *machine]
    if any(work.reference_kind == "self-converged" for work in works):
        facts.insert(1, "by a self-converged reference")
    with plot_sheet(stem, f"Work and precision: {mesh}", facts) as page:
        across_page, down_page = min(MAX_COLUMNS, len(integrators)), -(-len(integrators) // MAX_COLUMNS)
        width = (PANEL_RIGHT - PANEL_LEFT - 62) / across_page - 20
        height = (notes_top(words) - PANEL_TOP - 46) / down_page
        draw_text(
            page,
            PANEL_LEFT + 62,
            PANEL_TOP + 4,
            "error of the positions, relative to the way from the start",
            size=10.5,
        )
        for k, integrator in enumerate(integrators):
            row, column = divmod(k, MAX_COLUMNS)
            left, top = PANEL_LEFT + 62 + column * (width + 20), PANEL_TOP + 46 + row * height
            ax = add_panel(page, left, top, width, height - 46, integrator)
            _draw_panel(ax, [work for work in known if work.integrator == integrator], styles, sizes)
            _draw_front(ax, known)
            format_log_axis(ax.xaxis, *across, unit="time")
            format_log_axis(ax.yaxis, *down, unit="percent")
            ax.set_xlabel("wall time a simulated second", fontsize=9, loc="left")
            if column:
                ax.tick_params(labelleft=False)
        minimises = {work.label: work.is_minimiser for work in works}
        names = {
            label if minimises[label] else f"{label} †": mark for label, mark in styles.items() if label in minimises
        }
        draw_legend(page, names, extra_entries=_build_legend_entries(sizes))
        draw_notes(page, words)


def _assign_marker_sizes(works: Iterable[WorkPoint]) -> dict[float | None, float]:
    """Assign marker sizes by tolerance, larger for tighter ones; None, fixed iterations, gets the smallest.

    Substepping methods have no iterations, and the largest markers.
    """
    tolerances = sorted({work.residual_rtol for work in works if work.residual_rtol is not None}, reverse=True)
    return {None: 2.8, **{tolerance: _MARKER_SIZE + 1.6 * k for k, tolerance in enumerate(tolerances)}}


def _draw_panel(
    ax: Axes, works: list[WorkPoint], styles: dict[str, SeriesStyle], sizes: dict[float | None, float]
) -> None:
    """Draw the points of one integrator.

    Points that differ only in the time step, or only in the substeps, are joined.
    """
    chains: dict[tuple[str, float | None, float, str], list[WorkPoint]] = {}
    divided = _find_substep_labels(works)
    for work in works:
        differs = work.time_step if work.label in divided else work.max_iterations
        chains.setdefault((work.label, work.residual_rtol, differs, work.initial_guess), []).append(work)
    for (label, tolerance, *_), members in chains.items():
        members.sort(key=lambda work: (work.time_step, -work.max_iterations))
        look, hollow = styles[label], [is_stale(work) for work in members]
        x, y = [work.seconds_per_simulated_second for work in members], [work.error for work in members]
        grown = max(_SUBSTEP_MARKER_SIZE, *sizes.values()) if members[0].is_substepping else sizes[tolerance]
        draw_line(
            ax, x, y, look, spaced_markers=False, stale=hollow, linewidth=0.9, markersize=grown * marker_scale(look)
        )
    base = find_default_setting(works)
    if base:
        ax.plot(
            base.seconds_per_simulated_second,
            base.error,
            "o",
            mfc="none",
            mec=TEXT_COLOUR,
            markersize=15,
            mew=1.6,
            zorder=6,
        )
        ax.annotate(
            "the default", (base.seconds_per_simulated_second, base.error), (11, 4), textcoords="offset points",
            fontsize=9, ha="left", color=TEXT_COLOUR,
            bbox={"facecolor": BACKGROUND_COLOUR, "alpha": 0.8, "edgecolor": "none", "pad": 0.8},
        )  # fmt: skip


def _find_substep_labels(works: Iterable[WorkPoint]) -> set[str]:
    """Find the labels of methods that were measured with several numbers of substeps."""
    tried: dict[str, set[int]] = {}
    for work in works:
        if work.is_substepping:
            tried.setdefault(work.label, set()).add(work.max_iterations)
    return {label for label, numbers in tried.items() if len(numbers) > 1}


def _draw_front(ax: Axes, works: list[WorkPoint]) -> None:
    """Draw the Pareto front of all integrators, the same in each panel.

    It is the smallest error for each wall time.
    """
    best = pareto_front(works)
    if best:
        x, y = [work.seconds_per_simulated_second for work in best], [work.error for work in best]
        ax.plot(
            [x[0], *x, 1e6],
            [1e6, *y, y[-1]],
            drawstyle="steps-post",
            color=MUTED_COLOUR,
            linewidth=5,
            alpha=0.28,
            zorder=1,
        )


def _build_legend_entries(sizes: dict[float | None, float]) -> list[tuple[Line2D, str]]:
    def dot(**more: Any) -> Line2D:
        return Line2D([], [], color=MUTED_COLOUR, marker="o", linestyle="", **more)

    return [
        (Line2D([], [], color=MUTED_COLOUR, linewidth=5, alpha=0.28), "Pareto front of all"),
        *((dot(markersize=grown), _format_tolerance(t)) for t, grown in sizes.items()),
    ]


def _format_tolerance(tolerance: float | None) -> str:
    if tolerance is None:
        return "fixed iterations"
    return f"tolerance {format_gap(tolerance)}" if tolerance else "tolerance auto"


def _collect_notes(works: Sequence[WorkPoint]) -> list[str]:
    words = [
        "Joined points differ in the time step alone: " + ", ".join(map(format_time_step, _distinct_time_steps(works)))
    ]
    divided = _find_substep_labels(works)
    if solvers := sorted({work.solver for work in works if work.label in divided}):
        words[0] += f"; those of {', '.join(solvers)} in the substeps alone"
    if any(_is_complete(work) and work.error >= _MAX_DRAWN_ERROR for work in works):
        words.append("What leaves a panel at its top exploded")
    if not all(work.is_minimiser for work in works):
        words.append("† does not minimise the step's objective: its limit is not the integrator's own solution")
    words += [STALE_NOTE] if any(map(is_stale, works)) else []
    failed = [work for work in works if work.status != "ok"]
    return words + [
        f"× {work.setting_label}: {work.status}{': ' if work.reason else ''}{work.reason}" for work in failed
    ]


def _distinct_time_steps(works: Sequence[WorkPoint]) -> list[float]:
    return sorted({work.time_step for work in works}, reverse=True)
