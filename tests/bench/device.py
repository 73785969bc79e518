"""Measure solvers on a CUDA device compared with solvers on the processor, on single steps of a falling cloth.

    python -m tests.bench.device [--scenes SCENE ...] [--sizes 64 128 256] [--on device processor] [--threads 1]
        [--methods NAME ...] [--rounds 3] [--save FILE.parquet] [--publish results/published/devices]

Methods that exist for both are first compared by their iterates. Their distance is stated in units of the accepted
one: 1e-10 m in float64, and 1e-5 of the mean spring length in float32. Then each method solves the step to the same
residuals. Its time is the median of wall times without compilation, from the step problem in host memory to the
solution in host memory. XPBD, which does not minimise the objective, runs ten iterations. No other program may run at
the same time.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from itertools import islice, product
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from springbench.harness.config.config_loader import load_scene
from springbench.harness.execution.machine_info import limit_threads
from springbench.harness.scenes.scene_builder import build_scene
from springbench.harness.simulation.device_stepping import compute_event_seconds
from springbench.harness.simulation.time_loop import build_initial_state, build_problem, prepare, simulate_scene
from springbench.solvers.cuda import cuda_device
from springbench.solvers.iteration.device_interface import PreparedDeviceSolver
from springbench.solvers.methods.newton.newton_cg import NewtonCG
from springbench.solvers.methods.position_based.xpbd import Xpbd, XpbdSmallSteps
from springbench.solvers.methods.vertex_block.vbd import VertexBlockDescent
from springbench.solvers.model.step_problem import Positions, PreparedSolver, Solver, StepProblem, StopRule
from springbench.solvers.objective.fixed_objective import FixedObjective
from springbench.solvers.objective.step_objective import StepObjective
from springbench.solvers.registry import SOLVERS, load_target

from tests.bench.scripted_study import describe_provenance, publish_rows
from tests.cuda.near import PRECISIONS, spacing

SCENE = Path(__file__).parents[2] / "configs" / "scenes" / "hanging-cloth.yaml"
PROCESSOR = ("hybrid", "newton", "lbfgs", "numba", "vbd", "newton-cg")
XPBD_ITERATIONS = 10
MAX_SOLVE_SECONDS = 6.0
"""Time of a solve [s] above which a method is not measured at smaller tolerances."""

BOTH: dict[str, tuple[Callable[..., Any], int]] = {
    "vbd": (VertexBlockDescent, 20),
    "xpbd": (Xpbd, XPBD_ITERATIONS),
    "xpbd-small-steps": (XpbdSmallSteps, XPBD_ITERATIONS),
    "newton-cg": (lambda **on: NewtonCG(preconditioner="schwarz", **on), 2),
}
"""Methods that exist for device and processor, and the number of the iterate that is compared."""


def build_step(scene: Path, size: int, frames: int) -> StepProblem:
    """Build the problem of the step of a scene after a number of steps to a residual of 1e-3."""
    made = build_scene(load_scene(scene), size)
    state = build_initial_state(made)
    if frames:
        prepared = prepare(made, load_target(SOLVERS["hybrid"])())
        for step in simulate_scene(made, prepared, StopRule(300, 1e-3), initial_guess="previous", frames=frames):
            state = step.state
    return build_problem(made, state, "previous")


def compute_iterate(prepared: PreparedSolver, problem: StepProblem, count: int) -> Positions:
    """Compute the iterate (n, 3) [m] with a number."""
    *_, found = (p.copy() for p in islice(prepared.iterates(problem), count))
    return found


def compare_iterates(problem: StepProblem, methods: list[str]) -> Iterator[dict[str, Any]]:
    """Yield a row for each method and precision: the distance of its last iterate from the processor's.

    `change_units` is the change of the processor's iterate, in the same units, when its start is changed by round-off
    of that precision. `fall_ratio` is the decrease of the objective over that by the processor's iterate.
    """
    length = spacing(problem)
    step, rng = StepObjective(FixedObjective(problem.system), problem), np.random.default_rng(0)
    free = np.zeros((problem.system.num_vertices, 1))
    free[problem.system.free_vertices] = 1.0
    noise = free * rng.uniform(-1.0, 1.0, problem.initial_guess.shape)
    for name in methods:
        method, count = BOTH[name]

        reference = compute_iterate(method().prepare(problem.system), problem, count)
        for precision, unit, round_off in (("float64", 1e-10, 4e-16), ("float32", 1e-5 * length, 1e-7)):
            began = perf_counter()
            prepared = method(device="cuda", precision=precision).prepare(problem.system)
            found = compute_iterate(prepared, problem, count)
            seconds = perf_counter() - began
            assert isinstance(prepared, PreparedDeviceSolver)
            again = [prepared.replay_iterations(problem, count)[0].positions for _ in range(3)]
            target, guess = ((x + round_off * length * noise) for x in (problem.inertial_target, problem.initial_guess))
            start = replace(problem, inertial_target=target, initial_guess=guess)
            changed = compute_iterate(method().prepare(problem.system), start, count)
            falls = [step.objective_change(p, problem.initial_guess)[0] for p in (found, reference)]
            yield {
                "kind": "iterates", "method": name, "precision": precision, "iterations": count,
                "distance": float(np.abs(found - reference).max()),
                "units": float(np.abs(found - reference).max() / unit),
                "change_units": float(np.abs(changed - reference).max() / unit),
                "fall_ratio": float(falls[0] / falls[1]),
                "is_repeatable": all(bool((p == found).all()) for p in again), "first_seconds": seconds,
            }  # fmt: skip


def measure_method(
    solver: Solver, name: str, problem: StepProblem, tolerances: list[float], max_iterations: int, rounds: int
) -> list[dict[str, Any]]:
    """Return a row of one method for each tolerance up to the first that it does not reach: the median time of rounds.

    A method that minimises no objective has one row.
    """
    prepared = solver.prepare(problem.system)
    rows = list[dict[str, Any]]()
    for rtol in tolerances if type(solver).is_minimiser else (None,):
        stop = StopRule(max_iterations if rtol else XPBD_ITERATIONS, rtol or 0.0)
        began = perf_counter()
        found = prepared.solve(problem, stop)
        first = perf_counter() - began
        reached = rtol is None or found.termination_reason == "converged"
        seconds, events = list[float](), list[Mapping[str, float]]()
        for _ in range(rounds if first < MAX_SOLVE_SECONDS else 1):
            began = perf_counter()
            if isinstance(prepared, PreparedDeviceSolver):
                _, marks = prepared.replay_iterations(problem, found.num_iterations)
                events.append(compute_event_seconds(marks))
            else:
                prepared.solve(problem, stop)
            seconds.append(perf_counter() - began)
        rows.append({
            "kind": "time", "method": name, "rtol": rtol, "iterations": found.num_iterations,
            "reason": found.termination_reason, "seconds": float(np.median(seconds)), "fastest": min(seconds),
            **{k: float(np.median([e[k] for e in events])) for k in (events[0] if events else {})},
        })  # fmt: skip
        if not reached or max(seconds) > MAX_SOLVE_SECONDS:
            break
    return rows


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--scenes", type=Path, nargs="+", default=[SCENE])
    parser.add_argument("--sizes", type=int, nargs="+", default=[64, 128, 256])
    parser.add_argument("--frames", type=int, default=3, help="steps before the one that is solved")
    parser.add_argument("--on", nargs="+", choices=("device", "processor"), default=("device", "processor"))
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--methods", nargs="+", default=[*PROCESSOR, *BOTH])
    parser.add_argument("--precisions", nargs="+", choices=PRECISIONS, default=PRECISIONS)
    parser.add_argument("--tolerances", type=float, nargs="+", default=[1e-1, 1e-2, 1e-3, 1e-4])
    parser.add_argument("--max-iterations", type=int, default=2000)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=1e9, help="begin no method after this time")
    parser.add_argument("--save", type=Path)
    parser.add_argument("--publish", type=Path, help="folder of a published study")
    given, rows, begun = parser.parse_args(), list[dict[str, Any]](), perf_counter()
    begin = describe_provenance()

    def add(shared: dict[str, Any], new: Iterable[dict[str, Any]]) -> None:
        for row in new:
            rows.append(shared | row)
            print(" ".join(f"{k}={v:.4g}" if isinstance(v, float) else f"{k}={v}" for k, v in row.items()), flush=True)
        if given.save:
            columns = dict.fromkeys(name for row in rows for name in row)
            pq.write_table(pa.Table.from_pylist([columns | row for row in rows]), given.save)

    stopping = given.tolerances, given.max_iterations, given.rounds
    methods = list(dict.fromkeys(given.methods))
    both = [name for name in methods if name in BOTH]
    with limit_threads(given.threads):
        for scene, size in product(given.scenes, given.sizes):
            problem = build_step(scene, size, given.frames)
            shared = {"scene": scene.stem, "size": size, "frame": given.frames + 1, "threads": given.threads}
            if "device" in given.on:
                shared |= {"device": cuda_device.describe_device()["device"]}
                add(shared, compare_iterates(problem, both))
                for name in both:
                    for precision in given.precisions:
                        if perf_counter() - begun < given.seconds:
                            solver = BOTH[name][0](device="cuda", precision=precision)
                            add(shared, measure_method(solver, f"{name}, {precision}", problem, *stopping))
            if "processor" in given.on:
                for name in methods:
                    if perf_counter() - begun < given.seconds:
                        solver = load_target(SOLVERS[name])()
                        add(shared | {"device": None}, measure_method(solver, name, problem, *stopping))
    for scene in given.scenes:
        Console(width=120).print(build_table([row for row in rows if row["scene"] == scene.stem], scene.stem))
    publish_rows(given.publish, given.scenes[0], compare_sides(rows), begin)


def compare_sides(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return a row for each size and tolerance that both sides reached: the fastest method of each, and the ratio.

    `time_ratio` is the time on the device over that on the processor, copies included. XPBD has no tolerance.
    """
    fastest: dict[tuple[str, int, float | None, bool], dict[str, Any]] = {}
    for row in rows:
        if row["kind"] == "time" and is_reached(row):
            cell = (row["scene"], row["size"], row["rtol"], row["device"] is not None)
            fastest[cell] = min(fastest.get(cell, row), row, key=lambda one: one["seconds"])
    return [
        {
            "scene": scene,
            "size": size,
            "rtol": rtol,
            "device": row["device"].partition(",")[0],
            "device_method": row["method"],
            "processor_method": other["method"],
            "time_ratio": row["seconds"] / other["seconds"],
        }
        for (scene, size, rtol, on_device), row in fastest.items()
        if on_device and (other := fastest.get((scene, size, rtol, False)))
    ]


def build_table(rows: list[dict[str, Any]], scene: str) -> Table:
    """Build the table of a scene: milliseconds of each method by mesh size and tolerance."""
    timed = [row for row in rows if row["kind"] == "time"]
    cells = sorted({(row["size"], row["rtol"] or 0.0) for row in timed}, key=lambda cell: (cell[0], -cell[1]))
    table = Table("method", "on", *(f"{size}, {rtol:g}" for size, rtol in cells), box=SIMPLE_HEAD, title=f"{scene}, ms")
    for method, device in dict.fromkeys((row["method"], row["device"]) for row in timed):
        own = {(r["size"], r["rtol"] or 0.0): r for r in timed if (r["method"], r["device"]) == (method, device)}
        took = (f"{1e3 * own[c]['seconds']:.3g}" if c in own and is_reached(own[c]) else "" for c in cells)
        table.add_row(method, "device" if device else "processor", *took)
    return table


def is_reached(row: dict[str, Any]) -> bool:
    """Return whether a solve reached its tolerance, or has none."""
    return row["rtol"] is None or row["reason"] == "converged"


if __name__ == "__main__":
    main()
