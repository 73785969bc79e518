"""Robustness map for the results page: outcomes of solvers x cases.

Each outcome has its reason.
"""

from __future__ import annotations

from typing import Any

import pyarrow as pa

from harness.report.references import cited
from harness.report.robustness import OUTCOMES, read_cells, scores
from harness.report.robustness_map import NOTE, headline
from harness.report.site.folders import Folder
from harness.report.site.script import number

TITLE = "Hard cases"


def judged(table: pa.Table) -> bool:
    """Return whether any of these rows was verified."""
    columns = [table[name] for name in ("stationarity", "distance") if name in table.column_names]
    return any(column.null_count < len(column) for column in columns)


def chart(folder: Folder) -> dict[str, Any]:
    """Build the robustness map for the results page.

    It has cells by case and solver, the solvers' shares, and the meanings of the colours.

    Raises:
        InputError: if no run was verified.
    """
    cells = read_cells(folder.path)
    words = [outcome.words for outcome in OUTCOMES]
    return {
        "kind": "map",
        "title": TITLE,
        "note": NOTE.replace("\n", " "),
        "headline": headline(cells, folder.name),
        "outcomes": [{**o._asdict(), "count": sum(cell.outcome == o for cell in cells)} for o in OUTCOMES],
        "cases": list(dict.fromkeys(cell.case for cell in cells)),
        "solvers": list(dict.fromkeys(cell.solver for cell in cells)),
        "references": {cell.solver: cited(cell.reference) for cell in cells},
        "scores": [
            {"solver": s.solver, "right": number(s.right), "finite": number(s.finite), "worst": s.worst.figure}
            for s in scores(cells)
        ],
        "cells": [
            [cell.case, cell.solver, words.index(cell.outcome.words), cell.figure, cell.reason, cell.run_id]
            for cell in cells
        ],
    }


def outcomes(map_of: dict[str, Any]) -> dict[str, Any]:
    """Return the outcome and its reason by run id."""
    return {cell[5]: {"words": map_of["outcomes"][cell[2]]["words"], "reason": cell[4]} for cell in map_of["cells"]}
