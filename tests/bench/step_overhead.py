"""Python time of a step, by method: the processor time of a solve of four vertices, whose kernels do next to nothing.

    t(j) = t_fixed + j t_iteration      t(1) and t(1 + MORE_ITERATIONS), lower quartiles of interleaved repeats

    python -m tests.bench.step_overhead [METHOD ...] [--repeats 40] [--publish results/published/step-overhead]

The kernels of a spring take tens of nanoseconds, so that the time of such a solve bounds its Python time from above.
A method whose iterations are compiled together takes less than a microsecond for each further one. `solve` is the
solver's own part of a step, with one iteration and its last residual; `to a tolerance` has the default stop rule of a
config, `StopRule(50, 1e-3)`, in which a residual is computed in each iteration; `step` is the whole step of a
simulation, with the inertial target and the measurement of its time.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from time import thread_time
from typing import Any

import numpy as np
from rich.table import Table
from springbench.harness.config.config_loader import load_scene
from springbench.harness.console import get_output_console
from springbench.harness.execution.machine_info import limit_threads
from springbench.harness.scenes.scene_builder import build_scene
from springbench.harness.simulation.time_loop import build_initial_state, build_problem, prepare, simulate_scene
from springbench.solvers.model.step_problem import StopRule
from springbench.solvers.registry import SOLVERS, load_target

from tests.bench.scripted_study import describe_provenance, publish_rows

SCENE = Path(__file__).parents[2] / "configs" / "scenes" / "net.yaml"
SIZE = 2
METHODS = (
    *("numba", "anderson", "chebyshev", "lbfgs", "admm", "a-jacobi", "pncg", "hybrid", "vbd", "avbd"),
    *("xpbd", "xpbd-small-steps", "symplectic-euler", "velocity-verlet", "newton", "newton-cg"),
)
"""The methods with compiled iterations."""
MIN_SAMPLE_SECONDS = 30e-6
MORE_ITERATIONS = 4
"""Further iterations of the second solve; after more, some methods would be at round-off."""
BATCH_SOLVES = 50
"""Solves one after the other of which the time is measured together, as in a simulation, whose caches are warm."""


def build_calls(solver_name: str) -> dict[str, Callable[[], Any]]:
    """Build the calls that are timed, by name: each a batch of solves, or a simulation of as many steps."""
    scene = build_scene(load_scene(SCENE), SIZE)
    problem = build_problem(scene, build_initial_state(scene), "previous")
    solver = prepare(scene, load_target(SOLVERS[solver_name])())

    def simulate() -> None:
        for _ in simulate_scene(scene, solver, StopRule(1), initial_guess="previous", frames=BATCH_SOLVES):
            pass

    def solve_batch(stop: StopRule) -> None:
        for _ in range(BATCH_SOLVES):
            solver.solve(problem, stop)

    return {
        "solve": lambda: solve_batch(StopRule(1)),
        "more": lambda: solve_batch(StopRule(1 + MORE_ITERATIONS)),
        "tolerance": lambda: solve_batch(StopRule(50, 1e-3)),
        "step": simulate,
    }


def measure_methods(methods: Sequence[str], repeats: int) -> list[dict[str, Any]]:
    """Measure the calls of all methods in turn; one row for each method, with lower quartiles in seconds."""
    calls = {(method, name): call for method in methods for name, call in build_calls(method).items()}
    times: dict[tuple[str, str], list[float]] = {key: [] for key in calls}
    for call in calls.values():
        call()  # compiles
    for _ in range(repeats):
        for key, call in calls.items():
            began = thread_time()
            call()
            times[key].append((thread_time() - began) / BATCH_SOLVES)
    found = {key: float(np.quantile(values, 0.25)) for key, values in times.items()}
    return [
        {
            "solver": method,
            "solve_seconds": found[method, "solve"],
            "iteration_seconds": (found[method, "more"] - found[method, "solve"]) / MORE_ITERATIONS,
            "tolerance_seconds": found[method, "tolerance"],
            "step_seconds": found[method, "step"],
        }
        for method in methods
    ]


def main() -> None:
    """Print the table, in microseconds."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("methods", nargs="*", default=METHODS, metavar="METHOD", help="names of solvers")
    parser.add_argument("--repeats", type=int, default=40)
    parser.add_argument("--publish", type=Path, help="folder of a published study")
    options = parser.parse_args()
    begin = describe_provenance()
    with limit_threads(1):
        rows = measure_methods(options.methods, options.repeats)
    table = Table("solver", "solve", "each further iteration", "to a tolerance", "step", title="microseconds")
    for row in rows:
        table.add_row(row["solver"], *(f"{1e6 * value:.1f}" for key, value in row.items() if key != "solver"))
    get_output_console().print(table)
    over = [row["solver"] for row in rows if row["solve_seconds"] > MIN_SAMPLE_SECONDS]
    get_output_console().print(f"above {1e6 * MIN_SAMPLE_SECONDS:g} microseconds a solve: {', '.join(over) or 'none'}")
    publish_rows(options.publish, SCENE, rows, begin)


if __name__ == "__main__":
    main()
