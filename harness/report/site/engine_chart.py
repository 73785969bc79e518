"""Chart of external engines for the results page: Pareto fronts.

The front of each program is taken over all its settings.
"""

from __future__ import annotations

from typing import Any

from springbench.harness.report.accuracy.accuracy_data import AccuracyData, WorkPoint, describe_self_converged
from springbench.harness.report.accuracy.engine_comparison import (
    OWN_PROGRAM,
    assign_program_styles,
    meshes_with_engines,
    pareto_fronts,
)
from springbench.harness.report.site.data_scripts import round_numbers
from springbench.harness.report.site.plotly_styles import axis_choice, plotly_style

_CHART_NOTE = (
    "Each line is the Pareto front of a program's settings in time and error; "
    f"{OWN_PROGRAM}: of all of its methods that were tried. Errors are those of "
    "the positions at the end, relative to the way "
    "from the start. springbench export-script CONFIG prints a script that repeats an engine's point without us."
)


def build_engine_chart(table: AccuracyData) -> dict[str, Any]:
    """Build the chart; it has no items if no engine was measured."""
    items = [
        _build_item(table, mesh, name, front)
        for mesh, here in meshes_with_engines(table.work_points).items()
        for name, front in pareto_fronts(here).items()
        if front
    ]
    return {
        "title": "Outside engines beside ours",
        "note": " ".join([_CHART_NOTE, *describe_self_converged(table.work_points)]),
        "filters": ["scene"],
        "x": [axis_choice("seconds", "wall seconds a simulated second")],
        "y": [axis_choice("error", "relative error")],
        "hover": [["setting", "setting"], ["error", "relative error"], ["seconds", "seconds a simulated second"]],
        "styles": {name: plotly_style(mark) for name, mark in assign_program_styles(table.work_points).items()},
        "items": items,
    }


def _build_item(table: AccuracyData, mesh: str, name: str, front: list[WorkPoint]) -> dict[str, Any]:
    return {
        "label": name,
        "description": mesh,
        "scene": mesh,
        "parameters": "{}",
        "panel": mesh,
        "seconds": round_numbers(work.seconds_per_simulated_second for work in front),
        "error": round_numbers(work.error for work in front),
        "setting": [work.setting_label for work in front],
        "stale": [work.source_fingerprint != table.newest_fingerprint for work in front],
    }
