"""What the check for saddles takes of a step's time, and in how many steps a bound makes it unnecessary.

    python -m tests.bench.saddle_check [SCENE:SIZE ...] [--solver lbfgs] [--frames 30] [--rtol 1e-6]

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

SCENES = Path(__file__).parents[2] / "configs" / "scenes"
NAMES = ("hanging-cloth:33", "chain:21", "curtain:24", "flag-in-wind:24", "balloon:12")
ROUNDS = 3


class SearchStarted(Exception):
    """The bound did not suffice."""


def measure_shares(name: str, solver: str, frames: int, stop: StopRule) -> list[str]:
    """The row of a scene: steps, iterations, and the check's share of the time."""
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
    middle, most = np.median(shares[1:]), max(shares[1:])
    return [
        f"{scene} {size}", str(len(shares)), f"{np.median(iterations):.0f}", f"{1e3 * np.median(seconds):.2f}",
        str(bounded), str(saddles), f"{middle:.1%}", f"{most:.1%}",
    ]  # fmt: skip


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
    given = parser.parse_args()
    columns = "scene", "steps", "iterations", "ms", "by the bound", "saddles", "share", "at most"
    table = Table(*columns, box=SIMPLE_HEAD)
    with limit_threads(1):
        for name in given.scenes:
            table.add_row(*measure_shares(name, given.solver, given.frames, StopRule(3000, given.rtol)))
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
