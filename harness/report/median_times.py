# pyright: reportUnknownMemberType=false
# pyarrow's stubs do not type some keywords.
"""Median time of a step for each run, as CSV."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
from pyarrow import csv
from springbench.harness.atomic_files import atomic_write
from springbench.harness.report.table_queries import query_table
from springbench.harness.report.timing_table import label_runs, read_run_times
from springbench.harness.results.quantities import SQL_EXPRESSIONS

_MEDIAN_QUERY = f"""
select any_value(scene) as scene, any_value("size") as "size", any_value(solver) as solver, run_id,
    any_value(machine_id) as machine_id, any_value(node_id) as node_id,
    {SQL_EXPRESSIONS["step"]} / 1e3 as median_seconds,
    count(*) filter (phase = 'step') as num_steps
from rows_of where status = 'ok' group by run_id having num_steps > 0
order by scene, "size", solver, machine_id, node_id, run_id
"""


def write_medians(rows: pa.Table, folder: Path) -> list[Path]:
    """Write medians.csv, one line per run, and return its path.

    The columns are scene, size, solver, run_id, machine_id, node_id, median time of a step [s], number of steps, and
    the solver with the settings in which its runs differ. Times of different machines must not be compared.

    Args:
        rows: rows of a sweep.
        folder: folder that the file is written to.
    """
    label = label_runs(read_run_times(rows))
    found = [(*row, label[row[3]]) for row in query_table(_MEDIAN_QUERY, rows)]
    names = ("scene", "size", "solver", "run_id", "machine_id", "node_id", "median_seconds", "num_steps", "label")
    columns = {name: [row[k] for row in found] for k, name in enumerate(names)}
    path = folder / "medians.csv"
    with atomic_write(path) as partial:
        csv.write_csv(pa.table(columns), partial)
    return [path]
