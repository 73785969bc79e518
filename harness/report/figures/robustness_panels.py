"""Panels of verified runs: each solver's shares, and robustness maps.

There is one map per family of cases.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from springbench.harness.report.charts.figure_panels import (
    AxisScale,
    CellMap,
    CurvePlot,
    CurveSeries,
    FigurePanel,
    MapCell,
    describe_stale_cells,
)
from springbench.harness.report.figures.panel_selection import PanelEntry, entries_from_panels
from springbench.harness.report.figures.timing_panels import StaleFinder, read_sweep_rows
from springbench.harness.report.plot_style import STALE_NOTE, SeriesStyle, assign_solver_styles
from springbench.harness.report.provenance_words import PROVENANCE_COLUMNS, describe_provenance
from springbench.harness.report.robustness import CORRECT, RUN_OUTCOMES, VerifiedRun, read_verified_runs, score_solvers


def robustness_panels(folder: Path, find_stale: StaleFinder) -> list[PanelEntry]:
    """Build the panel of each solver's correct and finite shares, then one map per family.

    Args:
        folder: folder of a sweep's results.
        find_stale: returns the ids of stale runs in a table of rows.
    """
    table = read_sweep_rows(folder)
    cells, other = read_verified_runs(folder), find_stale(table)
    provenance = describe_provenance(table.select(PROVENANCE_COLUMNS).to_pylist())
    panels: list[FigurePanel] = [_build_share_plot(cells, other, provenance)]
    for family in dict.fromkeys(cell.case.partition("-")[0] for cell in cells):
        mine = [cell for cell in cells if cell.case.partition("-")[0] == family]
        drawn = [_build_cell(cell, is_stale=cell.run_id in other) for cell in mine]
        outcomes = [(outcome.label, outcome.color) for outcome in RUN_OUTCOMES]
        panels.append(
            CellMap(("map",), (family,), "", family, drawn, outcomes, describe_stale_cells(drawn), provenance)
        )
    return entries_from_panels(panels)


def _build_cell(cell: VerifiedRun, *, is_stale: bool) -> MapCell:
    row = cell.case.partition("-")[2] or cell.case
    return MapCell(row, cell.solver, cell.outcome.label, cell.outcome.color, cell.error_text, is_stale)


def merge_cell_maps(grids: Sequence[CellMap]) -> CellMap:
    """Merge the maps of several families into one.

    The names of its rows include the family.
    """
    if len(grids) == 1:
        return grids[0]
    cells = [cell._replace(row=f"{grid.title}: {cell.row}") for grid in grids for cell in grid.cells]
    names = tuple(grid.name[0] for grid in grids)
    return replace(grids[0], name=names, title="", cells=cells, notes=describe_stale_cells(cells))


def _build_share_plot(cells: Sequence[VerifiedRun], other: Collection[str], machine_words: str) -> CurvePlot:
    found = sorted(score_solvers(cells), key=lambda score: -(score.correct_share or 0.0))
    looks = assign_solver_styles(score.worst_run.solver_name for score in found)
    mixed = {cell.solver for cell in cells if cell.run_id in other}
    series: list[CurveSeries] = []
    for k, score in enumerate(found):
        look, y, older = looks[score.worst_run.solver_name], np.array([float(k)]), np.array([score.solver in mixed])
        right, finite = (np.array([np.nan if s is None else s]) for s in (score.correct_share, score.finite_share))
        series.append(
            CurveSeries(score.solver, look, right, y, right, finite, True, older, is_connected=False, setting="right")
        )
        ring = SeriesStyle(look.color, "|")
        series.append(CurveSeries(score.solver, ring, finite, y, stale=older, is_connected=False, setting="finite"))
    notes = [f"Marks: runs that are {CORRECT.label}; lines reach to the share that stayed finite. Of runs not refused."]
    return CurvePlot(
        *(("shares",), ("right",), f"{len({cell.case for cell in cells})} of them", ""),
        *(
            AxisScale("share of the cases", "linear", "percent"),
            AxisScale("", "names", place_names=tuple(s.solver for s in found)),
        ),
        series,
        notes=[*notes, *([STALE_NOTE] if mixed else [])],
        machine_words=machine_words,
    )
