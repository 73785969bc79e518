"""Charts of `springbench accuracy`: convergence, time to accuracy, work-precision, profiles and scaling.

A measurement is stale if it was made by other code than the current version. If `newest_fingerprint` is given, as on
the results page, it is stale if it was made by other code than the newest rows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from springbench.harness.report.accuracy.accuracy_data import (
    INITIAL_GUESS_LABELS,
    AccuracyData,
    ConvergenceCurve,
    SnapshotProblem,
    WorkPoint,
    describe_self_converged,
    describe_stale_results,
    format_stop_rule,
)
from springbench.harness.report.accuracy.performance_profiles import (
    compute_cumulative_share,
    compute_data_profile_ratios,
    compute_performance_ratios,
    describe_omitted_solvers,
    find_baseline_solver,
    group_solvable_curves,
)
from springbench.harness.report.accuracy.size_scaling import GAP_TARGET, SizeScaling, fit_scalings
from springbench.harness.report.accuracy.time_to_accuracy import (
    AMORTISATION_STEPS,
    GAP_TARGETS,
    compute_median_time,
    describe_excluded_steps,
    format_gap,
)
from springbench.harness.report.accuracy.work_precision import find_default_setting, find_pareto_front, is_complete
from springbench.harness.report.charts.chart_description import (
    ChartAxis,
    ChartDescription,
    ChartFrame,
    ChartSeries,
)
from springbench.harness.report.charts.figure_panels import AxisScale, FloatArray, ShadedBand
from springbench.harness.report.number_format import format_count, format_power, format_quantity, format_time_step
from springbench.harness.report.plot_style import STALE_NOTE, SeriesStyle, assign_label_styles
from springbench.harness.report.provenance_words import is_stale

ACCURACY_COMMAND = "springbench accuracy CONFIG --rerun"
COST_LABEL = "wall time a simulated second"
ERROR_LABEL = "error of the positions, relative to the distance from the start"

_MIN_ERROR = 1e-16
"""Smaller errors are drawn at this value, because double precision does not resolve them."""
_MAX_DRAWN_ERROR = 1e3
"""Relative errors of this value or more belong to motions that exploded; they would compress all others."""

SourceLinks = Callable[[ConvergenceCurve], Mapping[str, Any]]
"""Returns what the page offers for the points of a curve."""


def build_convergence_chart(
    table: AccuracyData, newest_fingerprint: str | None = None, link_source: SourceLinks = lambda curve: {}
) -> ChartDescription:
    """Build the chart of errors against time and iterations.

    It has a frame for each step and initial guess.

    Args:
        table: data of an accuracy measurement.
        newest_fingerprint: source fingerprint of the newest rows, others are stale; None for that of this version.
        link_source: returns the links of a curve.
    """
    styles = _assign_styles(table.curves)
    frames: list[ChartFrame] = []
    for problem in table.problems:
        for guess, words in INITIAL_GUESS_LABELS.items():
            curves = [c for c in table.curves if c.problem is problem and c.initial_guess == guess]
            if not any(len(curve.iterations) for curve in curves):
                continue
            series = [
                _build_convergence_series(one, styles[one.label], newest_fingerprint, link_source) for one in curves
            ]
            lowest = min((float(np.nanmin(one.columns["gap"], initial=np.inf)) for one in series), default=np.inf)
            shaded = lowest < problem.roundoff_gap < np.inf
            frames.append(
                ChartFrame(
                    group=(problem.scene, str(problem.size), problem.snapshot, guess),
                    name=(),
                    subject=problem.problem_label,
                    title=words,
                    series=series,
                    bands={"gap": [ShadedBand(0.0, problem.roundoff_gap, "round-off")]} if shaded else {},
                    notes=_describe_convergence(problem, curves, newest_fingerprint),
                    sheet="-".join((problem.scene, str(problem.size), problem.snapshot, problem.problem_digest)),
                )
            )
    return ChartDescription(
        title="Convergence",
        note="Energy gap (g − g*) / (g₀ − g*) to the lowest known minimum; vertex errors to the minimum that was "
        "reached. Times are medians over the rounds with their quartiles.",
        frames=frames,
        x=(
            ChartAxis("seconds", AxisScale("wall time", "log", "time"), "time"),
            ChartAxis("iteration", AxisScale("iterations", "iterations", "plain"), "iterations"),
        ),
        y=(
            ChartAxis("gap", AxisScale("energy gap (g − g*) / (g₀ − g*)", "log", "power"), "gap"),
            ChartAxis(
                "max_vertex_error", AxisScale("largest vertex error [mean rest lengths]", "log", "power"), "largest"
            ),
            ChartAxis(
                "stationarity",
                AxisScale("stationarity |Q⁻¹∇g|, relative to the start", "log", "power"),
                "stationarity",
            ),
            ChartAxis(
                "max_vertex_error_m",
                AxisScale("largest vertex error [m]", "log", "power"),
                "metres",
                is_on_sheets=False,
            ),
        ),
        subject_key="problem",
        hover=(
            *(("iteration", "iteration"), ("seconds", "wall time"), ("gap", "gap"), ("stationarity", "stationarity")),
            *(("max_vertex_error", "largest error, rest lengths"), ("max_vertex_error_m", "largest error, m")),
            *(("minimum_index", "minimum reached"), ("status", "status")),
        ),
        **_shared_fields(table, {curve.label: curve.citation for curve in table.curves}),
    )


def _build_convergence_series(
    curve: ConvergenceCurve, style: SeriesStyle, newest_fingerprint: str | None, link_source: SourceLinks
) -> ChartSeries:
    early, seconds, late = np.quantile(curve.seconds, (0.25, 0.5, 0.75), axis=0)
    errors = {
        "gap": curve.gap,
        "max_vertex_error": curve.max_vertex_error,
        "stationarity": curve.stationarity,
        "max_vertex_error_m": curve.max_vertex_error * curve.problem.mean_rest_length,
    }
    callouts = {len(curve.iterations) - 1: f"minimum {curve.minimum_index}"} if curve.minimum_index else {}
    return ChartSeries(
        label=curve.label,
        style=style,
        columns={
            "seconds": seconds,
            "seconds_low": early,
            "seconds_high": late,
            "iteration": curve.iterations,
            **{name: np.maximum(values, _MIN_ERROR) for name, values in errors.items()},
            "minimum_index": ["none" if curve.minimum_index is None else str(curve.minimum_index)] * len(seconds),
            "status": [curve.status] * len(seconds),
        },
        description=f"{curve.problem.problem_label}, {INITIAL_GUESS_LABELS[curve.initial_guess]}",
        stale=is_stale(curve.source_fingerprint, newest_fingerprint),
        status=curve.status,
        callouts=callouts,
        identity=(curve.label, curve.parameters),
        links={"parameters": curve.parameters, **link_source(curve)},
    )


def _describe_convergence(
    problem: SnapshotProblem, curves: Sequence[ConvergenceCurve], newest_fingerprint: str | None
) -> list[str]:
    """Describe doubts about the reference, stale curves, early ends and other minima."""
    remarks = [
        f"{format_count(problem.vertices)} vertices, {problem.integrator}, dt {format_time_step(problem.time_step)}, "
        f"k dt²/m = {format_quantity(problem.stiffness_ratio)}, "
        f"mean rest length {format_quantity(problem.mean_rest_length)} m."
    ]
    remarks += [f"Reference not certified: {problem.uncertified_reason}."] if problem.uncertified_reason else []
    by: dict[str, list[str]] = {}
    for curve in curves:
        if curve.status != "ok":
            by.setdefault(f"× Ended early ({curve.status})", []).append(curve.label)
        if curve.minimum_index:
            words = f"In minimum {curve.minimum_index}, higher than the lowest known; vertex errors refer to it"
            by.setdefault(words, []).append(curve.label)
    remarks += [f"{how}: {', '.join(labels)}." for how, labels in sorted(by.items())]
    return [*remarks, *describe_hollow_marks(curves, newest_fingerprint)]


def build_time_chart(table: AccuracyData, newest_fingerprint: str | None = None) -> ChartDescription:
    """Build the chart of the time to each accuracy, without set-up and with amortised set-up.

    Args:
        table: data of an accuracy measurement; steps without a certified minimum are left out.
        newest_fingerprint: source fingerprint of the newest rows, others are stale; None for that of this version.
    """
    styles = _assign_styles(table.curves)
    frames: list[ChartFrame] = []
    for scene, size, mesh in dict.fromkeys((p.scene, p.size, p.mesh_label) for p in table.problems):
        problems = [p for p in table.problems if (p.scene, p.size) == (scene, size)]
        sure = [c for c in table.curves if c.problem in problems and not c.problem.uncertified_reason]
        for guess, words in INITIAL_GUESS_LABELS.items():
            here = [curve for curve in sure if curve.initial_guess == guess]
            if not here:
                continue
            frames.append(
                ChartFrame(
                    group=(scene, str(size), guess),
                    name=(),
                    subject=mesh,
                    title=words,
                    series=[*_build_time_series(here, styles, newest_fingerprint)],
                    notes=[
                        *(f"{sentence}." for sentence in describe_excluded_steps(problems)),
                        *describe_hollow_marks(here, newest_fingerprint),
                    ],
                    sheet=mesh.replace(" ", "-"),
                )
            )
    over = {f"over-{n}": f"set-up over {format_count(n)} step{'s' if n > 1 else ''}" for n in AMORTISATION_STEPS}
    names = {"alone": "the step alone"} | over
    gaps = AxisScale("energy gap to be reached", "names", place_names=tuple(map(format_power, GAP_TARGETS)))
    return ChartDescription(
        title="Time to accuracy",
        note="Median over the rounds and over the steps of the mesh; no gap below the end of a line is reached.",
        frames=frames,
        x=(ChartAxis("target", gaps),),
        y=tuple(ChartAxis(name, AxisScale("wall time", "log", "time"), name, words) for name, words in names.items()),
        subject_key="scene",
        hover=(("gap", "gap"), *((name, f"wall time, {words}") for name, words in names.items())),
        **_shared_fields(table, {curve.label: curve.citation for curve in table.curves}),
    )


def _build_time_series(
    curves: Sequence[ConvergenceCurve], styles: Mapping[str, SeriesStyle], newest_fingerprint: str | None
) -> Iterator[ChartSeries]:
    for label in dict.fromkeys(curve.label for curve in curves):
        own = [curve for curve in curves if curve.label == label]
        columns: dict[str, Any] = {}
        for steps in (None, *AMORTISATION_STEPS):
            times = np.array([compute_median_time(own, target, steps) for target in GAP_TARGETS])
            columns["alone" if steps is None else f"over-{steps}"] = np.where(
                np.isfinite(times) & (times > 0.0), times, np.nan
            )
        if any(np.isfinite(values).any() for values in columns.values()):
            columns |= {"target": np.arange(len(GAP_TARGETS)), "gap": [format_gap(target) for target in GAP_TARGETS]}
            many = len({id(curve.problem) for curve in own})
            yield ChartSeries(
                label,
                styles[label],
                columns,
                description=f"{own[0].problem.mesh_label}, {many} step{'s' if many > 1 else ''}",
                stale=any(is_stale(curve.source_fingerprint, newest_fingerprint) for curve in own),
                identity=(label, own[0].parameters),
                links={"parameters": own[0].parameters},
            )


def build_work_precision_chart(table: AccuracyData, newest_fingerprint: str | None = None) -> ChartDescription:
    """Build the chart of error against wall time of whole simulations.

    It has a frame for each mesh and integrator.

    Args:
        table: data of an accuracy measurement.
        newest_fingerprint: source fingerprint of the newest rows, others are stale; None for that of this version.
    """
    works = [work for work in table.work_points if is_complete(work)]
    styles = _assign_styles(table.work_points)
    frames: list[ChartFrame] = []
    for scene, size, mesh in dict.fromkeys((w.scene, w.size, w.mesh_label) for w in works):
        here = [w for w in works if (w.scene, w.size) == (scene, size)]
        shown = [w for w in here if w.error < _MAX_DRAWN_ERROR] or here
        for integrator in dict.fromkeys(w.integrator for w in here):
            own = [w for w in shown if w.integrator == integrator]
            exploded = sum(w.integrator == integrator for w in here) - len(own)
            tolerances = sorted({w.residual_rtol for w in own if w.residual_rtol is not None}, reverse=True)
            notes = ["Joined points differ in the time step, or in the substeps alone."]
            if len(tolerances) > 1:
                stated = ", ".join(format_power(t) if t else "auto" for t in tolerances)
                notes.append(f"Larger marks: tighter tolerances, {stated}.")
            if not all(w.is_minimiser for w in own):
                notes.append("† does not minimise the step's objective: its limit is not that of the integrator.")
            notes += [f"Not drawn: {exploded} simulations that exploded."] if exploded else []
            frames.append(
                ChartFrame(
                    group=(scene, str(size)),
                    name=(integrator,),
                    subject=f"{mesh}, {format_quantity(here[0].t_end)} s",
                    title=integrator,
                    series=[
                        _build_front_series(here),
                        *_build_step_size_series(own, styles, tolerances, newest_fingerprint),
                    ],
                    notes=[
                        *(*notes, "Grey: the least error that a budget buys, by any integrator."),
                        *(*describe_self_converged(own), *describe_hollow_marks(own, newest_fingerprint)),
                    ],
                    sheet=mesh.replace(" ", "-"),
                )
            )
    return ChartDescription(
        title="Work and precision",
        note="Error of the positions against wall time of the whole simulation.",
        frames=frames,
        x=(ChartAxis("seconds", AxisScale(COST_LABEL, "log", "time")),),
        y=(ChartAxis("error", AxisScale(ERROR_LABEL, "log", "percent")),),
        subject_key="scene",
        hover=(("time_step", "time step"), ("error", "relative error"), ("seconds", COST_LABEL)),
        **_shared_fields(table, {_label_work(work): work.citation for work in table.work_points}),
    )


def _build_front_series(works: Sequence[WorkPoint]) -> ChartSeries:
    best = find_pareto_front(works)
    columns = {
        "seconds": [work.seconds_per_simulated_second for work in best],
        "error": [work.error for work in best],
        "time_step": [work.setting_label for work in best],
    }
    return ChartSeries(
        "best of all", SeriesStyle("#b9b6af", "None"), columns, description="Pareto front", is_stepped=True
    )


def _build_step_size_series(
    works: Sequence[WorkPoint],
    styles: Mapping[str, SeriesStyle],
    tolerances: Sequence[float],
    newest_fingerprint: str | None,
) -> Iterator[ChartSeries]:
    """Yield a series per group of simulations that differ only in time step or substeps."""
    default, divided = find_default_setting(works), _find_substep_labels(works)
    chains: dict[tuple[Any, ...], list[WorkPoint]] = {}
    for one in works:
        shared = one.time_step if one.label in divided else one.max_iterations
        chains.setdefault((one.label, one.residual_rtol, shared, one.initial_guess), []).append(one)
    for (label, tolerance, *_), members in chains.items():
        members.sort(key=lambda one: (one.time_step, -one.max_iterations))
        stop = format_stop_rule(tolerance, members[0].max_iterations)
        yield ChartSeries(
            _label_work(members[0]),
            styles[label],
            columns={
                "seconds": [one.seconds_per_simulated_second for one in members],
                "error": [one.error for one in members],
                "time_step": [format_time_step(one.time_step) for one in members],
            },
            description=f"{members[0].mesh_label}, {members[0].integrator}, {stop}",
            stale=[is_stale(one.source_fingerprint, newest_fingerprint) for one in members],
            setting=stop,
            marker_scale=1.0 + 0.25 * tolerances.index(tolerance) if tolerance in tolerances else 0.75,
            callouts={k: "the default" for k, one in enumerate(members) if one is default},
            identity=(_label_work(members[0]), stop, members[0].parameters),
            links={"parameters": members[0].parameters},
        )


def _label_work(work: WorkPoint) -> str:
    """Return the label of a simulation; a dagger marks methods that do not minimise."""
    return work.label if work.is_minimiser else f"{work.label} †"


def _find_substep_labels(works: Iterable[WorkPoint]) -> set[str]:
    """Find the labels of methods that were measured with several numbers of substeps."""
    tried: dict[str, set[int]] = {}
    for work in works:
        if work.is_substepping:
            tried.setdefault(work.label, set()).add(work.max_iterations)
    return {label for label, numbers in tried.items() if len(numbers) > 1}


def build_profile_chart(table: AccuracyData, newest_fingerprint: str | None = None) -> ChartDescription:
    """Build the chart of performance and data profiles, with a frame for each accuracy.

    Args:
        table: data of an accuracy measurement.
        newest_fingerprint: source fingerprint of the newest rows, others are stale; None for that of this version.
    """
    baseline = find_baseline_solver(table)
    kinds = {"performance": ("time, over the fastest solver's", compute_performance_ratios)}
    if baseline:
        kinds["data"] = (f"time, in iterations of {baseline}", compute_data_profile_ratios)
    styles = _assign_styles(table.curves)
    frames: list[ChartFrame] = []
    notes = [*describe_omitted_solvers(table), *describe_stale_results(table.curves, newest_fingerprint)]
    for kind, (words, ratios) in kinds.items():
        for target in GAP_TARGETS:
            problems = len(group_solvable_curves(table, target))
            found = {label: values for label, values in ratios(table, target).items() if np.isfinite(values).any()}
            if found and problems:
                frames.append(
                    ChartFrame(
                        group=(kind,),
                        name=(format_gap(target),),
                        subject=f"to a gap of {format_power(target)}: {problems} problems",
                        title=f"{kind} profile",
                        series=[*_build_profile_series(found, styles)],
                        notes=notes,
                        x_label=words,
                    )
                )
    return ChartDescription(
        title="Performance and data profiles",
        note="The share of the problems solved within a multiple of a time: that of the fastest solver, or of one "
        "plain local-global iteration. Of the step alone, set-up apart; what failed is never solved.",
        frames=frames,
        x=(ChartAxis("ratio", AxisScale("multiple of the time", "log", "plain")),),
        y=(ChartAxis("share", AxisScale("share of the problems solved", "linear", "percent")),),
        subject_key="gap",
        hover=(("ratio", "multiple"), ("share", "share")),
        **_shared_fields(table, {curve.label: curve.citation for curve in table.curves}),
    )


def _build_profile_series(ratios: Mapping[str, FloatArray], styles: Mapping[str, SeriesStyle]) -> Iterator[ChartSeries]:
    known = np.concatenate([values[np.isfinite(values)] for values in ratios.values()])
    low, high = known.min(initial=1.0), 2.0 * known.max(initial=5.0)
    for label, values in ratios.items():
        x = np.unique([low, *values[np.isfinite(values)], high])
        columns = {"ratio": x, "share": compute_cumulative_share(values, x)}
        yield ChartSeries(label, styles[label], columns, description=f"{len(values)} problems", is_stepped=True)


def build_scaling_chart(table: AccuracyData, newest_fingerprint: str | None = None) -> ChartDescription:
    """Build the chart of time to a gap against the number of vertices.

    Args:
        table: data of an accuracy measurement.
        newest_fingerprint: source fingerprint of the newest rows, others are stale; None for that of this version.
    """
    styles = _assign_styles(table.curves)
    found = [one for one in fit_scalings(table, newest_fingerprint) if one.vertices]
    citations = {curve.label: curve.citation for curve in table.curves}
    frames: list[ChartFrame] = []
    for scene, guess in dict.fromkeys((one.scene, one.initial_guess) for one in found):
        here = [one for one in found if (one.scene, one.initial_guess) == (scene, guess)]
        lost = [
            f"Not reached by {one.label} at {', '.join(map(str, one.unsolved_sizes))} vertices."
            for one in here
            if one.unsolved_sizes
        ]
        problems = [problem for problem in table.problems if problem.scene == scene]
        frames.append(
            ChartFrame(
                group=(scene, guess),
                name=("growth",),
                subject=scene,
                title=INITIAL_GUESS_LABELS[guess],
                series=[_build_scaling_series(one, styles[one.label]) for one in here],
                notes=[
                    *(*(f"{sentence}." for sentence in describe_excluded_steps(problems)), *lost),
                    *([STALE_NOTE] if newest_fingerprint is None and any(any(one.stale) for one in here) else []),
                ],
            )
        )
    return ChartDescription(
        title=f"Growth with size: time to a gap of {format_gap(GAP_TARGET)}",
        note="Median over the steps of a mesh, set-up apart. Powers are fitted to three sizes or more.",
        frames=frames,
        x=(ChartAxis("vertices", AxisScale("vertices", "sizes", "plain")),),
        y=(ChartAxis("seconds", AxisScale(f"wall time to a gap of {format_power(GAP_TARGET)}", "log", "time")),),
        subject_key="scene",
        hover=(("vertices", "vertices"), ("seconds", "wall time"), ("exponent", "fitted power")),
        **_shared_fields(table, {_label_scaling(one): citations[one.label] for one in found}),
    )


def _build_scaling_series(one: SizeScaling, style: SeriesStyle) -> ChartSeries:
    power = f"{one.exponent:.2f}" if np.isfinite(one.exponent) else ""
    return ChartSeries(
        _label_scaling(one),
        style,
        {
            "vertices": one.vertices,
            "seconds": one.seconds,
            "exponent": [power or "too few sizes"] * len(one.vertices),
        },
        description=f"{one.scene}, {INITIAL_GUESS_LABELS[one.initial_guess]}",
        stale=one.stale,
    )


def _label_scaling(one: SizeScaling) -> str:
    return one.label + (f" n^{one.exponent:.2f}" if np.isfinite(one.exponent) else "")


def _assign_styles(measured: Iterable[ConvergenceCurve | WorkPoint]) -> dict[str, SeriesStyle]:
    return assign_label_styles((one.label, one.solver) for one in measured)


def describe_hollow_marks(
    measured: Iterable[ConvergenceCurve | WorkPoint], newest_fingerprint: str | None
) -> list[str]:
    """Explain hollow marks in a note; the results page has its own explanation.

    Args:
        measured: curves or simulations of a chart.
        newest_fingerprint: code of the newest rows, as on the page; None on other charts.

    Returns:
        One note where a measurement is stale; empty on the page.
    """
    is_shown = newest_fingerprint is None and any(is_stale(one.source_fingerprint) for one in measured)
    return [STALE_NOTE] if is_shown else []


def _shared_fields(table: AccuracyData, citations: Mapping[str, str]) -> dict[str, Any]:
    machine_words = ", ".join(table.machine_words)
    return {"machine_words": machine_words, "citations": citations, "command": ACCURACY_COMMAND}
