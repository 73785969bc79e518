"""Rows as runs leave them, without the runs: many, in no time."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from springbench.harness.results import parquet_rows

SOLVER_NAMES = ("sparse", "numba", "hybrid", "xpbd", "lbfgs")


def build_dummy_rows(number: int, *, frames: int = 2) -> list[dict[str, Any]]:
    """The rows of a run: a step for each frame; the residual of the first was not computed, as it happens."""
    shared = {"run_id": f"{number:012x}", "sweep": "dummy", "scene": f"scene{number % 50}", "size": 8 + number % 9}
    shared |= {"solver": SOLVER_NAMES[number % 5], "parameters": "{}", "family": "local-global", "vertices": 64}
    shared |= {"springs": 210, "time_step": 1 / 30, "integrator": "implicit-euler", "max_iterations": 50, "threads": 1}
    shared |= {
        "machine_id": "00000000",
        "cpu": "a processor",
        "cores": 2,
        "memory_gib": 16.0,
        "operating_system": "Linux",
    }
    shared |= {"versions": '{"numpy": "2.4"}', "commit": "0" * 40, "source_fingerprint": "0" * 12, "status": "ok"}
    shared |= {"started_at": "2026-01-01T00:00:00+00:00", "is_minimiser": True, "is_substepping": False}
    return [
        shared
        | {"phase": "step", "frame": frame, "round": 0, "seconds": 1e-3 * (number % 7 + frame), "num_iterations": 50}
        | {"residual": float("nan") if frame == 1 else 1e-3, "positions_digest": f"{1000 * number + frame:064x}"}
        for frame in range(1, frames + 1)
    ]


def write_dummy_runs(sweep: Path, count: int, *, frames: int = 2, first_number: int = 0) -> list[Path]:
    """Write so many runs' rows into the folder of a sweep, by the writer that runs use."""
    folder = sweep / "rows"
    folder.mkdir(parents=True, exist_ok=True)
    units: list[Path] = []
    for number in range(first_number, first_number + count):
        units.append(folder / f"scene{number % 50}-{8 + number % 9}-{SOLVER_NAMES[number % 5]}-{number:012x}.parquet")
        parquet_rows.write_rows(units[-1], build_dummy_rows(number, frames=frames))
    return sorted(units)


if __name__ == "__main__":  # python -m tests.synthetic_run_rows FOLDER COUNT: for measurements of `springbench query`
    write_dummy_runs(Path(sys.argv[1]), int(sys.argv[2]), frames=20)
