"""Measure the share of the saddle check in the time of a step, and the steps in which a bound replaces its search.

    python -m tests.bench.saddle_check [SCENE:SIZE ...] [--solver lbfgs] [--frames 30] [--rtol 1e-6]
        [--publish results/published/saddle-check]

After each step of a simulation, a solve of the step and a saddle check of its solution are timed three times each,
interleaved; the least processor times are compared. The share is the time of the check over that of the solve, which
contains a check, without the first step. The column `by the bound` counts the steps in which a bound of the
smallest eigenvalue excludes a saddle, so that no search for negative curvature starts.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from time import thread_time
from typing import Any
from unittest.mock import patch

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from springbench.harness.config.config_loader import load_scene
from springbench.harness.execution.machine_info import limit_threads
from springbench.harness.scenes.scene_builder import build_scene
from springbench.harness.simulation.time_loop import SimulationStep, prepare, simulate_scene
from springbench.solvers.iteration.saddle_check import SaddleCheck
from springbench.solvers.kernels.curvature_search import CurvatureScratch
from springbench.solvers.model.step_problem import StopRule
from springbench.solvers.objective.fixed_objective import FixedObjective
from springbench.solvers.registry import SOLVERS, load_target

from tests.bench.scripted_study import describe_provenance, publish_rows

SCENES = Path(__file__).parents[2] / "configs" / "scenes"
NAMES = ("hanging-cloth:33", "chain:21", "curtain:24", "flag-in-wind:24", "balloon:12")
ROUNDS = 3


class SearchStarted(Exception):
    """Signals that the check starts a search, as the bound is not sufficient."""


def measure_shares(name: str, solver: str, frames: int, stop: StopRule) -> dict[str, Any]:
    """Measure a scene `NAME:SIZE`: a row with its steps, iterations, and shares of the check."""
    scene, _, size = name.partition(":")
    spec = load_scene(SCENES / f"{scene}.yaml")
    made = build_scene(spec, int(size or spec.default_size or 0))
    prepared, check = prepare(made, load_target(SOLVERS[solver])()), SaddleCheck(FixedObjective(made.system))
    shares, iterations, seconds, bounded, saddles = [], [], [], 0, 0

    def measure_step(step: SimulationStep) -> tuple[float, float]:
        """Return the least processor times [s] of the solve and of the check."""
        solve = partial(prepared.solve, step.problem, stop)
        search = partial(check.find_lower_point, step.problem, step.solution.positions, step.num_iterations)
        times = [(_measure_seconds(solve), _measure_seconds(search)) for _ in range(ROUNDS)]
        return min(whole for whole, _ in times), min(part for _, part in times)

    for step in simulate_scene(made, prepared, stop, initial_guess="previous", frames=frames):
        whole, part = measure_step(step)
        shares.append(part / whole)
        seconds.append(whole)
        iterations.append(step.num_iterations)
        saddles += step.solution.termination_reason == "saddle"
        with patch.object(CurvatureScratch, "from_size", side_effect=SearchStarted), suppress(SearchStarted):
            SaddleCheck(FixedObjective(made.system)).find_lower_point(
                step.problem, step.solution.positions, step.num_iterations
            )
            bounded += 1
    return {
        "scene": f"{scene} {size}", "solver": solver, "num_steps": len(shares),
        "num_iterations": float(np.median(iterations)), "milliseconds": 1e3 * float(np.median(seconds)),
        "num_bounded_steps": bounded, "num_saddles": saddles,
        "share": float(np.median(shares[1:])), "max_share": max(shares[1:]),
    }  # fmt: skip


def _measure_seconds(call: Callable[[], object]) -> float:
    start = thread_time()
    call()
    return thread_time() - start


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("scenes", nargs="*", default=NAMES, metavar="SCENE:SIZE")
    parser.add_argument("--solver", default="lbfgs")
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--rtol", type=float, default=1e-6)
    parser.add_argument("--publish", type=Path, help="folder of a published study")
    given = parser.parse_args()
    begin, rows = describe_provenance(), list[dict[str, Any]]()
    columns = "scene", "steps", "iterations", "ms", "by the bound", "saddles", "share", "at most"
    table = Table(*columns, box=SIMPLE_HEAD)
    with limit_threads(1):
        for name in given.scenes:
            rows.append(found := measure_shares(name, given.solver, given.frames, StopRule(3000, given.rtol)))
            table.add_row(
                found["scene"], f"{found['num_steps']}", f"{found['num_iterations']:.0f}",
                f"{found['milliseconds']:.2f}", f"{found['num_bounded_steps']}", f"{found['num_saddles']}",
                f"{found['share']:.1%}", f"{found['max_share']:.1%}",
            )  # fmt: skip
    Console(width=120).print(table)
    publish_rows(given.publish, SCENES / "hanging-cloth.yaml", rows, begin)


if __name__ == "__main__":
    main()
