"""Invented results, of any number of runs: what the page shows of them is known."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from springbench.harness.results.row_store import FILE_COLUMN
from springbench.harness.results.run_schema import RUN_SCHEMA
from springbench.harness.results.solver_metadata import read_solver_metadata

SOLVER_NAMES = ("sparse", "numba", "anderson", "newton", "xpbd")
SOLVER_COSTS = {"sparse": 5.0, "numba": 1.0, "anderson": 1.4, "newton": 9.0, "xpbd": 0.6}
"""Milliseconds a step of 100 vertices."""
SCENE_NAMES = ("hanging-cloth", "flag-in-wind", "curtain")
FRAME_COUNT = 6
UNSUPPORTED_REASON = "supports springs </script> alone, and the scene has wind"
_MACHINE_COLUMNS = {
    "machine_id": "0123456789ab", "node_id": "ab", "cpu": "A processor of 3 GHz", "cores": 8, "memory_gib": 31.2,
    "operating_system": "Linux 6.1 x86_64", "versions": json.dumps({"numpy": "2.4"}), "commit": "1" * 40,
}  # fmt: skip


def build_run_columns(number: int) -> dict[str, Any]:
    """What all rows of a run say; those of a number differ from all others in scene, size, solver or time step."""
    solver, scene = SOLVER_NAMES[number % 5], SCENE_NAMES[number // 5 % 3]
    size, step = 8 + 4 * (number // 15 % 8), 1 / (30 + number // 120)
    label = f"{scene}-{size}-{solver}-{number:012x}"
    return {
        "run_id": f"{number:012x}", FILE_COLUMN: label, "sweep": "made", "scene": scene, "size": size, "solver": solver,
        "parameters": "{}", "vertices": size * size, "springs": 4 * size * size, "time_step": step,
        "integrator": "implicit-euler", "initial_guess": "previous", "max_iterations": 50, "threads": 1,
        "source_fingerprint": "old" if number == 1 else "new", "status": "ok",
        "started_at": f"2026-11-{1 + number % 20:02d}T10:00:00+00:00", **_MACHINE_COLUMNS,
        **read_solver_metadata(solver),
    }  # fmt: skip


def is_failing_run(number: int) -> bool:
    """One in twenty does."""
    return number % 20 == 12


def build_run_rows(number: int) -> list[dict[str, Any]]:
    """The rows of a run: preparing twice, then each step in two rounds, or why there are none."""
    same = build_run_columns(number)
    if is_failing_run(number):
        return [
            same
            | {"phase": "run", "status": "unsupported", "reason": f"{same['solver']} {UNSUPPORTED_REASON} {number}"}
        ]
    ms = SOLVER_COSTS[same["solver"]] * same["vertices"] / 100
    prepare = [same | {"phase": "prepare", "round": k, "seconds": 1e-3 * ms * (9 - 8 * k)} for k in range(2)]
    steps = [
        same
        | {"phase": "step", "frame": frame, "round": k, "seconds": 1e-3 * ms * (1 + 0.1 * k + 0.02 * frame)}
        | {
            "num_iterations": 50,
            "termination_reason": "max-iter",
            "residual": 1e-3 / frame,
            "max_strain": 0.05 * frame,
        }
        | {"objective": 1.0 / frame, "positions_digest": f"{same['scene']}{same['size']}{frame}"}
        for frame in range(1, FRAME_COUNT + 1)
        for k in range(2)
    ]
    parts = [same | {"phase": phase, "frame": 1, "seconds": 1e-5 * ms} for phase in ("local", "global")]
    return [*prepare, *steps, *parts]


def write_site_results(results: Path, count: int, name: str = "made") -> Path:
    """The rows of so many runs in the packed file of a sweep; returns the sweep's folder."""
    folder = results / name
    folder.mkdir(parents=True, exist_ok=True)
    given_rows = [row for number in range(count) for row in build_run_rows(number)]
    schema = RUN_SCHEMA.append(pa.field(FILE_COLUMN, pa.string()))
    columns = {field.name: [row.get(field.name) for row in given_rows] for field in schema}
    pq.write_table(pa.table(columns, schema=schema), folder / "rows.parquet")
    return folder


def write_foreign_picture(path: Path) -> None:
    """A picture that is none of ours, and small."""
    from PIL import Image

    path.parent.mkdir(parents=True, exist_ok=True)
    ramp = np.linspace(40, 220, 160, dtype=np.uint8)[None, :].repeat(90, 0)
    Image.fromarray(np.stack([ramp, ramp[:, ::-1], 255 - ramp], 2)).save(path)
