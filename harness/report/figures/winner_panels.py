"""Map of winners: stiffness number against error, one map per mesh size.

Cells have the colour of the cheapest family of methods.
"""

from __future__ import annotations

from pathlib import Path

from springbench.harness.report.accuracy.accuracy_data import describe_self_converged
from springbench.harness.report.accuracy.accuracy_reader import read_accuracy
from springbench.harness.report.accuracy.winner_map import NO_WINNER, assign_family_styles, build_winner_cells
from springbench.harness.report.charts.figure_panels import CellMap, MapCell
from springbench.harness.report.figures.panel_selection import PanelEntry, entries_from_panels
from springbench.harness.report.number_format import format_count, format_quantity

_WINNER_NOTE = (
    "Columns: k dt²/m at dt = 1/30 s; rows: error of the positions at the end, relative to the way from the start. "
    "Figures: how many times as much processor time the next family takes; · where it reaches no such error."
)
_STALE_NOTE = "Dot: measured by other code than the others."
_NO_WINNER_COLOUR = "#e9e7e2"


def winner_panels(folder: Path) -> list[PanelEntry]:
    """Build a map for each number of vertices."""
    table = read_accuracy(folder)
    found = build_winner_cells(table.work_points)
    looks = assign_family_styles(found)
    colors = {name: look.color for name, look in looks.items()} | {NO_WINNER: _NO_WINNER_COLOUR}
    dotted = any(
        work.source_fingerprint != table.newest_fingerprint
        for cell in found
        for work in cell.cheapest_by_family.values()
    )
    panels: list[CellMap] = []
    for vertices in dict.fromkeys(cell.vertices for cell in found):
        mine = [cell for cell in found if cell.vertices == vertices]
        panels.append(
            CellMap(
                *(("winners",), (str(vertices),), "", f"{format_count(vertices)} vertices"),
                [
                    MapCell(
                        *(
                            f"{cell.error:.0e}".replace("e-0", "e-"),
                            f"{format_quantity(cell.stiffness_number)}",
                            cell.fastest_solver,
                        ),
                        colors[cell.fastest_solver],
                        _format_lead(cell.lead_ratio) if cell.cheapest_by_family else "",
                        bool(cell.cheapest_by_family)
                        and cell.cheapest_by_family[cell.fastest_solver].source_fingerprint != table.newest_fingerprint,
                    )
                    for cell in mine
                ],
                list(colors.items()),
                notes=[_WINNER_NOTE, *describe_self_converged(table.work_points), *([_STALE_NOTE] if dotted else [])],
                machine_words=", ".join(table.machine_words),
            )
        )
    return entries_from_panels(panels)


def _format_lead(times: float) -> str:
    return "·" if times == float("inf") else f"{times:.1f}" if times < 9.95 else f"{times:.0f}"
