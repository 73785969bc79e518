"""Rows of runs on a device and on the processor of one computer: made up, not measured."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from springbench.harness.results import parquet_rows

ON = '{"device": "cuda", "spectral_radius": 0.999}'


def build_device_rows(
    number: int, solver: str, vertices: int, seconds: float, *, on: bool = False, tolerance: float = 1e-3, **more: Any
) -> list[dict[str, Any]]:
    """The rows of a run of two steps; more: columns that differ."""
    row = {"run_id": f"{number:012x}", "sweep": "gpu", "scene": "cloth", "size": round(vertices**0.5), "phase": "step"}
    row |= {"solver": solver, "parameters": ON if on else "{}", "vertices": vertices, "residual_rtol": tolerance}
    row |= {
        "status": "ok",
        "termination_reason": "converged",
        "machine_id": "m",
        "node_id": "n",
        "num_iterations": 10,
        "round": 0,
    }
    row |= {
        "integrator": "implicit-euler",
        "time_step": 1 / 30,
        "is_minimiser": True,
        "started_at": "2026-01-01T00:00:00",
    }
    if on:
        row |= {"device": "a device", "kernel_seconds": 0.01}
    return [row | {"frame": frame, "seconds": seconds} | more for frame in (1, 2)]


DEVICE_ROWS = [
    *build_device_rows(0, "vbd", 10_000, 0.02, on=True),
    *(build_device_rows(1, "hybrid", 10_000, 0.01) + build_device_rows(2, "numba", 10_000, 0.5)),
    *(build_device_rows(3, "vbd", 100_000, 0.05, on=True) + build_device_rows(4, "hybrid", 100_000, 0.2)),
    *(build_device_rows(5, "vbd", 1_000_000, 0.1, on=True) + build_device_rows(6, "numba", 1_000_000, 3.0)),
    *build_device_rows(7, "vbd", 4_000_000, 0.4, on=True),
    *build_device_rows(8, "vbd", 10_000, 1.0, on=True, tolerance=1e-4),
    *build_device_rows(9, "hybrid", 10_000, 0.1, tolerance=1e-4),
    *build_device_rows(10, "numba", 10_000, 1e-9, termination_reason="max-iter"),  # it did not get there
    *build_device_rows(11, "hybrid", 100_000, 1e-9, node_id="another"),  # where no device was
]
"""Runs to two residuals: to the first, a device pays from 100,000 vertices on."""


def write_device_results(folder: Path, rows: list[dict[str, Any]] = DEVICE_ROWS) -> Path:
    """Write rows as a sweep, one file for each run; returns the folder."""
    for unit in {row["run_id"] for row in rows}:
        path = folder / "rows" / f"{unit}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        parquet_rows.write_rows(path, [row for row in rows if row["run_id"] == unit])
    return folder
