"""Panels of verified runs: each solver's shares, and robustness maps.

There is one map per family of cases.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from harness.report.figures.entry import Entry, ready
from harness.report.figures.of_runs import Older, sweep_rows
from harness.report.figures.panel import Cell, CellMap, Panel, Plot, Scale, Series, dotted
from harness.report.origin import NEEDED, measured_on
from harness.report.robustness import OUTCOMES, RIGHT, Judged, read_cells, scores
from harness.report.style import OLDER, Mark, marks


def hard(folder: Path, older: Older) -> list[Entry]:
    """Build the panel of each solver's correct and finite shares, then one map per family.

    Args:
        folder: folder of a sweep's results.
        older: returns the ids of stale runs in a table of rows.
    """
    table = sweep_rows(folder)
    cells, other = read_cells(folder), older(table)
    told = measured_on(table.select(NEEDED).to_pylist())
    panels: list[Panel] = [_shares(cells, other, told)]
    for family in dict.fromkeys(cell.case.partition("-")[0] for cell in cells):
        mine = [cell for cell in cells if cell.case.partition("-")[0] == family]
        drawn = [_cell(cell, older=cell.run_id in other) for cell in mine]
        outcomes = [(outcome.words, outcome.color) for outcome in OUTCOMES]
        panels.append(CellMap(("map",), (family,), "", family, drawn, outcomes, dotted(drawn), told))
    return ready(panels)


def _cell(cell: Judged, *, older: bool) -> Cell:
    row = cell.case.partition("-")[2] or cell.case
    return Cell(row, cell.solver, cell.outcome.words, cell.outcome.color, cell.figure, older)


def together(grids: Sequence[CellMap]) -> CellMap:
    """Merge the maps of several families into one.

    The names of its rows include the family.
    """
    if len(grids) == 1:
        return grids[0]
    cells = [cell._replace(row=f"{grid.title}: {cell.row}") for grid in grids for cell in grid.cells]
    names = tuple(grid.name[0] for grid in grids)
    return replace(grids[0], name=names, title="", cells=cells, notes=dotted(cells))


def _shares(cells: Sequence[Judged], other: Collection[str], told: str) -> Plot:
    found = sorted(scores(cells), key=lambda score: -(score.right or 0.0))
    looks = marks(score.worst.name for score in found)
    mixed = {cell.solver for cell in cells if cell.run_id in other}
    series: list[Series] = []
    for k, score in enumerate(found):
        look, y, older = looks[score.worst.name], np.array([float(k)]), np.array([score.solver in mixed])
        right, finite = (np.array([np.nan if s is None else s]) for s in (score.right, score.finite))
        series.append(Series(score.solver, look, right, y, right, finite, True, older, joined=False, setting="right"))
        ring = Mark(look.color, "|")
        series.append(Series(score.solver, ring, finite, y, older=older, joined=False, setting="finite"))
    notes = [f"Marks: runs that are {RIGHT.words}; lines reach to the share that stayed finite. Of runs not refused."]
    return Plot(
        *(("shares",), ("right",), f"{len({cell.case for cell in cells})} of them", ""),
        *(Scale("share of the cases", "linear", "percent"), Scale("", "names", names=tuple(s.solver for s in found))),
        series,
        notes=[*notes, *([OLDER] if mixed else [])],
        machine=told,
    )
