"""Map of winners as a chart of the results page.

It shows the cheapest family of methods for each error on each mesh.
"""

from __future__ import annotations

from typing import Any

from harness.report.accuracy.measured import Measurements, by_self_converged
from harness.report.accuracy.winners import CLOSE, Cell, cells, families
from harness.report.page import count
from harness.report.site.marks import axis, drawn
from harness.report.site.script import numbers

_NOTE = (
    "Each point is the family of methods that reaches an error in the least processor time, whatever its steps and "
    "tolerances; without a point no method reached it. Stiffness number: k dt²/m at dt = 1/30 s. Errors are those of "
    f"the positions at the end, relative to the way from the start. Prices within a factor of {CLOSE} are alike."
)


def chart(table: Measurements) -> dict[str, Any]:
    """Build the chart; it has no items if fewer than two families were measured."""
    found = [cell for cell in cells(table.works) if cell.prices]
    looks = families(found)
    of: dict[tuple[int, str], list[Cell]] = {}
    for cell in found if len(looks) > 1 else ():
        of.setdefault((cell.vertices, cell.winner), []).append(cell)
    return {
        "title": "Map of winners",
        "note": " ".join([_NOTE, *by_self_converged(table.works)]),
        "shape": "points",
        "filters": [],
        "x": [axis("number", "stiffness number k dt²/m")],
        "y": [axis("error", "relative error")],
        "hover": [
            *(["scene", "scene"], ["error", "error"], ["number", "stiffness number"], ["setting", "cheapest"]),
            *(["price", "processor seconds a simulated second"], ["next", "next family"], ["ahead", "which takes"]),
        ],
        "marks": {name: drawn(mark) for name, mark in looks.items()},
        "items": [_item(table, vertices, name, mine) for (vertices, name), mine in of.items()],
    }


def _item(table: Measurements, vertices: int, name: str, mine: list[Cell]) -> dict[str, Any]:
    best = [cell.prices[name] for cell in mine]
    return {
        "label": name,
        "what": f"{count(vertices)} vertices",
        "parameters": "{}",
        "panel": f"{count(vertices)} vertices",
        "large": True,
        "number": numbers(cell.number for cell in mine),
        "error": numbers(cell.error for cell in mine),
        "scene": [cell.scene for cell in mine],
        "setting": [work.setting for work in best],
        "price": numbers(work.cpu for work in best),
        "next": [_next(cell) for cell in mine],
        "ahead": [f"{cell.ahead:.2g} times as much" if len(cell.prices) > 1 else None for cell in mine],
        "older": [work.code != table.newest for work in best],
    }


def _next(cell: Cell) -> str:
    """Return the second cheapest family."""
    order = sorted(cell.prices, key=lambda name: cell.prices[name].cpu)
    return order[1] if len(order) > 1 else "none that was tried"
