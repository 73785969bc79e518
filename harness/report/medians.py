# pyright: reportUnknownMemberType=false
# pyarrow's stubs say nothing of some keywords.
"""The time of a step of each run as CSV: for tables of one's own."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
from pyarrow import csv

from harness.base.files import replacing
from harness.base.quantities import SQL
from harness.report.sql import answer
from harness.report.timing_table import labels, runs

_SQL = f"""
select any_value(scene) as scene, any_value("size") as "size", any_value(solver) as solver, run_id,
    any_value(machine) as machine, any_value(node) as node, {SQL["step"]} / 1e3 as median_seconds,
    count(*) filter (phase = 'step') as steps
from rows_of where status = 'ok' group by run_id having steps > 0 order by scene, "size", solver, machine, node, run_id
"""


def medians(rows: pa.Table, folder: Path) -> list[Path]:
    """Write medians.csv, a line for each run: scene, size, solver, run_id, machine and node, its ms a step in seconds,
    of how many steps, and the solver with the settings in which its runs differ; times of two machines are not to be
    compared."""
    label = labels(runs(rows))
    found = [(*row, label[row[3]]) for row in answer(_SQL, rows)]
    names = ("scene", "size", "solver", "run_id", "machine", "node", "median_seconds", "steps", "label")
    columns = [[row[k] for row in found] for k in range(len(names))]
    path = folder / "medians.csv"
    with replacing(path) as partial:
        csv.write_csv(pa.table(columns, names=list(names)), partial)
    return [path]
