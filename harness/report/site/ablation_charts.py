"""Charts of ablations for the results page: cost, influence and overhead of effects."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from springbench.harness.report.ablation_summary import ResultRow, select_kind, summarise_ablation
from springbench.harness.report.plot_style import assign_label_styles
from springbench.harness.report.site.data_scripts import round_number
from springbench.harness.report.site.plotly_styles import LOG_AXIS, axis_choice, plotly_style
from springbench.harness.report.site.run_table import format_references

_PERCENT_AXIS = {"ticksuffix": " %", "zeroline": True}
_CHART_COMMANDS = {
    "ablation": "springbench ablate CONFIG --rerun",
    "prices": "springbench ablate CONFIG --all-solvers --rerun",
}
_NAME_AXIS = {"type": "category", "autorange": "reversed"}


def build_ablation_charts(rows: Sequence[ResultRow]) -> tuple[dict[str, dict[str, Any]], list[str]]:
    """Build the charts by their ids, and the verdicts in sentences.

    The rows may belong to several scenes.
    """
    made = {"ablation": _build_effect_chart(rows), "prices": _build_overhead_chart(rows)}
    by_whole = [_select_unit_rows(whole, rows) for whole in select_kind(rows, "full-scene") if whole["status"] == "ok"]
    words = [f"{some[0]['scene']}: {sentence}" for some in by_whole for sentence in summarise_ablation(some)]
    return {name: chart | {"command": _CHART_COMMANDS[name]} for name, chart in made.items() if chart["items"]}, words


def _select_unit_rows(full_run: ResultRow, rows: Sequence[ResultRow]) -> list[ResultRow]:
    """Select the rows that belong to one full run: those of its unit."""
    return [full_run, *(row for row in rows if row is not full_run and row["file"] == full_run["file"])]


def _build_effect_chart(rows: Sequence[ResultRow]) -> dict[str, Any]:
    items = [
        _build_item(_select_unit_rows(whole, rows))
        for whole in select_kind(rows, "full-scene")
        if whole["status"] == "ok"
    ]
    return {
        "title": "What each effect costs and changes",
        "note": "CPU time of a step that goes where the effect is left out, with its 95 % interval, and how far that "
        "moves some vertex. An effect is called for where it moves more than the scene is wrong by anyway.",
        "filters": ["scene"],
        "shape": "points",
        "x": [
            axis_choice("added_time_share", "percent of a step", _PERCENT_AXIS),
            axis_choice("displacement_max", "mean rest lengths moved"),
        ],
        "y": [axis_choice("effect", "", _NAME_AXIS)],
        "hover": [
            ["effect", "without"],
            ["added_time_share", "percent of a step"],
            ["displacement_max", "mean rest lengths moved"],
        ],
        "items": [item for item in items if item["effect"]],
        "styles": _build_styles(rows),
        "citations": _build_references(rows),
    }


def _build_item(some: Sequence[ResultRow]) -> dict[str, Any]:
    whole, without = some[0], [row for row in select_kind(some, "ablated") if row["status"] == "ok"]
    size = f" {whole['size']}" if whole["size"] else ""
    shares = {
        name: [round_number(100 * row[column] / whole["seconds"]) for row in without]
        for name, column in (
            ("added_time_share", "added_seconds"),
            ("added_time_share_low", "added_seconds_low"),
            ("added_time_share_high", "added_seconds_high"),
        )
    }
    return {
        "label": whole["solver"],
        "description": f"{whole['scene']}{size}, {whole['frames']} frames",
        "scene": f"{whole['scene']}{size}",
        "panel": f"{whole['scene']}{size}",
        "parameters": whole["parameters"],
        "effect": [row["name"] for row in without],
        "displacement_max": [round_number(row["displacement_max"] or None) for row in without],
        **shares,
    }


def _build_overhead_chart(rows: Sequence[ResultRow]) -> dict[str, Any]:
    priced: dict[tuple[str, str], list[ResultRow]] = {}
    for row in select_kind(rows, "overhead"):
        if row["status"] == "ok":
            priced.setdefault((row["scene"], row["solver"]), []).append(row)
    items = [
        {
            "label": solver,
            "description": f"{scene}, an iteration",
            "scene": scene,
            "panel": scene,
            "parameters": some[0]["parameters"],
            "effect": [row["name"] for row in some],
            "overhead_ratio": [round_number(row["overhead_ratio"]) for row in some],
            "overhead_ratio_low": [round_number(row["overhead_ratio_low"]) for row in some],
            "overhead_ratio_high": [round_number(row["overhead_ratio_high"]) for row in some],
            "overhead_ratio_bound": [round_number(row["overhead_ratio_bound"]) for row in some],
        }
        for (scene, solver), some in priced.items()
    ]
    return {
        "title": "What each effect adds to an iteration",
        "note": "CPU time of an iteration with the effect over one without, with its 95 % interval.",
        "filters": ["scene"],
        "shape": "points",
        "x": [axis_choice("overhead_ratio", "times as long", LOG_AXIS)],
        "y": [axis_choice("effect", "", _NAME_AXIS)],
        "hover": [
            ["effect", "effect"],
            ["overhead_ratio", "times as long"],
            ["overhead_ratio_bound", "least that reading its numbers allows"],
        ],
        "items": items,
        "styles": _build_styles(rows),
        "citations": _build_references(rows),
    }


def _build_styles(rows: Sequence[ResultRow]) -> dict[str, Any]:
    return {
        label: plotly_style(mark)
        for label, mark in assign_label_styles((row["solver"], row["solver"]) for row in rows).items()
    }


def _build_references(rows: Sequence[ResultRow]) -> dict[str, Any]:
    return format_references((row["solver"], row["citation"]) for row in rows)
