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

from harness.report.accuracy.convergence import GUESSES
from harness.report.accuracy.growth import TARGET, growths
from harness.report.accuracy.measured import (
    Curve,
    Measurements,
    WorkPoint,
    by_other_code,
    by_self_converged,
    stop_words,
    without_short,
)
from harness.report.accuracy.pictures import nearest, place
from harness.report.accuracy.profiles import iteration_ratios, least_ratios, not_shown, share
from harness.report.accuracy.times import STEPS, TARGETS, power, reach, seconds_to
from harness.report.page import step_words
from harness.report.site import engines, paper, winners
from harness.report.site.marks import axis, drawn
from harness.report.site.runs import references
from harness.report.site.script import numbers as _numbers
from harness.report.style import looks

Item = dict[str, Any]

_COMMAND = "springbench accuracy CONFIG --again"
_SHARES = {"range": [-0.02, 1.05], "tickformat": ".0%"}


def charts(everything: Measurements, folder: Path) -> dict[str, Item]:
    """Build the charts with data in the rows, by their ids.

    Args:
        everything: data of an accuracy measurement.
        folder: folder of the sweep's results.
    """
    table = without_short(everything)
    pictures: dict[str, Item] = {}
    for problem in table.problems:
        path, best = place(problem, Path("report/meshes")), nearest(table, problem, folder)
        if best and (folder / path).is_file():
            pictures[problem.digest] = {"path": path.as_posix(), "of": best.label, "recording": best.recording}
    made = {
        "convergence": _convergence(table, pictures, folder),
        "times": _times(table, pictures),
        "work": _work(table),
        "profiles": _profiles(table),
        "growth": _growth(table),
    }
    everyone = (*table.curves, *table.works)
    marks = {label: drawn(mark) for label, mark in looks((each.label, each.solver) for each in everyone).items()}
    shared = {"marks": marks, "references": references((each.label, each.reference) for each in everyone)}
    made = {name: chart | shared for name, chart in made.items()}
    made |= {"winners": winners.chart(table), "engines": engines.chart(table), "liu2013": paper.chart(everything)}
    return {name: chart | {"command": _COMMAND} for name, chart in made.items() if chart["items"]}


def _run(table: Measurements, curve: Curve, pictures: Mapping[str, Item]) -> Item:
    """Build the fields that all items of a curve share."""
    return {
        "label": curve.label,
        "what": f"{curve.problem.name}, {GUESSES.get(curve.first_guess, curve.first_guess)}",
        "problem": curve.problem.name + (" (reference not certified)" if curve.problem.doubt else ""),
        "parameters": curve.parameters,
        "panel": GUESSES.get(curve.first_guess, curve.first_guess),
        "picture": pictures.get(curve.problem.digest),
        "recording": curve.recording,
        "older": curve.code != table.newest,
    }


def _convergence(table: Measurements, pictures: Mapping[str, Item], folder: Path) -> Item:
    items: list[Item] = []
    for curve in table.curves:
        run = _run(table, curve, pictures)
        if run["recording"] and not (folder / run["recording"]).is_file():
            run["recording"] = ""
        columns = {
            "iteration": curve.iterations,
            "seconds": np.median(curve.seconds, axis=0),
            "gap": np.where(curve.gap > 0, curve.gap, np.nan),
            "largest": curve.largest,
            "metres": curve.largest * curve.problem.mean_rest_length,
            "stationarity": curve.stationarity,
        }
        branch = "none" if curve.branch is None else str(curve.branch)
        numbers = {name: _numbers(values) for name, values in columns.items()}
        items.append(
            {**run, **numbers, "minimum": branch, "status": curve.status, "round_off": curve.problem.round_off}
        )
    hover = [["iteration", "iteration"], ["gap", "gap"], ["largest", "largest error, rest lengths"]]
    hover += [["metres", "largest error, m"], ["stationarity", "stationarity"], ["seconds", "seconds"]]
    return {
        "title": "Convergence",
        "note": "Energy gap (g − g*)/(g0 − g*) against the lowest minimum known; vertex errors against the minimum "
        "that was reached. A cross ends a curve that failed or met a limit.",
        "filters": ["problem"],
        "x": [axis("iteration", "iterations"), axis("seconds", "wall seconds")],
        "y": [
            axis("gap", "energy gap"),
            axis("largest", "largest vertex error, mean rest lengths"),
            axis("metres", "largest vertex error, m"),
            axis("stationarity", "stationarity"),
        ],
        "hover": [*hover, ["minimum", "minimum reached"], ["status", "status"]],
        "items": items,
    }


