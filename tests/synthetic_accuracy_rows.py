"""Rows of an invented accuracy measurement: methods that converge at known rates and take known times."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from springbench.harness.experiments.accuracy.accuracy_schema import ACCURACY_SCHEMA
from springbench.harness.report.accuracy.liu2013_comparison import (
    LIU2013_FIGURE_2,
    LIU2013_FIGURE_3,
    LIU2013_ITERATIONS,
)
from springbench.harness.results.solver_metadata import read_solver_metadata

# The gap falls by `rate` an iteration (Newton: squares); an iteration takes `cost` and preparing `setup` seconds a
# vertex.
SYNTHETIC_METHODS = {
    "sparse": {"rate": 0.93, "cost": 4e-7, "setup": 3e-6},
    "numba": {"rate": 0.93, "cost": 5e-8, "setup": 2e-6},
    "anderson": {"rate": 0.8, "cost": 9e-8, "setup": 2e-6},
    "chebyshev": {"rate": 0.85, "cost": 6e-8, "setup": 2e-6},
    "lbfgs": {"rate": 0.7, "cost": 1.2e-7, "setup": 2e-6},
    "newton": {"rate": None, "cost": 4e-6, "setup": 0.0},
    "newton-cg": {"rate": 0.3, "cost": 1.5e-6, "setup": 2e-6},
    "hybrid": {"rate": 0.6, "cost": 1.3e-7, "setup": 2e-6},
}
RECORDED_ITERATIONS = tuple(sorted({round(10 ** (k / 12)) for k in range(37)} | {0}))
MACHINE_COLUMNS = {"machine_id": "abc", "cpu": "A processor", "cores": 2, "threads": 1, "commit": "0" * 40}
LOWEST_ENERGY, ENERGY_DROP = 0.25, 2.0  # g* and g0 - g* [J]
ROUNDOFF_GAP = 1e-12  # the least gap that a method reaches


def build_shared_columns(scene: str, size: int, **more: Any) -> dict[str, Any]:
    return {
        "sweep": "accuracy",
        "scene": scene,
        "size": size,
        "vertices": size * size,
        "springs": 4 * size * size,
        "integrator": "implicit-euler",
        "time_step": 1 / 30,
        "status": "ok",
        **MACHINE_COLUMNS,
        **(read_solver_metadata(more["solver"]) if "solver" in more else {}),
        **more,
    }


def build_snapshot_rows(
    scene: str, size: int, snapshot: str, *, certified: bool = True, minima_count: int = 1
) -> list[dict[str, Any]]:
    """A frozen step, and its minima 0.1 J apart."""
    digest = f"{scene}-{size}-{snapshot}"
    row = build_shared_columns(scene, size, problem_digest=digest, snapshot=snapshot, frame=7)
    facts = {
        "stiffness_ratio": 6.4e4,
        "mean_rest_length": 1 / size,
        "objective_initial": LOWEST_ENERGY + ENERGY_DROP,
        "objective_inertial": LOWEST_ENERGY + 0.5 * ENERGY_DROP,
    }
    minima = [
        row
        | {
            "kind": "minimum",
            "minimum_index": k,
            "minimum_id": f"m{k}",
            "objective": LOWEST_ENERGY + 0.1 * k,
            "stationarity": 1e-14,
        }
        | {"min_eigenvalue": 0.1, "is_certified": certified}
        for k in range(minima_count)
    ]
    return [row | facts | {"kind": "snapshot", "objective_magnitude": 40.0}, *minima]


def compute_gaps(rate: float | None, iterations: Sequence[int], start: float) -> np.ndarray:
    k = np.asarray(iterations, float)
    fall = rate**k if rate else 0.5 ** (2.0 ** np.minimum(k, 8) - 1)
    return np.maximum(start * fall, ROUNDOFF_GAP)


def build_curve_rows(
    scene: str,
    size: int,
    snapshot: str,
    solver: str,
    *,
    initial_guess: str = "previous",
    minimum_index: int = 0,
    **more: Any,
) -> Iterator[dict[str, Any]]:
    """The rows of a solve: of preparing, then each iterate that is recorded, down to round-off."""
    method = SYNTHETIC_METHODS[solver]
    row = build_shared_columns(
        scene, size, solver=solver, parameters="{}", problem_digest=f"{scene}-{size}-{snapshot}", snapshot=snapshot
    )
    row |= {"frame": 7, "initial_guess": initial_guess, **more}
    yield row | {"kind": "prepare", "seconds": [method["setup"] * size**2] * 3, "cold_seconds": 1.0}
    start = {"previous": 1.0, "inertial": 0.2}[initial_guess]
    floor = 0.1 * minimum_index / ENERGY_DROP
    for k, gap in zip(RECORDED_ITERATIONS, compute_gaps(method["rate"], RECORDED_ITERATIONS, start), strict=True):
        g, stamp = LOWEST_ENERGY + ENERGY_DROP * (gap + floor), method["cost"] * size**2 * k
        yield (
            row
            | {
                "kind": "curve",
                "iteration": k,
                "objective": g,
                "minimum_index": minimum_index,
                "minimum_id": f"m{minimum_index}",
            }
            | {
                "position_error_max_m": 0.3 * np.sqrt(gap),
                "position_error_rms_m": 0.1 * np.sqrt(gap),
                "stationarity": np.sqrt(gap),
            }
            | {"seconds": [stamp * factor for factor in (0.97, 1.0, 1.1)], "max_iterations": 1000}
        )
        if gap <= ROUNDOFF_GAP:
            return


def build_failure_row(scene: str, size: int, snapshot: str, solver: str, status: str, reason: str) -> dict[str, Any]:
    row = build_shared_columns(
        scene, size, solver=solver, parameters="{}", problem_digest=f"{scene}-{size}-{snapshot}", snapshot=snapshot
    )
    return row | {"kind": "curve", "initial_guess": "previous", "status": status, "reason": reason}


INTEGRATOR_ORDERS = {"implicit-euler": (1, 8.0), "bdf2": (2, 20.0), "midpoint": (2, 6.0)}


def build_work_rows(
    scene: str, size: int, solvers: Sequence[str] = ("numba", "hybrid", "xpbd")
) -> Iterator[dict[str, Any]]:
    """Simulations of a second: their error falls with the time step as the integrator's order says."""
    for solver in solvers:
        for integrator, (order, constant) in INTEGRATOR_ORDERS.items():
            for dt in (1 / 30, 1 / 60, 1 / 120, 1 / 240):
                for tolerance, iterations in ((None, 50), (1e-2, 1000), (1e-4, 1000)):
                    slip = {None: 0.3, 1e-2: 0.05, 1e-4: 0.001}[tolerance] * (0.4 if solver == "hybrid" else 1.0)
                    error = constant * dt**order + slip
                    cost = {None: 50, 1e-2: 20, 1e-4: 90}[tolerance] * 5e-8 * size**2 / dt
                    cost *= {"hybrid": 0.5, "xpbd": 0.3}.get(solver, 1.0)
                    yield (
                        build_shared_columns(
                            scene, size, solver=solver, parameters="{}", kind="work", problem_digest="t"
                        )
                        | {
                            "integrator": integrator,
                            "time_step": dt,
                            "residual_rtol": tolerance,
                            "max_iterations": iterations,
                        }
                        | {"t_end": 1.0, "seconds": [cost] * 3, "seconds_per_simulated_second": cost, "error": error}
                        | {"cpu_seconds": 0.9 * cost, "stiffness_ratio": 1e3 * dt**2, "vertices": size**2}
                        | {"end_error_rms_m": 0.1 * error, "initial_guess": "assignment", "num_iterations": 1500}
                    )


