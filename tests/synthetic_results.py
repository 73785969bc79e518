"""Results of every kind for figures of known looks: made up, not measured."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pyarrow as pa
from springbench.harness.experiments.ablation.ablation_schema import ABLATION_SCHEMA as ABLATION
from springbench.harness.results import parquet_rows as base_rows
from springbench.harness.results.run_schema import RUN_SCHEMA

from tests import synthetic_accuracy_rows as made
from tests import synthetic_benchmarks
from tests.synthetic_recordings import build_recording_info, write_recording

SHARED_COLUMNS = {
    "machine_id": "abc",
    "cpu": "A processor",
    "threads": 1,
    "commit": "0" * 40,
    "source_fingerprint": "abc",
    "status": "ok",
}
SOLVER_NAMES = ("dense", "sparse", "numba", "newton", "hybrid", "xpbd")
EFFECT_NAMES = ("springs", "gravity", "pins", "bending", "wind", "dashpots", "contact", "air-drag")


def write_result_rows(path: Path, rows: Any, schema: pa.Schema = RUN_SCHEMA) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    base_rows.write_rows(path, rows, schema)


def write_accuracy_results(folder: Path) -> Path:
    """Two scenes from both first guesses, one of three sizes, and simulations."""
    rows: list[dict[str, Any]] = []
    for size in (10, 24, 48):
        rows += made.build_snapshot_rows("net", size, "early")
        for solver in ("sparse", "numba", "lbfgs", "newton", "hybrid"):
            for guess in ("previous", "inertial"):
                rows += made.build_curve_rows("net", size, "early", solver, initial_guess=guess)
    rows += made.build_snapshot_rows("block", 8, "peak")
    rows += made.build_curve_rows(
        "block", 8, "peak", "lbfgs", status="time-limit", reason="the limit of 5 s was reached"
    )
    return made.write_accuracy_rows(folder, [*rows, *made.build_work_rows("net", 10), *made.build_liu2013_rows(1.3)])


def write_winner_results(folder: Path) -> Path:
    """Simulations of five stiffnesses on three meshes: explicit methods pay for stiffness, high orders for steps."""
    rows: list[dict[str, Any]] = []
    methods = (
        ("numba", "implicit-euler", 1, 1.0),
        ("newton", "esdirk-4", 4, 8.0),
        ("dormand-prince-8", "substepping", 8, 12.0),
    )
    for size in (9, 17, 33):
        for stiffness in (30, 300, 3000, 30000, 300000):
            for solver, integrator, order, price in methods:
                number = stiffness * size**2 / 100.0
                for steps in (10, 40, 160):
                    least = 2.0 * number**0.5 if integrator == "substepping" else 1.0
                    cost = price * max(steps, least) * 1e-6 * size**2
                    row = made.build_shared_columns(
                        f"sway-{stiffness}", size, solver=solver, parameters="{}", kind="work"
                    )
                    row |= {"integrator": integrator, "time_step": 1.0 / steps, "max_iterations": 50, "t_end": 1.0}
                    row |= {
                        "is_minimiser": integrator != "substepping",
                        "family": "explicit" if integrator == "substepping" else "other",
                    }
                    row |= {
                        "seconds": [cost],
                        "seconds_per_simulated_second": cost,
                        "cpu_seconds": cost,
                        "vertices": size**2,
                    }
                    row |= {"error": (0.3 / steps) ** order, "stiffness_ratio": 900.0 * number / steps**2}
                    rows.append(row)
    return made.write_accuracy_rows(folder, rows)


def write_engine_results(folder: Path) -> Path:
    """Simulations on two meshes by two engines and two methods of ours; one engine refuses the second mesh."""
    rows: list[dict[str, Any]] = []
    tried = (("hybrid", 1, 1.0), ("velocity-verlet", 2, 2.0), ("mujoco", 4, 30.0), ("pypbd", 1, 5.0))
    for mesh in ("net", "stiff"):
        for solver, order, price in tried:
            for steps in (10, 40, 160):
                row = made.build_shared_columns(mesh, 9, solver=solver, parameters="{}", kind="work")
                row |= {
                    "integrator": "substepping",
                    "time_step": 1 / 30,
                    "max_iterations": steps,
                    "t_end": 0.5,
                    "is_substepping": True,
                }
                row |= {"is_minimiser": False, "family": "engine" if solver in ("mujoco", "pypbd") else "explicit"}
                row |= {
                    "seconds_per_simulated_second": price * steps * 1e-4,
                    "error": (1.0 / steps) ** order,
                    "vertices": 81,
                }
                if (mesh, solver) == ("stiff", "pypbd"):
                    row |= {"status": "unsupported", "reason": "expresses no such gravity", "error": None}
                rows.append(row)
    return made.write_accuracy_rows(folder, rows)


def write_sweep_results(folder: Path, sizes: tuple[int, ...] = (8, 16, 32)) -> Path:
    """Runs of all solvers at these sizes, judged, of four cases of two families; one of them failed."""
    cases = ("geometry-flat", "geometry-line", "numbers-large", "numbers-small")
    for case in cases:
        for place, solver in enumerate(SOLVER_NAMES):
            for size in sizes if case == cases[0] else sizes[:1]:
                write_result_rows(
                    folder / "rows" / f"{case}-{solver}-{size}.parquet", _build_run_rows(case, solver, place, size)
                )
    return folder


def _build_run_rows(case: str, solver: str, place: int, size: int) -> list[dict[str, Any]]:
    known = SHARED_COLUMNS | {"run_id": f"{case}-{solver}-{size}", "scene": case, "size": size, "solver": solver}
    known |= {
        "parameters": "{}",
        "vertices": size**2,
        "springs": 4 * size**2,
        "started_at": "2026",
        "frame": 1,
        "round": 0,
    }
    if (case, solver) == ("numbers-large", "xpbd"):
        return [known | {"phase": "run", "status": "diverged", "reason": "not finite", "frame": None}]
    second = 1e-7 * (place + 1) * size ** (2.0 + place / 4)
    judged = {
        "stationarity": 1e-7,
        "stationarity_above_roundoff": 10.0 ** (place - 8),
        "is_local_minimum": place != 3,
        "is_degenerate": False,
    }
    judged |= {"reference_distance": 1e-5, "termination_reason": "max-iter"}
    steps = [
        known | judged | {"phase": "step", "seconds": second * f, "frame": k + 1} for k, f in enumerate((0.9, 1, 1.2))
    ]
    return [*steps, *(known | {"phase": "prepare", "round": k, "seconds": (9 - 3 * k) * second} for k in range(2))]


def write_ablation_results(folder: Path) -> Path:
    """Effects of all costs and changes, some of which nothing can measure."""
    whole = SHARED_COLUMNS | {
        "scene": "cloth",
        "size": 16,
        "solver": "hybrid",
        "vertices": 256,
        "frames": 10,
        "rounds": 5,
    }
    whole |= {"time_step": 0.01, "seconds": 1.0}
    rows: list[dict[str, Any]] = [whole | {"kind": "full-scene", "name": ""}]
    for k, name in enumerate(EFFECT_NAMES):
        cost = {"added_seconds": 0.05 * k, "added_seconds_low": 0.05 * k - 0.04, "added_seconds_high": 0.05 * k + 0.03}
        rows.append(
            whole
            | cost
            | {"kind": "ablated", "name": name, "displacement_max": 10.0 ** (1 - k), "bounding_box_diagonal": 20.0}
        )
    rows += [
        whole | {"kind": "error", "name": n, "displacement_max": e} for n, e in (("solver", 3e-5), ("time-step", 2e-2))
    ]
    for solver in ("numba", "newton"):
        for k, name in enumerate(EFFECT_NAMES):
            price = {
                "overhead_ratio": 1.0 + 0.2 * k,
                "overhead_ratio_low": 1.0 + 0.18 * k,
                "overhead_ratio_high": 1.0 + 0.25 * k,
            }
            rows.append(whole | price | {"kind": "overhead", "name": name, "solver": solver})
    refused = {"kind": "overhead", "solver": "dense", "status": "unsupported"}
    rows += [whole | refused | {"name": name} for name in EFFECT_NAMES[3:]]
    write_result_rows(folder / "ablation" / "cloth.parquet", rows, ABLATION)
    return folder


def write_speed_results(folder: Path) -> Path:
    """A speed report: the machine's limits and three candidates at three sizes, the last by other code."""
    for size in (8, 16, 32):
        known = SHARED_COLUMNS | {
            "scene": "cloth",
            "size": size,
            "vertices": size**2,
            "springs": 4 * size**2,
            "load_average": 0.5,
        }
        machine = known | {
            "run_id": f"m{size}",
            "solver": "machine",
            "parameters": "{}",
            "phase": "read",
            "bytes_moved": 1e3,
        }
        limits = [machine | {"seconds": 1e-6, "working_set_bytes": 1e3, "flops": None}]
        limits += [
            machine | {"phase": f"fma {k}", "seconds": 1e-6, "bytes_moved": None, "flops": 1e4}
            for k in ("float64", "float32")
        ]
        limits = [row | {"working_set_bytes": row.get("working_set_bytes") or 0.0} for row in limits]
        write_result_rows(folder / "rows" / f"machine-{size}.parquet", limits)
        for place, (solver, linear) in enumerate((("sparse", None), ("numba", "auto"), ("numba", "supernodal"))):
            parameters = json.dumps({"linear_solver": linear} if linear else {})
            one = known | {"run_id": f"{solver}{linear}{size}", "solver": solver, "parameters": parameters}
            one |= (
                {"started_at": "2025"} if linear == "supernodal" else {"started_at": "2026", "source_fingerprint": None}
            )
            rows = [
                one
                | {"phase": phase, "round": k, "seconds": share * 1e-6 * (4 - place) * size**2, "num_iterations": 10}
                for phase, share in (("prepare", 5.0), ("local", 0.3), ("global", 0.7), ("step", 1.0))
                for k in range(3)
            ]
            write_result_rows(folder / "rows" / f"{solver}-{linear}-{size}.parquet", rows)
    return folder


def write_benchmark_history(folder: Path) -> Path:
    """Thirty results of two gates, one of which became slower by 5 %."""
    changed, same = (
        synthetic_benchmarks.build_ratio_series(3, 30, (18, 1.05)),
        synthetic_benchmarks.build_ratio_series(4, 30),
    )
    return synthetic_benchmarks.write_benchmark_files(folder, {"test_step[cloth]": changed, "test_local": same})


def write_recorded_runs(folder: Path) -> Path:
    """Two runs of one scene with their recordings, of different residuals."""
    (folder / "recordings").mkdir(parents=True)
    for solver, amplitude in (("numba", 0.1), ("newton", 0.05)):
        for row in (rows := _build_run_rows("cloth", solver, 1, 6)):
            row["vertices"] = 36
        write_result_rows(folder / "rows" / f"{solver}.parquet", rows)
        properties = {"scene": "cloth", "size": 6, "solver": solver, "milliseconds_per_step": 1.25}
        of = build_recording_info(run_id=rows[0]["run_id"], properties=properties)
        write_recording(
            folder / "recordings" / f"cloth-6-{solver}-{rows[0]['run_id']}.rrd", of, frame_count=4, amplitude=amplitude
        )
    return folder
