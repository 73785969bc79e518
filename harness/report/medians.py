# pyright: reportUnknownMemberType=false
# pyarrow's stubs say nothing of some keywords.
"""Median step times as CSV, one line for each scene, size, solver and machine: for tables of one's own."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import csv

from harness.base.files import replacing

_BY = ["scene", "size", "solver", "machine", "node"]


def medians(rows: pa.Table, folder: Path) -> list[Path]:
    """Write medians.csv: scene, size, solver, machine and node, the median wall seconds of a step, and of how many
    steps; times of two machines are not to be compared."""
    steps = rows.filter((pc.field("phase") == "step") & (pc.field("status") == "ok"))
    found = steps.group_by(_BY).aggregate([("seconds", "approximate_median"), ("seconds", "count")])
    named = found.rename_columns({"seconds_approximate_median": "median_seconds", "seconds_count": "steps"})
    path = folder / "medians.csv"
    with replacing(path) as partial:
        csv.write_csv(named.sort_by([(name, "ascending") for name in _BY]), partial)
    return [path]
