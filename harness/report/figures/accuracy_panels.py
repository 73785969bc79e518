"""Panels of `springbench accuracy`: convergence, time to accuracy, work-precision, profiles, scaling, Liu et al.
2013.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from springbench.harness.report.accuracy.accuracy_data import (
    AccuracyData,
    ConvergenceCurve,
    FloatArray,
    SnapshotProblem,
    WorkPoint,
    describe_self_converged,
    describe_stale_results,
    format_stop_rule,
    is_stale,
    without_short_curves,
)
from springbench.harness.report.accuracy.accuracy_reader import read_accuracy
from springbench.harness.report.accuracy.convergence_plot import INITIAL_GUESS_LABELS
from springbench.harness.report.accuracy.performance_profiles import (
    baseline_solver,
    cumulative_share,
    data_profile_ratios,
    describe_omitted_solvers,
    performance_ratios,
    solvable_races,
)
from springbench.harness.report.accuracy.size_scaling import GAP_TARGET, fit_scalings
from springbench.harness.report.accuracy.time_to_accuracy import (
    AMORTISATION_STEPS,
    GAP_TARGETS,
    describe_excluded_steps,
)
from springbench.harness.report.accuracy.time_to_accuracy_plot import median_time
from springbench.harness.report.accuracy.work_precision_plot import pareto_front
from springbench.harness.report.figures.axis_scales import format_power
from springbench.harness.report.figures.figure_panels import AxisScale, CurvePlot, CurveSeries, ShadedBand
from springbench.harness.report.figures.panel_selection import PanelEntry, entries_from_panels
from springbench.harness.report.number_format import format_count, format_quantity
from springbench.harness.report.plot_style import MUTED_COLOUR, STALE_NOTE, SeriesStyle, assign_label_styles

_MIN_ERROR = 1e-16
_ERROR_QUANTITIES: dict[str, tuple[str, Callable[[ConvergenceCurve], FloatArray]]] = {
    "gap": ("energy gap (g − g*) / (g₀ − g*)", lambda curve: curve.gap),
    "largest": ("largest vertex error [mean rest lengths]", lambda curve: curve.max_vertex_error),
    "stationarity": ("stationarity |Q⁻¹∇g|, relative to the start", lambda curve: curve.stationarity),
}
_X_SCALES = {
    "time": AxisScale("wall time", "log", "time"),
    "iterations": AxisScale("iterations", "iterations", "plain"),
}
REQUIRED_ROWS = "rows of `springbench accuracy CONFIG`"


def convergence_panels(folder: Path) -> list[PanelEntry]:
    """Build panels of error against time and iterations, for each step snapshot and initial guess."""
    table = without_short_curves(read_accuracy(folder))
    marked = assign_label_styles((curve.label, curve.solver) for curve in table.curves)
    found: list[PanelEntry] = []
    for problem in table.problems:
        for guess in INITIAL_GUESS_LABELS:
            curves = [
                c for c in table.curves if c.problem is problem and c.initial_guess == guess and len(c.iterations)
            ]
            of = (problem.scene, str(problem.size), problem.snapshot, guess)
            for quantity_, against in ((q, a) for q in _ERROR_QUANTITIES for a in _X_SCALES if curves):
                plot = _build_convergence_plot(of, quantity_, against, problem, curves, marked, table)
                found += entries_from_panels([plot])
    return found


def _build_convergence_plot(
    group: tuple[str, ...],
    what: str,
    against: str,
    problem: SnapshotProblem,
    curves: Sequence[ConvergenceCurve],
    styles: dict[str, SeriesStyle],
    table: AccuracyData,
) -> CurvePlot:
    words, values = _ERROR_QUANTITIES[what]
    series: list[CurveSeries] = []
    for curve in curves:
        y = np.maximum(values(curve), _MIN_ERROR)
        early, x, late = np.quantile(curve.seconds, (0.25, 0.5, 0.75), axis=0)
        how: Any = {"stale": np.full(len(y), is_stale(curve))}
        if against == "iterations":
            series.append(CurveSeries(curve.label, styles[curve.label], curve.iterations, y, **how))
        else:
            series.append(CurveSeries(curve.label, styles[curve.label], x, y, early, late, is_horizontal=True, **how))
    lowest = min((float(np.nanmin(one.y)) for one in series if np.isfinite(one.y).any()), default=np.inf)
    shaded = what == "gap" and lowest < problem.roundoff_gap < np.inf
    doubt = [f"Reference not certified: {problem.uncertified_reason}."] if problem.uncertified_reason else []
    shares = ["Curves: median over the rounds, shaded between the quartiles."] if against == "time" else []
    return CurvePlot(
        *(group, (what, against), f"{problem.problem_label}, {INITIAL_GUESS_LABELS[group[-1]]}", ""),
        *(_X_SCALES[against], AxisScale(words, "log", "power"), series),
        bands=[ShadedBand(0.0, problem.roundoff_gap, "round-off")] if shaded else [],
        notes=[*doubt, *shares, *_describe_stale(curves), *_describe_early_ends(curves)],
        machine_words=", ".join(table.machine_words),
    )


def _describe_stale(measured: Iterable[ConvergenceCurve | WorkPoint]) -> list[str]:
    return [STALE_NOTE] if any(map(is_stale, measured)) else []


def _describe_early_ends(curves: Sequence[ConvergenceCurve]) -> list[str]:
    """Describe the curves that ended early, grouped by status."""
    by: dict[str, list[str]] = {}
    for curve in curves:
        if curve.status != "ok":
            by.setdefault(curve.status, []).append(curve.label)
    return [f"Ended early ({how}): {', '.join(labels)}." for how, labels in sorted(by.items())]


def time_to_accuracy_panels(folder: Path) -> list[PanelEntry]:
    """Build panels of the time to each accuracy.

    There are panels for each mesh and initial guess, without set-up and with amortised set-up.
    """
    table = without_short_curves(read_accuracy(folder))
    marked = assign_label_styles((curve.label, curve.solver) for curve in table.curves)
    plots: list[CurvePlot] = []
    for mesh in dict.fromkeys((p.scene, p.size, p.mesh_label) for p in table.problems):
        sure = [
            c
            for c in table.curves
            if (c.problem.scene, c.problem.size) == mesh[:2] and not c.problem.uncertified_reason
        ]
        for guess in INITIAL_GUESS_LABELS:
            here = [curve for curve in sure if curve.initial_guess == guess]
            for steps in (None, *AMORTISATION_STEPS) if here else ():
                of, name = (mesh[0], str(mesh[1]), guess), ("alone" if steps is None else f"over-{steps}",)
                title = (
                    "the step alone" if steps is None else f"set-up over {format_count(steps)} step{'s'[: steps > 1]}"
                )
                series = list(_build_time_series(here, marked, steps))
                x = AxisScale("energy gap to be reached", "names", place_names=tuple(map(format_power, GAP_TARGETS)))
                y = AxisScale("wall time, median over the steps of the mesh", "log", "time")
                problems = [p for p in table.problems if (p.scene, p.size) == mesh[:2]]
                plots.append(
                    CurvePlot(
                        *(of, name, f"{mesh[2]}, {INITIAL_GUESS_LABELS[guess]}", title, x, y),
                        series,
                        notes=[
                            *(f"{sentence}." for sentence in describe_excluded_steps(problems)),
                            *_describe_stale(here),
                        ],
                        machine_words=", ".join(table.machine_words),
                    )
                )
    return entries_from_panels(plots)


def _build_time_series(
    curves: Sequence[ConvergenceCurve], styles: dict[str, SeriesStyle], steps: int | None
) -> Iterator[CurveSeries]:
    for label in dict.fromkeys(curve.label for curve in curves):
        own = [curve for curve in curves if curve.label == label]
        y = np.array([median_time(own, target, steps) for target in GAP_TARGETS])
        y = np.where(np.isfinite(y) & (y > 0.0), y, np.nan)
        if np.isfinite(y).any():
            hollow = np.full(len(y), any(map(is_stale, own)))
            yield CurveSeries(label, styles[label], np.arange(len(GAP_TARGETS), dtype=float), y, stale=hollow)


def work_precision_panels(folder: Path) -> list[PanelEntry]:
    """Build panels of error against wall time of whole simulations, for each mesh and integrator."""
    table = read_accuracy(folder)
    known = [
        w
        for w in table.work_points
        if w.status == "ok" and 0.0 < w.error < np.inf and 0.0 < w.seconds_per_simulated_second < np.inf
    ]
    marked = assign_label_styles((work.label, work.solver) for work in table.work_points)
    plots: list[CurvePlot] = []
    for mesh in dict.fromkeys((w.scene, w.size, w.mesh_label) for w in known):
        here = [w for w in known if (w.scene, w.size) == mesh[:2]]
        for integrator in dict.fromkeys(w.integrator for w in here):
            mine = [w for w in here if w.integrator == integrator]
            tolerances = sorted({w.residual_rtol for w in mine if w.residual_rtol is not None}, reverse=True)
            notes = ["Joined points differ in the time step alone."]
            if len(tolerances) > 1:
                notes.append(
                    "Larger marks: tighter tolerances, "
                    f"{', '.join(format_power(t) if t else 'auto' for t in tolerances)}."
                )
            plots.append(
                CurvePlot(
                    *(
                        (mesh[0], str(mesh[1])),
                        (integrator,),
                        f"{mesh[2]}, {format_quantity(mine[0].t_end)} s",
                        integrator,
                    ),
                    AxisScale("wall time a simulated second", "log", "time"),
                    AxisScale("error of the positions, relative to the way from the start", "log", "percent"),
                    [_build_front_series(here), *_build_time_step_series(mine, marked, tolerances)],
                    notes=[
                        *(*notes, "Grey: the least error that a budget buys, by any integrator."),
                        *(*describe_self_converged(mine), *_describe_stale(mine)),
                    ],
                    machine_words=", ".join(table.machine_words),
                )
            )
    return entries_from_panels(plots)


def _build_front_series(works: Sequence[WorkPoint]) -> CurveSeries:
    best = pareto_front(works)
    x, y = np.array([w.seconds_per_simulated_second for w in best]), np.array([w.error for w in best])
    return CurveSeries("best of all", SeriesStyle("#b9b6af", "None"), x, y, is_stepped=True)


def _build_time_step_series(
    works: Sequence[WorkPoint], styles: dict[str, SeriesStyle], tolerances: Sequence[float]
) -> Iterator[CurveSeries]:
    chains: dict[tuple[str, float | None, int, str], list[WorkPoint]] = {}
    for one in works:
        chains.setdefault((one.label, one.residual_rtol, one.max_iterations, one.initial_guess), []).append(one)
    for (label, tolerance, iterations, _), members in chains.items():
        members.sort(key=lambda one: one.time_step)
        x, y = np.array([one.seconds_per_simulated_second for one in members]), np.array([one.error for one in members])
        setting = format_stop_rule(tolerance, iterations)
        grown = 1.0 + 0.25 * tolerances.index(tolerance) if tolerance in tolerances else 1.0
        hollow = np.array([is_stale(one) for one in members])
        yield CurveSeries(label, styles[label], x, y, stale=hollow, setting=setting, marker_scale=grown)


def profile_panels(folder: Path) -> list[PanelEntry]:
    """Build panels of performance and data profiles, one per accuracy."""
    table = without_short_curves(read_accuracy(folder))
    kinds = {
        "performance": ("time, over the fastest solver's", "performance profile", performance_ratios),
        "data": (f"time, in iterations of {baseline_solver(table)}", "data profile", data_profile_ratios),
    }
    marked = assign_label_styles((curve.label, curve.solver) for curve in table.curves)
    plots: list[CurvePlot] = []
    for kind, (words, subject, ratios) in kinds.items():
        for target in GAP_TARGETS if baseline_solver(table) or kind == "performance" else ():
            races = len(solvable_races(table, target))
            found = {label: values for label, values in ratios(table, target).items() if np.isfinite(values).any()}
            if found and races:
                plots.append(
                    CurvePlot(
                        *((kind,), (f"{target:.0e}".replace("e-0", "e-"),), subject),
                        *(f"to a gap of {format_power(target)}: {races} problems", AxisScale(words, "log", "plain")),
                        AxisScale("share of the problems solved", "linear", "percent"),
                        list(_build_profile_series(found, marked)),
                        notes=[*describe_omitted_solvers(table), *describe_stale_results(table.curves)],
                        machine_words=", ".join(table.machine_words),
                    )
                )
    return entries_from_panels(plots)


def _build_profile_series(ratios: dict[str, FloatArray], styles: dict[str, SeriesStyle]) -> Iterator[CurveSeries]:
    known = np.concatenate([values[np.isfinite(values)] for values in ratios.values()])
    low, high = known.min(initial=1.0), 2.0 * known.max(initial=5.0)
    for label, values in ratios.items():
        x = np.unique([low, *values[np.isfinite(values)], high])
        yield CurveSeries(label, styles[label], x, cumulative_share(values, x), is_stepped=True)


def scaling_panels(folder: Path) -> list[PanelEntry]:
    """Build panels of time to a gap against the number of vertices.

    There is one for each scene and initial guess.
    """
    table = without_short_curves(read_accuracy(folder))
    marked = assign_label_styles((curve.label, curve.solver) for curve in table.curves)
    found = [one for one in fit_scalings(table) if one.vertices]
    plots: list[CurvePlot] = []
    for scene, guess in dict.fromkeys((one.scene, one.initial_guess) for one in found):
        here = [one for one in found if (one.scene, one.initial_guess) == (scene, guess)]
        series = [
            CurveSeries(
                one.label + (f" n^{one.exponent:.2f}" if np.isfinite(one.exponent) else ""),
                *(marked[one.label], np.array(one.vertices, float), np.array(one.seconds)),
                stale=np.array(one.stale),
            )
            for one in here
        ]
        lost = [
            f"Not reached by {g.label} at {', '.join(map(str, g.unsolved_sizes))} vertices."
            for g in here
            if g.unsolved_sizes
        ]
        hollow = [STALE_NOTE] if any(any(g.stale) for g in here) else []
        plots.append(
            CurvePlot(
                *(
                    (scene, guess),
                    ("growth",),
                    f"{scene}, {INITIAL_GUESS_LABELS[guess]}",
                    "",
                    AxisScale("vertices", "sizes", "plain"),
                ),
                *(AxisScale(f"wall time to a gap of {format_power(GAP_TARGET)}", "log", "time"), series),
                notes=[*lost, *hollow],
                machine_words=", ".join(table.machine_words),
            )
        )
    return entries_from_panels(plots)


def liu2013_panels(folder: Path) -> list[PanelEntry]:
    """Build panels of figures 2 and 3 of Liu et al. 2013 with own results."""
    from springbench.harness.report.accuracy.liu2013_comparison import compare_with_paper, select_own_curves

    table = read_accuracy(folder)
    found = compare_with_paper(table)
    plots: list[CurvePlot] = []
    for curve in dict.fromkeys(one.curve for one in found):
        mine = [one for one in found if one.curve == curve]
        x = np.array([one.iterations for one in mine], float)
        ours, theirs = (np.array([getattr(one, side) for one in mine]) for side in ("own_error", "published_error"))
        series = [CurveSeries("ours", SeriesStyle("#0072b2", "o"), x, ours)]
        series.append(CurveSeries("Liu et al. 2013", SeriesStyle(MUTED_COLOUR, "D", (0, (3, 1.5))), x, theirs))
        of = curve.replace("figure ", "figure-").replace(" × ", "x").replace(" = ", "").replace(", ", ":").split(":")
        plots.append(
            CurvePlot(
                *((of[0],), tuple(of[1:]) or ("iterations",), curve, "", AxisScale("iterations", "log", "plain")),
                *(AxisScale("relative error (g − g*) / (g₀ − g*)", "log", "power"), series),
                notes=describe_stale_results(select_own_curves(table)),
                machine_words=", ".join(table.machine_words),
            )
        )
    return entries_from_panels(plots)
