"""Charts of an accuracy measurement for the results page.

These are convergence, time to accuracy, work-precision, profiles, scaling, winners and engines. A chart is a list of
items, each a line with its solver, a description, and named columns of numbers. The page filters items by `filters`,
draws one panel per `panel`, and shows the selected columns.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from springbench.harness.report.accuracy.accuracy_data import (
    AccuracyData,
    ConvergenceCurve,
    WorkPoint,
    describe_self_converged,
    describe_stale_results,
    format_stop_rule,
    without_short_curves,
)
from springbench.harness.report.accuracy.convergence_plot import INITIAL_GUESS_LABELS
from springbench.harness.report.accuracy.performance_profiles import (
    cumulative_share,
    data_profile_ratios,
    describe_omitted_solvers,
    performance_ratios,
)
from springbench.harness.report.accuracy.size_scaling import GAP_TARGET, fit_scalings
from springbench.harness.report.accuracy.snapshot_pictures import find_closest_solve, snapshot_picture_path
from springbench.harness.report.accuracy.time_to_accuracy import (
    AMORTISATION_STEPS,
    GAP_TARGETS,
    amortised_seconds,
    find_time_to_accuracy,
    format_gap,
)
from springbench.harness.report.number_format import format_time_step
from springbench.harness.report.plot_style import assign_label_styles
from springbench.harness.report.site import engine_chart, liu2013_chart, winner_chart
from springbench.harness.report.site.data_scripts import round_numbers as _numbers
from springbench.harness.report.site.plotly_styles import axis_choice, plotly_style
from springbench.harness.report.site.run_table import format_references

ChartItem = dict[str, Any]

_ACCURACY_COMMAND = "springbench accuracy CONFIG --rerun"
_SHARE_AXIS = {"range": [-0.02, 1.05], "tickformat": ".0%"}


def build_accuracy_charts(all_data: AccuracyData, folder: Path) -> dict[str, ChartItem]:
    """Build the charts with data in the rows, by their ids.

    Args:
        all_data: data of an accuracy measurement.
        folder: folder of the sweep's results.
    """
    table = without_short_curves(all_data)
    pictures: dict[str, ChartItem] = {}
    for problem in table.problems:
        path, best = snapshot_picture_path(problem, Path("report/meshes")), find_closest_solve(table, problem, folder)
        if best and (folder / path).is_file():
            pictures[problem.problem_digest] = {
                "path": path.as_posix(),
                "reference_label": best.label,
                "recording_path": best.recording_path,
            }
    made = {
        "convergence": _build_convergence_chart(table, pictures, folder),
        "times": _build_time_chart(table, pictures),
        "work": _build_work_precision_chart(table),
        "profiles": _build_profile_chart(table),
        "growth": _build_scaling_chart(table),
    }
    everyone = (*table.curves, *table.work_points)
    marks = {
        label: plotly_style(mark)
        for label, mark in assign_label_styles((each.label, each.solver) for each in everyone).items()
    }
    shared = {"styles": marks, "citations": format_references((each.label, each.citation) for each in everyone)}
    made = {name: chart | shared for name, chart in made.items()}
    made |= {
        "winners": winner_chart.build_winner_chart(table),
        "engines": engine_chart.build_engine_chart(table),
        "liu2013": liu2013_chart.build_liu2013_chart(all_data),
    }
    return {name: chart | {"command": _ACCURACY_COMMAND} for name, chart in made.items() if chart["items"]}


def _build_curve_item(table: AccuracyData, curve: ConvergenceCurve, pictures: Mapping[str, ChartItem]) -> ChartItem:
    """Build the fields that all items of a curve share."""
    guess = INITIAL_GUESS_LABELS.get(curve.initial_guess, curve.initial_guess)
    return {
        "label": curve.label,
        "description": f"{curve.problem.problem_label}, {guess}",
        "problem": curve.problem.problem_label
        + (" (reference not certified)" if curve.problem.uncertified_reason else ""),
        "parameters": curve.parameters,
        "panel": guess,
        "mesh_picture": pictures.get(curve.problem.problem_digest),
        "recording_path": curve.recording_path,
        "stale": curve.source_fingerprint != table.newest_fingerprint,
    }


def _build_convergence_chart(table: AccuracyData, pictures: Mapping[str, ChartItem], folder: Path) -> ChartItem:
    items: list[ChartItem] = []
    for curve in table.curves:
        run = _build_curve_item(table, curve, pictures)
        if run["recording_path"] and not (folder / run["recording_path"]).is_file():
            run["recording_path"] = ""
        columns = {
            "iteration": curve.iterations,
            "seconds": np.median(curve.seconds, axis=0),
            "gap": np.where(curve.gap > 0, curve.gap, np.nan),
            "max_vertex_error": curve.max_vertex_error,
            "max_vertex_error_m": curve.max_vertex_error * curve.problem.mean_rest_length,
            "stationarity": curve.stationarity,
        }
        branch = "none" if curve.minimum_index is None else str(curve.minimum_index)
        numbers = {name: _numbers(values) for name, values in columns.items()}
        items.append(
            {
                **run,
                **numbers,
                "minimum_index": branch,
                "status": curve.status,
                "roundoff_gap": curve.problem.roundoff_gap,
            }
        )
    hover = [["iteration", "iteration"], ["gap", "gap"], ["max_vertex_error", "largest error, rest lengths"]]
    hover += [["max_vertex_error_m", "largest error, m"], ["stationarity", "stationarity"], ["seconds", "seconds"]]
    return {
        "title": "Convergence",
        "note": "Energy gap (g − g*)/(g0 − g*) against the lowest minimum known; vertex errors against the minimum "
        "that was reached. A cross ends a curve that failed or met a limit.",
        "filters": ["problem"],
        "x": [axis_choice("iteration", "iterations"), axis_choice("seconds", "wall seconds")],
        "y": [
            axis_choice("gap", "energy gap"),
            axis_choice("max_vertex_error", "largest vertex error, mean rest lengths"),
            axis_choice("max_vertex_error_m", "largest vertex error, m"),
            axis_choice("stationarity", "stationarity"),
        ],
        "hover": [*hover, ["minimum_index", "minimum reached"], ["status", "status"]],
        "items": items,
    }


def _build_time_chart(table: AccuracyData, pictures: Mapping[str, ChartItem]) -> ChartItem:
    items: list[ChartItem] = []
    for curve in table.curves:
        found = [find_time_to_accuracy(curve, target) for target in GAP_TARGETS]
        if not any(found):
            continue
        columns = {
            f"over {steps}": _numbers(amortised_seconds(curve, t, steps) for t in GAP_TARGETS)
            for steps in AMORTISATION_STEPS
        }
        items.append(
            _build_curve_item(table, curve, pictures)
            | columns
            | {
                "target": [format_gap(target) for target in GAP_TARGETS],
                "step_seconds": _numbers(r.seconds if r and r.seconds > 0 else np.nan for r in found),
                "iteration": _numbers(r.iteration if r else np.nan for r in found),
                "setup_seconds": curve.warm_seconds if np.isfinite(curve.warm_seconds) else None,
            }
        )
    shown = [axis_choice("step_seconds", "seconds, the step alone")]
    shown += [
        axis_choice(f"over {n}", f"seconds, set-up over {n} step{'s' if n > 1 else ''}") for n in AMORTISATION_STEPS
    ]
    return {
        "title": "Time to accuracy",
        "note": "Median over the rounds; where a line ends the solver goes no further.",
        "filters": ["problem"],
        "x": [axis_choice("target", "energy gap", {"type": "category"})],
        "y": shown,
        "hover": [
            ["target", "gap"],
            ["iteration", "iterations"],
            ["step_seconds", "seconds alone"],
            ["setup_seconds", "set-up, s"],
        ],
        "items": items,
    }


def _build_work_precision_chart(table: AccuracyData) -> ChartItem:
    chains: dict[tuple[Any, ...], list[WorkPoint]] = {}
    for w in table.work_points:
        if w.status == "ok":
            chains.setdefault(
                (w.mesh_label, w.label, w.integrator, w.residual_rtol, w.max_iterations, w.initial_guess), []
            ).append(w)
    items: list[ChartItem] = []
    for (mesh, label, integrator, tolerance, iterations, _), members in chains.items():
        members.sort(key=lambda work: work.time_step)
        stop = format_stop_rule(tolerance, iterations)
        items.append(
            {
                "label": label,
                "description": f"{mesh}, {integrator}, {stop} a step",
                "scene": mesh,
                "parameters": members[0].parameters,
                "panel": integrator,
                "small": tolerance is None,
                "stale": [work.source_fingerprint != table.newest_fingerprint for work in members],
                "seconds": _numbers(work.seconds_per_simulated_second for work in members),
                "error": _numbers(work.error for work in members),
                "step": [format_time_step(work.time_step) for work in members],
            }
        )
    return {
        "title": "Work and precision",
        "note": "Total error of the positions at the horizon against wall time; a line joins time steps, small marks "
        f"do a fixed number of iterations. {' '.join(describe_self_converged(table.work_points))}",
        "filters": ["scene"],
        "x": [axis_choice("seconds", "wall seconds a simulated second")],
        "y": [axis_choice("error", "relative error")],
        "hover": [["step", "time step"], ["error", "relative error"], ["seconds", "seconds a simulated second"]],
        "items": items,
    }


def _build_profile_chart(table: AccuracyData) -> ChartItem:
    kinds = {"performance profile": performance_ratios, "data profile": data_profile_ratios}
    items: list[ChartItem] = []
    for kind, ratios in kinds.items():
        for target in GAP_TARGETS:
            for label, values in ratios(table, target).items():
                finite = np.unique(values[np.isfinite(values)])
                items.append(
                    {
                        "label": label,
                        "description": f"{len(values)} problems, to a gap of {format_gap(target)}",
                        "parameters": "{}",
                        "gap": format_gap(target),
                        "panel": kind,
                        "ratio": _numbers(finite),
                        "share": _numbers(cumulative_share(values, finite)),
                    }
                )
    more = [*describe_omitted_solvers(table), *describe_stale_results(table.curves, table.newest_fingerprint)]
    return {
        "title": "Performance and data profiles",
        "note": "The share of the problems solved within a multiple of the fastest solver's time, and of the time of "
        f"one plain local-global iteration. What failed is never solved. {' '.join(more)}",
        "filters": ["gap"],
        "x": [axis_choice("ratio", "multiple")],
        "y": [axis_choice("share", "share of the problems solved", _SHARE_AXIS)],
        "hover": [["ratio", "multiple"], ["share", "share"]],
        "shape": "hv",
        "items": items,
    }


def _build_scaling_chart(table: AccuracyData) -> ChartItem:
    items = [
        {
            "label": growth.label,
            "description": f"{growth.scene}, {INITIAL_GUESS_LABELS[growth.initial_guess]}",
            "parameters": "{}",
            "scene": growth.scene,
            "panel": INITIAL_GUESS_LABELS[growth.initial_guess],
            "vertices": growth.vertices,
            "seconds": _numbers(growth.seconds),
            "stale": growth.stale,
            "exponent": "too few sizes" if np.isnan(growth.exponent) else f"{growth.exponent:.2f}",
        }
        for growth in fit_scalings(table, lambda curve: curve.source_fingerprint != table.newest_fingerprint)
    ]
    return {
        "title": f"Growth with size: time to a gap of {format_gap(GAP_TARGET)}",
        "note": "Median over the steps of a mesh, set-up apart.",
        "filters": ["scene"],
        "x": [axis_choice("vertices", "vertices")],
        "y": [axis_choice("seconds", "seconds")],
        "hover": [["vertices", "vertices"], ["seconds", "seconds"], ["exponent", "fitted power"]],
        "items": items,
    }
