"""One interactive page of all that was measured, in one file that needs no network: Plotly's script is in it.

A chart is a list of items, each a line with its solver, what it was, and named columns of numbers; the page's script
filters items by `filters`, puts them into a panel each `panel`, and draws the chosen columns.
"""

from __future__ import annotations

import html
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from plotly.offline import get_plotlyjs  # pyright: ignore[reportMissingTypeStubs]

from harness.base.files import replacing
from harness.report.accuracy.convergence import GUESSES
from harness.report.accuracy.growth import TARGET, growths
from harness.report.accuracy.measured import Curve, Measurements, WorkPoint, step_words
from harness.report.accuracy.profiles import iteration_ratios, least_ratios, not_shown, share
from harness.report.accuracy.times import STEPS, TARGETS, power, reach, seconds_to
from harness.report.references import cited
from harness.report.style import DASH_DOTTED, DASHED, DOTTED, STARS, Mark, looks

Item = dict[str, Any]

_SYMBOLS = {
    "o": "circle", "s": "square", "^": "triangle-up", "v": "triangle-down", "<": "triangle-left",
    ">": "triangle-right", "D": "diamond", "d": "diamond-tall", "P": "cross", "X": "x", "p": "pentagon",
    "h": "hexagon", "*": "star", "H": "hexagon2", "8": "octagon",
    STARS[0]: "star-diamond", STARS[1]: "hexagram", STARS[2]: "star-triangle-up", STARS[3]: "star-square",
    STARS[4]: "star-triangle-down",
}  # fmt: skip
_DASHES = {"-": "solid", DASHED: "dash", DOTTED: "dot", DASH_DOTTED: "dashdot"}

_LOG = {"type": "log"}
_SHARES = {"range": [-0.02, 1.05], "tickformat": ".0%"}


def write_page(
    path: Path,
    title: str,
    table: Measurements,
    *,
    pictures: Mapping[str, str],
    findings: Sequence[str],
    failures: Sequence[Item],
) -> None:
    """Write the page; pictures: of meshes by the digest of the problem, relative to the page.

    findings: sentences; failures: rows of a table, all with the same keys.
    """
    labels = [(c.label, c.solver) for c in table.curves] + [(w.label, w.solver) for w in table.works]
    data = {
        "marks": {label: _mark(mark) for label, mark in looks(labels).items()},
        "references": {each.label: cited(each.reference) for each in (*table.curves, *table.works)},
        "charts": [
            _convergence(table, pictures, path.parent),
            _times(table, pictures),
            _work(table.works),
            _profiles(table),
            _growth(table),
        ],
        "findings": findings,
        "failures": failures,
    }
    filled = Path(__file__).with_name("page.html").read_text(encoding="utf-8")
    # "</" would end the script that holds the data.
    words = {"__DATA__": json.dumps(data, allow_nan=False).replace("</", "<\\/"), "__PLOTLY__": get_plotlyjs()}
    words |= {"__TITLE__": html.escape(title), "__FACTS__": html.escape("   ·   ".join(table.machine))}
    for place in ("__TITLE__", "__FACTS__", "__DATA__", "__PLOTLY__"):
        filled = filled.replace(place, words[place])
    with replacing(path) as partial:
        partial.write_text(filled, encoding="utf-8")


def _mark(mark: Mark) -> dict[str, str]:
    return {"color": mark.color, "symbol": _SYMBOLS[mark.marker], "dash": _DASHES.get(mark.dash, "longdash")}


def _numbers(values: Iterable[float]) -> list[float | None]:
    """To five digits, which is more than a page shows; what is not finite is missing."""
    return [float(f"{value:.5g}") if np.isfinite(value) else None for value in values]


def _axis(column: str, title: str, axis: Mapping[str, Any] = _LOG) -> Item:
    return {"column": column, "title": title, "axis": axis}


def _run(curve: Curve, pictures: Mapping[str, str]) -> Item:
    """What all items of a curve say."""
    return {
        "label": curve.label,
        "what": f"{curve.problem.name}, {GUESSES.get(curve.first_guess, curve.first_guess)}",
        "problem": curve.problem.name + (" (reference not certified)" if curve.problem.doubt else ""),
        "parameters": curve.parameters,
        "panel": GUESSES.get(curve.first_guess, curve.first_guess),
        "picture": pictures.get(curve.problem.digest, ""),
        "recording": f"../{curve.recording}" if curve.recording else "",
    }


