# pyright: reportUnknownMemberType=false
# pyarrow's stubs say nothing of some keywords.
"""Median step times as CSV, one line for each scene, size and solver: for tables of one's own."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import csv

from harness.base.files import replacing


def medians(rows: pa.Table, folder: Path) -> list[Path]:
    """Write medians.csv: scene, size, solver, the median wall seconds of a step, and how many steps it is of."""
    steps = rows.filter((pc.field("phase") == "step") & (pc.field("status") == "ok"))
    found = steps.group_by(["scene", "size", "solver"]).aggregate(
        [("seconds", "approximate_median"), ("seconds", "count")]
    )
    named = found.rename_columns({"seconds_approximate_median": "median_seconds", "seconds_count": "steps"})
    path = folder / "medians.csv"
    with replacing(path) as partial:
        csv.write_csv(named.sort_by([(name, "ascending") for name in ("scene", "size", "solver")]), partial)
    return [path]
