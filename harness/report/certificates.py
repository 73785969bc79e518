# pyright: reportUnknownMemberType=false
# pyarrow's stubs say nothing of some keywords.
"""Certificates of no intersections as CSV, one line for each run: in how many of its frames nothing passes through
anything, told exactly (`harness.scenes.intersections`), and how many steps converged."""

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
    """Write certificates.csv: the run, its status, its frames, how many of them are free of intersections, how many
    steps came to the tolerance or to round-off, the mean of their iterations, and why a run has no frames."""
    path = folder / "certificates.csv"
    with replacing(path) as partial:
        csv.write_csv(pa.Table.from_pylist(answers(_QUERY, rows)), partial)
    return [path]
