# pyright: reportUnknownMemberType=false
# pyarrow's stubs do not type some keywords.
"""Certificates of intersection-free runs as CSV, one line per run.

Each line states in how many frames no primitives intersect, by the exact test of
`harness.scenes.intersections`, and how many steps converged.
"""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
from pyarrow import csv

from harness.base.files import replacing
from harness.report.sql import answers

_QUERY = """
select scene, size, max(vertices) as vertices, solver, parameters, any_value(status) as status, max(frame) as frames,
    count(distinct frame) filter (phase = 'step' and intersections = 0) as free,
    count(distinct frame) filter (phase = 'step' and stopped in ('tolerance', 'floor')) as converged,
    avg(iterations) filter (phase = 'step') as iterations, any_value(reason) as reason
from rows_of group by run_id, scene, size, solver, parameters order by scene, size, solver, parameters, frames"""


def certificates(rows: pa.Table, folder: Path) -> list[Path]:
    """Write certificates.csv and return its path.

    The columns are: the run, its status, its frames, the number of intersection-free frames, the number of steps that
    ended at the tolerance or at round-off, the mean number of their iterations, and the reason where a run has no
    frames.

    Args:
        rows: rows of a sweep.
        folder: folder that the file is written to.
    """
    path = folder / "certificates.csv"
    with replacing(path) as partial:
        csv.write_csv(pa.Table.from_pylist(answers(_QUERY, rows)), partial)
    return [path]
