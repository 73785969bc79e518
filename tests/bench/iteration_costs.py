"""Measure the processor time of methods on one step: to a residual, and of an iteration.

    python -m tests.bench.iteration_costs [--repeats 5] [--publish results/published/iteration-costs]

The steps are the first ones of the scenes of `configs/claims.yaml`, solved to residuals of 1e-3, 1e-4 and 1e-6. All
methods run interleaved in one process on one thread, without their preparation. The table has the medians of the
repeats; the mark > denotes a method that does not converge. A method that takes seconds stops after 50 iterations,
which is sufficient for the time of one.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from statistics import median
from time import thread_time
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from springbench.harness.config.config_loader import load_sweep
from springbench.harness.execution.machine_info import limit_threads
from springbench.harness.scenes.scene_builder import build_scene
from springbench.harness.simulation.time_loop import build_initial_state, build_problem, prepare
from springbench.solvers.model.step_problem import StopRule
from springbench.solvers.registry import SOLVERS, load_target

from tests.bench.scripted_study import describe_provenance, publish_rows

CONFIG = Path(__file__).parents[2] / "configs" / "claims.yaml"
METHODS: dict[str, dict[str, Any]] = {
    **{name: {} for name in ("numba", "newton", "hybrid", "lbfgs", "a-jacobi", "vbd", "jgs2")},
    "jgs2, 24 rings": {"neighbour_rings": 24, "lateral_stiffness_ratio": 0.001},
}
"""Parameters of methods by their labels, which begin with the solver's name."""

SCENES_OF_METHODS = {"jgs2, 24 rings": ("block-pressed-0",)}
"""Scenes of methods whose preparation takes too long on the others."""

RESIDUALS = (1e-3, 1e-4, 1e-6)
MAX_ITERATIONS = {"jgs2": 50}
"""Iteration limit of methods that take seconds."""


def measure_scenes(repeats: int) -> list[dict[str, Any]]:
    """Measure all methods on each scene of the config; one row for each solve."""
    rows = list[dict[str, Any]]()
    for scene_name, run in {run.scene_name: run for run in load_sweep(CONFIG).list_runs()}.items():
        scene = build_scene(run.scene, run.size)
        problem = build_problem(scene, build_initial_state(scene), "previous")
        solvers = {
            label: prepare(scene, load_target(SOLVERS[label.partition(",")[0]])(**parameters))
            for label, parameters in METHODS.items()
            if scene_name in SCENES_OF_METHODS.get(label, (scene_name,))
        }
        for solver in solvers.values():
            solver.solve(problem, StopRule(2))  # compiles
        for repeat in range(repeats):
            for rtol in RESIDUALS:
                for name, solver in solvers.items():
                    stop = StopRule(MAX_ITERATIONS.get(name, 5000), rtol)
                    began = thread_time()
                    solution = solver.solve(problem, stop)
                    seconds = thread_time() - began
                    rows.append(
                        {
                            "scene": scene_name,
                            "size": run.size,
                            "solver": name,
                            "residual_rtol": rtol,
                            "repeat": repeat,
                            "num_iterations": solution.num_iterations,
                            "is_converged": solution.termination_reason == "converged",
                            "cpu_seconds": seconds,
                        }
                    )
    return rows


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--publish", type=Path, help="folder of a published study")
    options = parser.parse_args()
    begin = describe_provenance()
    with limit_threads(1):
        rows = measure_scenes(options.repeats)
    table = Table("scene", "residual", "solver", "iterations", "ms", "µs an iteration", box=SIMPLE_HEAD)
    for scene, rtol, name in dict.fromkeys((row["scene"], row["residual_rtol"], row["solver"]) for row in rows):
        some = [row for row in rows if (row["scene"], row["residual_rtol"], row["solver"]) == (scene, rtol, name)]
        seconds, count = median(row["cpu_seconds"] for row in some), some[0]["num_iterations"]
        iterations = f"{'' if some[0]['is_converged'] else '>'}{count}"
        table.add_row(scene, f"{rtol:g}", name, iterations, f"{1e3 * seconds:.3g}", f"{1e6 * seconds / count:.3g}")
    Console(width=120).print(table)
    publish_rows(options.publish, CONFIG, rows, begin)


if __name__ == "__main__":
    main()
