"""Map of winners: stiffness number against error, one map per mesh size.

Cells have the colour of the cheapest family of methods.
"""

from __future__ import annotations

from pathlib import Path

from harness.report.accuracy.measured import by_self_converged
from harness.report.accuracy.reading import read
from harness.report.accuracy.winners import NOBODY, cells, families
from harness.report.figures.entry import Entry, ready
from harness.report.figures.panel import Cell, CellMap
from harness.report.page import count, quantity

_NOTE = (
    "Columns: k dt²/m at dt = 1/30 s; rows: error of the positions at the end, relative to the way from the start. "
    "Figures: how many times as much processor time the next family takes; · where it reaches no such error."
)
_DOTTED = "Dot: measured by other code than the others."
_NONE = "#e9e7e2"


def winners(folder: Path) -> list[Entry]:
    """Build a map for each number of vertices."""
    table = read(folder)
    found = cells(table.works)
    looks = families(found)
    colors = {name: look.color for name, look in looks.items()} | {NOBODY: _NONE}
    dotted = any(work.code != table.newest for cell in found for work in cell.prices.values())
    panels: list[CellMap] = []
    for vertices in dict.fromkeys(cell.vertices for cell in found):
        mine = [cell for cell in found if cell.vertices == vertices]
        panels.append(
            CellMap(
                *(("winners",), (str(vertices),), "", f"{count(vertices)} vertices"),
                [
                    Cell(
                        *(f"{cell.error:.0e}".replace("e-0", "e-"), f"{quantity(cell.number)}", cell.winner),
                        colors[cell.winner],
                        _ahead(cell.ahead) if cell.prices else "",
                        bool(cell.prices) and cell.prices[cell.winner].code != table.newest,
                    )
                    for cell in mine
                ],
                list(colors.items()),
                notes=[_NOTE, *by_self_converged(table.works), *([_DOTTED] if dotted else [])],
                machine=", ".join(table.machine),
            )
        )
    return ready(panels)


def _ahead(times: float) -> str:
    return "·" if times == float("inf") else f"{times:.1f}" if times < 9.95 else f"{times:.0f}"