def _convergence(table: Measurements, pictures: Mapping[str, str], folder: Path) -> Item:
    items: list[Item] = []
    for curve in table.curves:
        run = _run(curve, pictures)
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
        "x": [_axis("iteration", "iterations"), _axis("seconds", "wall seconds")],
        "y": [
            _axis("gap", "energy gap"),
            _axis("largest", "largest vertex error, mean rest lengths"),
            _axis("metres", "largest vertex error, m"),
            _axis("stationarity", "stationarity"),
        ],
        "hover": [*hover, ["minimum", "minimum reached"], ["status", "status"]],
        "items": items,
    }


def _times(table: Measurements, pictures: Mapping[str, str]) -> Item:
    items: list[Item] = []
    for curve in table.curves:
        found = [reach(curve, target) for target in TARGETS]
        if not any(found):
            continue
        columns = {f"over {steps}": _numbers(seconds_to(curve, t, steps) for t in TARGETS) for steps in STEPS}
        items.append(
            _run(curve, pictures)
            | columns
            | {
                "target": [power(target) for target in TARGETS],
                "alone": _numbers(r.seconds if r and r.seconds > 0 else np.nan for r in found),
                "iteration": _numbers(r.iteration if r else np.nan for r in found),
                "set_up": curve.warm if np.isfinite(curve.warm) else None,
            }
        )
    shown = [_axis("alone", "seconds, the step alone")]
    shown += [_axis(f"over {n}", f"seconds, set-up over {n} step{'s' if n > 1 else ''}") for n in STEPS]
    return {
        "title": "Time to accuracy",
        "note": "Median over the rounds; where a line ends the solver goes no further.",
        "filters": ["problem"],
        "x": [_axis("target", "energy gap", {"type": "category"})],
        "y": shown,
        "hover": [["target", "gap"], ["iteration", "iterations"], ["alone", "seconds alone"], ["set_up", "set-up, s"]],
        "items": items,
    }


def _work(works: Sequence[WorkPoint]) -> Item:
    chains: dict[tuple[Any, ...], list[WorkPoint]] = {}
    for w in works:
        if w.status == "ok":
            chains.setdefault((w.mesh, w.label, w.integrator, w.tolerance, w.iterations, w.first_guess), []).append(w)
    items: list[Item] = []
    for (mesh, label, integrator, tolerance, iterations, _), members in chains.items():
        members.sort(key=lambda work: work.time_step)
        stop = f"{iterations} iterations" if tolerance is None else f"tolerance {tolerance:g}"
        items.append(
            {
                "label": label,
                "what": f"{mesh}, {integrator}, {stop} a step",
                "scene": mesh,
                "parameters": members[0].parameters,
                "panel": integrator,
                "open": tolerance is None,
                "seconds": _numbers(work.seconds for work in members),
                "error": _numbers(work.error for work in members),
                "step": [step_words(work.time_step) for work in members],
            }
        )
    return {
        "title": "Work and precision",
        "note": "Total error of the positions at the horizon against wall time; a line joins time steps, open marks "
        "do a fixed number of iterations.",
        "filters": ["scene"],
        "x": [_axis("seconds", "wall seconds a simulated second")],
        "y": [_axis("error", "relative error")],
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
    return {
        "title": "Performance and data profiles",
        "note": "The share of the problems solved within a multiple of the fastest solver's time, and of the time of "
        f"one plain local-global iteration. What failed is never solved. {' '.join(not_shown(table))}",
        "filters": ["gap"],
        "x": [_axis("ratio", "multiple")],
        "y": [_axis("share", "share of the problems solved", _SHARES)],
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
            "exponent": "too few sizes" if np.isnan(growth.exponent) else f"{growth.exponent:.2f}",
        }
        for growth in growths(table)
    ]
    return {
        "title": f"Growth with size: time to a gap of {power(TARGET)}",
        "note": "Median over the steps of a mesh, set-up apart.",
        "filters": ["scene"],
        "x": [_axis("vertices", "vertices")],
        "y": [_axis("seconds", "seconds")],
        "hover": [["vertices", "vertices"], ["seconds", "seconds"], ["exponent", "fitted power"]],
        "items": items,
    }
