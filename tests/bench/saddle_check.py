"""What the check for saddles takes of a step's time, and in how many steps a bound makes it unnecessary.

    python -m tests.bench.saddle_check [SCENE:SIZE ...] [--solver lbfgs] [--frames 30] [--rtol 1e-6]
        [--publish results/published/saddle-check]

Each step is solved and its end point checked, one after the other, three times; the least processor time of each
counts. The share is that of the check in the solve, which contains it.
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
    """The bound did not suffice."""


def measure_shares(name: str, solver: str, frames: int, stop: StopRule) -> dict[str, Any]:
    """Measure a scene: its steps, iterations, and the check's share of the time without the first step."""
    scene, _, size = name.partition(":")
    spec = load_scene(SCENES / f"{scene}.yaml")
    made = build_scene(spec, int(size or spec.default_size or 0))
    prepared, check = prepare(made, load_target(SOLVERS[solver])()), SaddleCheck(FixedObjective(made.system))
    shares, iterations, seconds, bounded, saddles = [], [], [], 0, 0

    def measure(step: SimulationStep) -> tuple[float, float]:
        solve = partial(prepared.solve, step.problem, stop)
        search = partial(check.find_lower_point, step.problem, step.solution.positions, step.num_iterations)
        took = [(_seconds(solve), _seconds(search)) for _ in range(ROUNDS)]
        return min(whole for whole, _ in took), min(part for _, part in took)

    for step in simulate_scene(made, prepared, stop, initial_guess="previous", frames=frames):
        whole, part = measure(step)
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


def _seconds(call: Callable[[], object]) -> float:
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
    publish_rows(given.publish, SCENES / "hanging-cloth.yaml", "python -m tests.bench.saddle_check", rows, begin)


if __name__ == "__main__":
    main()
