"""Charts of ablations for the results page: cost, influence and overhead of effects."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from harness.report.ablation import Row, of_kind, sentences
from harness.report.site.marks import LOG, axis, drawn
from harness.report.site.runs import references
from harness.report.site.script import number
from harness.report.style import looks

_PERCENT = {"ticksuffix": " %", "zeroline": True}
_COMMANDS = {
    "ablation": "springbench ablate CONFIG --again",
    "prices": "springbench ablate CONFIG --all-solvers --again",
}
_NAMES = {"type": "category", "autorange": "reversed"}


def charts(rows: Sequence[Row]) -> tuple[dict[str, dict[str, Any]], list[str]]:
    """Build the charts by their ids, and the verdicts in sentences.

    The rows may belong to several scenes.
    """
    made = {"ablation": _effects(rows), "prices": _prices(rows)}
    by_whole = [_of(whole, rows) for whole in of_kind(rows, "whole") if whole["status"] == "ok"]
    words = [f"{some[0]['scene']}: {said}" for some in by_whole for said in sentences(some)]
    return {name: chart | {"command": _COMMANDS[name]} for name, chart in made.items() if chart["items"]}, words


def _of(whole: Row, rows: Sequence[Row]) -> list[Row]:
    """Select the rows that belong to one full run: those of its unit."""
    return [whole, *(row for row in rows if row is not whole and row["file"] == whole["file"])]


def _effects(rows: Sequence[Row]) -> dict[str, Any]:
    items = [_item(_of(whole, rows)) for whole in of_kind(rows, "whole") if whole["status"] == "ok"]
    return {
        "title": "What each effect costs and changes",
        "note": "CPU time of a step that goes where the effect is left out, with its 95 % interval, and how far that "
        "moves some vertex. An effect is called for where it moves more than the scene is wrong by anyway.",
        "filters": ["scene"],
        "shape": "points",
        "x": [axis("share", "percent of a step", _PERCENT), axis("largest", "mean rest lengths moved")],
        "y": [axis("effect", "", _NAMES)],
        "hover": [["effect", "without"], ["share", "percent of a step"], ["largest", "mean rest lengths moved"]],
        "items": [item for item in items if item["effect"]],
        "marks": _marks(rows),
        "references": _references(rows),
    }


def _item(some: Sequence[Row]) -> dict[str, Any]:
    whole, without = some[0], [row for row in of_kind(some, "without") if row["status"] == "ok"]
    size = f" {whole['size']}" if whole["size"] else ""
    shares = {
        name: [number(100 * row[column] / whole["seconds"]) for row in without]
        for name, column in (("share", "cost"), ("share_low", "cost_low"), ("share_high", "cost_high"))
    }
    return {
        "label": whole["solver"],
        "what": f"{whole['scene']}{size}, {whole['frames']} frames",
        "scene": f"{whole['scene']}{size}",
        "panel": f"{whole['scene']}{size}",
        "parameters": whole["parameters"],
        "effect": [row["name"] for row in without],
        "largest": [number(row["largest"] or None) for row in without],
        **shares,
    }


def _prices(rows: Sequence[Row]) -> dict[str, Any]:
    priced: dict[tuple[str, str], list[Row]] = {}
    for row in of_kind(rows, "price"):
        if row["status"] == "ok":
            priced.setdefault((row["scene"], row["solver"]), []).append(row)
    items = [
        {
            "label": solver,
            "what": f"{scene}, an iteration",
            "scene": scene,
            "panel": scene,
            "parameters": some[0]["parameters"],
            "effect": [row["name"] for row in some],
            "price": [number(row["price"]) for row in some],
            "price_low": [number(row["price_low"]) for row in some],
            "price_high": [number(row["price_high"]) for row in some],
            "bound": [number(row["price_bound"]) for row in some],
        }
        for (scene, solver), some in priced.items()
    ]
    return {
        "title": "What each effect adds to an iteration",
        "note": "CPU time of an iteration with the effect over one without, with its 95 % interval.",
        "filters": ["scene"],
        "shape": "points",
        "x": [axis("price", "times as long", LOG)],
        "y": [axis("effect", "", _NAMES)],
        "hover": [["effect", "effect"], ["price", "times as long"], ["bound", "least that reading its numbers allows"]],
        "items": items,
        "marks": _marks(rows),
        "references": _references(rows),
    }


def _marks(rows: Sequence[Row]) -> dict[str, Any]:
    return {label: drawn(mark) for label, mark in looks((row["solver"], row["solver"]) for row in rows).items()}


def _references(rows: Sequence[Row]) -> dict[str, Any]:
    return references((row["solver"], row["reference"]) for row in rows)
