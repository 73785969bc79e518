"""Chart of external engines for the results page: Pareto fronts.

The front of each program is taken over all its settings.
"""

from __future__ import annotations

from typing import Any

from harness.report.accuracy.engines import OURS, fronts, marks, met
from harness.report.accuracy.measured import Measurements, WorkPoint, by_self_converged
from harness.report.site.marks import axis, drawn
from harness.report.site.script import numbers

_NOTE = (
    "Each line is the Pareto front of a program's settings in time and error; "
    f"{OURS}: of all of its methods that were tried. Errors are those of the positions at the end, relative to the way "
    "from the start. springbench repeat CONFIG prints a script that repeats an engine's point without us."
)


def chart(table: Measurements) -> dict[str, Any]:
    """Build the chart; it has no items if no engine was measured."""
    items = [
        _item(table, mesh, name, front)
        for mesh, here in met(table.works).items()
        for name, front in fronts(here).items()
        if front
    ]
    return {
        "title": "Outside engines beside ours",
        "note": " ".join([_NOTE, *by_self_converged(table.works)]),
        "filters": ["scene"],
        "x": [axis("seconds", "wall seconds a simulated second")],
        "y": [axis("error", "relative error")],
        "hover": [["setting", "setting"], ["error", "relative error"], ["seconds", "seconds a simulated second"]],
        "marks": {name: drawn(mark) for name, mark in marks(table.works).items()},
        "items": items,
    }


def _item(table: Measurements, mesh: str, name: str, front: list[WorkPoint]) -> dict[str, Any]:
    return {
        "label": name,
        "what": mesh,
        "scene": mesh,
        "parameters": "{}",
        "panel": mesh,
        "seconds": numbers(work.seconds for work in front),
        "error": numbers(work.error for work in front),
        "setting": [work.setting for work in front],
        "older": [work.code != table.newest for work in front],
    }