def _times(table: Measurements, pictures: Mapping[str, Item]) -> Item:
    items: list[Item] = []
    for curve in table.curves:
        found = [reach(curve, target) for target in TARGETS]
        if not any(found):
            continue
        columns = {f"over {steps}": _numbers(seconds_to(curve, t, steps) for t in TARGETS) for steps in STEPS}
        items.append(
            _run(table, curve, pictures)
            | columns
            | {
                "target": [power(target) for target in TARGETS],
                "alone": _numbers(r.seconds if r and r.seconds > 0 else np.nan for r in found),
                "iteration": _numbers(r.iteration if r else np.nan for r in found),
                "set_up": curve.warm if np.isfinite(curve.warm) else None,
            }
        )
    shown = [axis("alone", "seconds, the step alone")]
    shown += [axis(f"over {n}", f"seconds, set-up over {n} step{'s' if n > 1 else ''}") for n in STEPS]
    return {
        "title": "Time to accuracy",
        "note": "Median over the rounds; where a line ends the solver goes no further.",
        "filters": ["problem"],
        "x": [axis("target", "energy gap", {"type": "category"})],
        "y": shown,
        "hover": [["target", "gap"], ["iteration", "iterations"], ["alone", "seconds alone"], ["set_up", "set-up, s"]],
        "items": items,
    }


def _work(table: Measurements) -> Item:
    chains: dict[tuple[Any, ...], list[WorkPoint]] = {}
    for w in table.works:
        if w.status == "ok":
            chains.setdefault((w.mesh, w.label, w.integrator, w.tolerance, w.iterations, w.first_guess), []).append(w)
    items: list[Item] = []
    for (mesh, label, integrator, tolerance, iterations, _), members in chains.items():
        members.sort(key=lambda work: work.time_step)
        stop = stop_words(tolerance, iterations)
        items.append(
            {
                "label": label,
                "what": f"{mesh}, {integrator}, {stop} a step",
                "scene": mesh,
                "parameters": members[0].parameters,
                "panel": integrator,
                "small": tolerance is None,
                "older": [work.code != table.newest for work in members],
                "seconds": _numbers(work.seconds for work in members),
                "error": _numbers(work.error for work in members),
                "step": [step_words(work.time_step) for work in members],
            }
        )
    return {
        "title": "Work and precision",
        "note": "Total error of the positions at the horizon against wall time; a line joins time steps, small marks "
        f"do a fixed number of iterations. {' '.join(by_self_converged(table.works))}",
        "filters": ["scene"],
        "x": [axis("seconds", "wall seconds a simulated second")],
        "y": [axis("error", "relative error")],
        "hover": [["step", "time step"], ["error", "relative error"], ["seconds", "seconds a simulated second"]],
        "items": items,
    }


def _profiles(table: Measurements) -> Item:
    kinds = {"performance profile": least_ratios, "data profile": iteration_ratios}
    items: list[Item] = []
    for kind, ratios in kinds.items():
        for target in TARGETS:
            for label, values in ratios(table, target).items():
                finite = np.unique(values[np.isfinite(values)])
                items.append(
                    {
                        "label": label,
                        "what": f"{len(values)} problems, to a gap of {power(target)}",
                        "parameters": "{}",
                        "gap": power(target),
                        "panel": kind,
                        "ratio": _numbers(finite),
                        "share": _numbers(share(values, finite)),
                    }
                )
    more = [*not_shown(table), *by_other_code(table.curves, table.newest)]
    return {
        "title": "Performance and data profiles",
        "note": "The share of the problems solved within a multiple of the fastest solver's time, and of the time of "
        f"one plain local-global iteration. What failed is never solved. {' '.join(more)}",
        "filters": ["gap"],
        "x": [axis("ratio", "multiple")],
        "y": [axis("share", "share of the problems solved", _SHARES)],
        "hover": [["ratio", "multiple"], ["share", "share"]],
        "shape": "hv",
        "items": items,
    }


def _growth(table: Measurements) -> Item:
    items = [
        {
            "label": growth.label,
            "what": f"{growth.scene}, {GUESSES[growth.first_guess]}",
            "parameters": "{}",
            "scene": growth.scene,
            "panel": GUESSES[growth.first_guess],
            "vertices": growth.vertices,
            "seconds": _numbers(growth.seconds),
            "older": growth.older,
            "exponent": "too few sizes" if np.isnan(growth.exponent) else f"{growth.exponent:.2f}",
        }
        for growth in growths(table, lambda curve: curve.code != table.newest)
    ]
    return {
        "title": f"Growth with size: time to a gap of {power(TARGET)}",
        "note": "Median over the steps of a mesh, set-up apart.",
        "filters": ["scene"],
        "x": [axis("vertices", "vertices")],
        "y": [axis("seconds", "seconds")],
        "hover": [["vertices", "vertices"], ["seconds", "seconds"], ["exponent", "fitted power"]],
        "items": items,
    }
