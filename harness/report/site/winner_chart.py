"""Map of winners as a chart of the results page.

It shows the cheapest family of methods for each error on each mesh.
"""

from __future__ import annotations

from typing import Any

from springbench.harness.report.accuracy.accuracy_data import AccuracyData, describe_self_converged
from springbench.harness.report.accuracy.winner_map import (
    SIMILAR_COST_RATIO,
    WinnerCell,
    assign_family_styles,
    build_winner_cells,
)
from springbench.harness.report.number_format import format_count
from springbench.harness.report.site.data_scripts import round_numbers
from springbench.harness.report.site.plotly_styles import axis_choice, plotly_style

_CHART_NOTE = (
    "Each point is the family of methods that reaches an error in the least processor time, whatever its steps and "
    "tolerances; without a point no method reached it. Stiffness number: k dt²/m at dt = 1/30 s. Errors are those of "
    "the positions at the end, relative to the way from the start. Prices within "
    f"a factor of {SIMILAR_COST_RATIO} are alike."
)


def build_winner_chart(table: AccuracyData) -> dict[str, Any]:
    """Build the chart; it has no items if fewer than two families were measured."""
    found = [cell for cell in build_winner_cells(table.work_points) if cell.cheapest_by_family]
    looks = assign_family_styles(found)
    of: dict[tuple[int, str], list[WinnerCell]] = {}
    for cell in found if len(looks) > 1 else ():
        of.setdefault((cell.vertices, cell.fastest_solver), []).append(cell)
    return {
        "title": "Map of winners",
        "note": " ".join([_CHART_NOTE, *describe_self_converged(table.work_points)]),
        "shape": "points",
        "filters": [],
        "x": [axis_choice("stiffness_number", "stiffness number k dt²/m")],
        "y": [axis_choice("error", "relative error")],
        "hover": [
            *(
                ["scene", "scene"],
                ["error", "error"],
                ["stiffness_number", "stiffness number"],
                ["setting", "cheapest"],
            ),
            *(
                ["cpu_seconds_per_simulated_second", "processor seconds a simulated second"],
                ["runner_up_family", "next family"],
                ["lead_ratio", "which takes"],
            ),
        ],
        "styles": {name: plotly_style(mark) for name, mark in looks.items()},
        "items": [_build_item(table, vertices, name, mine) for (vertices, name), mine in of.items()],
    }


def _build_item(table: AccuracyData, vertices: int, name: str, winner_cells: list[WinnerCell]) -> dict[str, Any]:
    best = [cell.cheapest_by_family[name] for cell in winner_cells]
    return {
        "label": name,
        "description": f"{format_count(vertices)} vertices",
        "parameters": "{}",
        "panel": f"{format_count(vertices)} vertices",
        "large": True,
        "stiffness_number": round_numbers(cell.stiffness_number for cell in winner_cells),
        "error": round_numbers(cell.error for cell in winner_cells),
        "scene": [cell.scene for cell in winner_cells],
        "setting": [work.setting_label for work in best],
        "cpu_seconds_per_simulated_second": round_numbers(work.cpu_seconds_per_simulated_second for work in best),
        "runner_up_family": [_runner_up_family(cell) for cell in winner_cells],
        "lead_ratio": [
            f"{cell.lead_ratio:.2g} times as much" if len(cell.cheapest_by_family) > 1 else None
            for cell in winner_cells
        ],
        "stale": [work.source_fingerprint != table.newest_fingerprint for work in best],
    }


def _runner_up_family(cell: WinnerCell) -> str:
    """Return the second cheapest family."""
    order = sorted(
        cell.cheapest_by_family, key=lambda name: cell.cheapest_by_family[name].cpu_seconds_per_simulated_second
    )
    return order[1] if len(order) > 1 else "none that was tried"
