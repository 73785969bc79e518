# pyright: reportUnknownMemberType=false
# pyarrow's stubs do not type some keywords.
"""Certificates of intersection-free runs as CSV, one line per run.

Each line states in how many frames no primitives intersect, by the exact test of
`springbench.harness.scenes.edge_triangle_intersections`, and how many steps converged.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pyarrow as pa
from pyarrow import csv
from springbench.harness.atomic_files import atomic_write
from springbench.harness.report.table_queries import query_records

_CERTIFICATE_QUERY = """
select scene, size, max(vertices) as vertices, solver, parameters, any_value(status) as status,
    max(frame) as num_frames,
    count(distinct frame) filter (phase = 'step' and num_intersections = 0) as num_intersection_free_frames,
    count(distinct frame) filter (phase = 'step' and termination_reason in ('converged', 'roundoff'))
        as num_converged_steps,
    avg(num_iterations) filter (phase = 'step') as mean_iterations, any_value(reason) as reason
from rows_of group by run_id, scene, size, solver, parameters order by scene, size, solver, parameters, num_frames"""


def find_certificates(rows: pa.Table) -> list[dict[str, Any]]:
    """Return the certificate of each run by the columns of the CSV file."""
    return query_records(_CERTIFICATE_QUERY, rows)


def write_certificates(rows: pa.Table, folder: Path) -> list[Path]:
    """Write certificates.csv and return its path.

    The columns are: the run, its status, its frames, the number of intersection-free frames, the number of steps that
    ended at the tolerance or at round-off, the mean number of iterations of a step, and the reason of a failed run.

    Args:
        rows: rows of a sweep.
        folder: folder that the file is written to.
    """
    path = folder / "certificates.csv"
    with atomic_write(path) as partial:
        csv.write_csv(pa.Table.from_pylist(find_certificates(rows)), partial)
    return [path]
