"""Count frames without intersections, and converged steps, in the rows of sweeps with contact.

    springbench run configs/hard-touch.yaml
    python -m tests.bench.contact_certificates [results/hard-touch ...] [--publish FOLDER]

A published row describes a run: the number of its frames, the number of frames in which an exact test finds no edge
that intersects a triangle, the number of steps that reached their tolerance, and the reason why a run has no frames.
The printed table has the sums by solver. `springbench run configs/contact-certificates.yaml` simulates the scenes in
contact, which takes hours. Published rows of other solvers remain.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from springbench.harness.report.intersection_certificates import find_certificates
from springbench.harness.results.parquet_rows import read_rows
from springbench.harness.results.published_set import TABLE_FILES
from springbench.harness.results.row_store import list_units
from springbench.harness.results.run_schema import RUN_SCHEMA

from tests.bench.scripted_study import publish_tables

CONFIG = Path(__file__).parents[2] / "configs" / "hard-touch.yaml"
PROVENANCE = ("commit", "cpu", "cores", "memory_gib", "operating_system", "versions", "started_at")


def main() -> None:
    """Print the certificates by solver."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("results", nargs="*", type=Path, default=[Path("results/hard-touch")])
    parser.add_argument("--publish", type=Path, help="folder of a published study")
    options = parser.parse_args()
    found, moments = list[dict[str, Any]](), list[dict[str, Any]]()
    for folder in options.results:
        rows = read_rows(list_units(folder / "rows"), RUN_SCHEMA)
        found += [{"sweep": folder.name, **one} for one in find_certificates(rows)]
        moments += rows.select(list(PROVENANCE)).to_pylist()
    table = Table("solver", "runs", "frames", "free of intersections", "steps", "converged", box=SIMPLE_HEAD)
    for solver in dict.fromkeys(row["solver"] for row in found):
        own = [row for row in found if row["solver"] == solver]
        intersection_free, converged, frames = (
            sum(row[name] or 0 for row in own)
            for name in ("num_intersection_free_frames", "num_converged_steps", "num_frames")
        )
        table.add_row(solver, *map(str, (len(own), frames, intersection_free, frames, converged)))
    Console(width=120).print(table)
    if options.publish:
        command = " ".join(
            ["python -m tests.bench.contact_certificates", *(f"results/{folder.name}" for folder in options.results)]
        )
        path, now = options.publish / TABLE_FILES["measurements"], {(row["sweep"], row["solver"]) for row in found}
        known = pq.read_table(path).to_pylist() if path.exists() else []
        earlier = [row for row in known if (row["sweep"], row["solver"]) not in now]
        rows = sorted((*earlier, *found), key=lambda row: (row["sweep"], row["solver"], row["scene"]))
        tables = {"measurements": pa.Table.from_pylist(rows)}
        publish_tables(
            options.publish, CONFIG, command, tables, moments, is_timed=False, has_earlier_rows=bool(earlier)
        )


if __name__ == "__main__":
    main()