def write_accuracy_rows(folder: Path, rows: Sequence[dict[str, Any]]) -> Path:
    """Write the rows as results; returns the folder."""
    (folder / "accuracy").mkdir(parents=True, exist_ok=True)
    table = pa.Table.from_pylist(list(rows), schema=ACCURACY_SCHEMA)
    pq.write_table(table, folder / "accuracy" / f"{len(list((folder / 'accuracy').iterdir()))}.parquet")
    return folder


def build_full_rows() -> list[dict[str, Any]]:
    """Three scenes, three sizes of one, all methods from both first guesses, failures and doubts among them."""
    rows: list[dict[str, Any]] = []
    for scene, sizes in (("net", (10, 24, 48)), ("curtain", (21,)), ("block", (8,))):
        for size in sizes:
            for moment in ("early", "middle", "peak"):
                doubtful = scene == "block" and moment == "peak"
                rows += build_snapshot_rows(
                    scene, size, moment, certified=not doubtful, minima_count=1 + (scene == "curtain")
                )
                for solver in SYNTHETIC_METHODS:
                    for guess in ("previous", "inertial"):
                        branch = int(scene == "curtain" and solver == "newton" and guess == "inertial")
                        rows += build_curve_rows(scene, size, moment, solver, initial_guess=guess, minimum_index=branch)
                if scene == "block":
                    rows.append(
                        build_failure_row(scene, size, moment, "dense", "unsupported", "dense supports springs alone")
                    )
                    rows.append(
                        build_failure_row(scene, size, moment, "vbd", "diverged", "not finite from iteration 3 on")
                    )
        rows += build_work_rows(scene, sizes[0])
    return rows


def build_liu2013_rows(times: float = 1.0) -> list[dict[str, Any]]:
    """The reproduction of the paper with errors that are so many times those that it gives, in two frames each."""
    rows: list[dict[str, Any]] = []
    for (side, k), errors in LIU2013_FIGURE_3.items():
        for frame in (1, 2):
            name = f"curtain-{side}-{k}-{frame}"
            found = build_snapshot_rows("curtain", side, f"frame-{frame}")
            points = [(0, 1.0), *zip(LIU2013_ITERATIONS, errors, strict=True)]
            long = (side, frame) == (81, 1)
            if long:  # the step of figure 2
                points = [(0, 1.0), *((n, error) for n, (error, _) in LIU2013_FIGURE_2.items()), (50, 0.06)]
            same = build_shared_columns(
                "curtain", side, solver="numba", parameters="{}", initial_guess="inertial", kind="curve"
            )
            found += [
                same
                | {"snapshot": f"frame-{frame}", "frame": frame, "iteration": n, "minimum_index": 0, "minimum_id": "m0"}
                | {
                    "objective": LOWEST_ENERGY + 0.5 * ENERGY_DROP * (times * error if n else 1.0),
                    "stationarity": error,
                    "max_iterations": 1000,
                }
                | {"position_error_max_m": error, "position_error_rms_m": error, "seconds": [1e-6 * n * side**2] * 2}
                for n, error in points
            ]
            dt = found[0]["time_step"]
            changed = {"problem_digest": name, "sweep": "liu2013"}
            rows += [row | changed | {"stiffness_ratio": 1.03 * k * side**2 * dt**2} for row in found]
    return rows
