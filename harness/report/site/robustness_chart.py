"""Robustness map for the results page: outcomes of solvers x cases.

Each outcome has its reason.
"""

from __future__ import annotations

from typing import Any

import pyarrow as pa
from springbench.harness.report.citations import format_citation
from springbench.harness.report.robustness import (
    MAP_NOTE,
    RUN_OUTCOMES,
    format_cell,
    map_headline,
    read_verified_runs,
    score_solvers,
)
from springbench.harness.report.site.data_scripts import round_number
from springbench.harness.report.site.sweep_folders import SweepFolder

CHART_TITLE = "Hard cases"


def has_verification(table: pa.Table) -> bool:
    """Return whether any of these rows was verified."""
    columns = [table[name] for name in ("stationarity", "reference_distance") if name in table.column_names]
    return any(column.null_count < len(column) for column in columns)


def build_robustness_chart(folder: SweepFolder) -> dict[str, Any]:
    """Build the robustness map for the results page.

    It has cells by case and solver, the solvers' shares, and the meanings of the colours.

    Raises:
        InputError: if no run was verified.
    """
    cells = read_verified_runs(folder.path)
    words = [outcome.label for outcome in RUN_OUTCOMES]
    return {
        "kind": "map",
        "title": CHART_TITLE,
        "note": MAP_NOTE.replace("\n", " "),
        "headline": map_headline(cells, folder.name),
        "outcomes": [{**o._asdict(), "count": sum(cell.outcome == o for cell in cells)} for o in RUN_OUTCOMES],
        "cases": list(dict.fromkeys(cell.case for cell in cells)),
        "solvers": list(dict.fromkeys(cell.solver for cell in cells)),
        "citations": {cell.solver: format_citation(cell.citation) for cell in cells},
        "scores": [
            {
                "solver": s.solver,
                "correct_share": round_number(s.correct_share),
                "finite_share": round_number(s.finite_share),
                "worst_error": s.worst_run.error_text,
            }
            for s in score_solvers(cells)
        ],
        "cells": [
            [cell.case, cell.solver, words.index(cell.outcome.label), format_cell(cell), cell.reason, cell.run_id]
            for cell in cells
        ],
    }


def outcomes_by_run(map_of: dict[str, Any]) -> dict[str, Any]:
    """Return the outcome and its reason by run id."""
    return {cell[5]: {"label": map_of["outcomes"][cell[2]]["label"], "reason": cell[4]} for cell in map_of["cells"]}
