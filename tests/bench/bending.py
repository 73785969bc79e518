"""Measure the parts of the overhead of bending for Newton's method: fill, factorisations and iterations.

    python -m tests.bench.bending [--sizes 33 64] [--frames 8] [--publish results/published/bending]

The hanging cloth is simulated with bending and without, to a relative residual of 1e-6, on one thread. The two
simulations alternate step by step. A column is a ratio, with bending over without, or the counts of both.

    iteration        processor time of an iteration
    entries, flops   entries of the factor of the Hessian, and floating-point operations of the factorisation
    factor           processor time of one factorisation, at the last step
    factorisations   factorisations per iteration: an indefinite Hessian is factorised again with a shift
    iterations       iterations per step, which differ since the motions differ
"""

from __future__ import annotations

import argparse
from pathlib import Path
from time import thread_time
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from springbench.harness.config.config_loader import load_scene
from springbench.harness.execution.machine_info import limit_threads
from springbench.harness.experiments.ablation.iteration_overhead import NUM_WARMUP_STEPS, prepare_scene
from springbench.harness.simulation.time_loop import simulate_scene
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.step_problem import StopRule

from tests.bench.scripted_study import describe_provenance, publish_rows

PRICES = Path(__file__).parents[2] / "configs" / "prices.yaml"
STOP, NUM_REPEATS = StopRule(5000, 1e-6), 7


class MeasuredRun:
    """A simulation that counts its iterations, its factorisations and its processor time [s]."""

    def __init__(self, size: int, frames: int, *effects: str) -> None:
        scene, prepared = prepare_scene(load_scene(PRICES), size, NewtonSolver(), *effects)
        self._prepared: Any = prepared
        self.factor = self._prepared.fixed_objective.hessian_matrix.factor
        self._steps = iter(simulate_scene(scene, prepared, STOP, initial_guess="previous", frames=frames))
        self.seconds, self.num_iterations, self.num_factorisations = 0.0, 0, 0
        self._problem: Any = None

    def run_step(self, *, is_counted: bool) -> None:
        """Compute the next step; include it in the counts if `is_counted`."""
        before, began = self.factor.num_factorisations, thread_time()
        step = next(self._steps)
        seconds, self._problem = thread_time() - began, step.problem
        if is_counted:
            self.seconds += seconds
            self.num_iterations += step.num_iterations
            self.num_factorisations += self.factor.num_factorisations - before

    def measure_factorisation(self) -> float:
        """Measure the least processor time [s] of a factorisation at the last step."""
        factorise, times = self._prepared.iteration_phases(self._problem)["factor"], list[float]()
        for _ in range(NUM_REPEATS):
            began = thread_time()
            factorise()
            times.append(thread_time() - began)
        return min(times)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=[33, 64])
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--publish", type=Path, help="folder of a published study")
    options = parser.parse_args()
    begin, rows = describe_provenance(), list[dict[str, Any]]()
    table = Table("a side", "iteration", "entries", "flops", "factor", "factorisations", "iterations", box=SIMPLE_HEAD)
    table.title = "bending over no bending, newton"
    with limit_threads(1):
        for size in options.sizes:
            runs = [MeasuredRun(size, NUM_WARMUP_STEPS + options.frames, *effects) for effects in (("bending",), ())]
            for k in range(NUM_WARMUP_STEPS + options.frames):
                for run in runs[:: 1 if k % 2 else -1]:
                    run.run_step(is_counted=k >= NUM_WARMUP_STEPS)
            bending, plain = runs
            iteration = bending.seconds / bending.num_iterations * plain.num_iterations / plain.seconds
            ratios = {
                "iteration_time_ratio": iteration,
                "entries_ratio": bending.factor.nonzeros / plain.factor.nonzeros,
                "flops_ratio": bending.factor.flops / plain.factor.flops,
                "factor_time_ratio": bending.measure_factorisation() / plain.measure_factorisation(),
            }
            per_iteration = [run.num_factorisations / run.num_iterations for run in runs]
            rows.append({"size": size, **ratios, "factorisation_ratio": per_iteration[0] / per_iteration[1]})
            each = [f"{count:.2f}" for count in per_iteration]
            steps = [f"{run.num_iterations / options.frames:.1f}" for run in runs]
            table.add_row(str(size), *(f"{x:.2f}" for x in ratios.values()), " and ".join(each), " and ".join(steps))
    Console(width=120).print(table)
    publish_rows(options.publish, PRICES, rows, begin)


if __name__ == "__main__":
    main()
