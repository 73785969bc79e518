"""Measure the convergence of XPBD and MGPBD by the dual residual of spring tensions.

    python -m tests.bench.duals [--setup] [--publish results/published/duals] [PROBLEM ...]

The dual residual is |K^1/2 C - K^-1/2 t|, where K has the stiffnesses, C the elongations and t the tensions of springs.
It is relative to that at the start of the step. The MGPBD paper plots |C - t/k|, which is the same if all stiffnesses
are equal. The table has the number of iterations to residuals of 1e-2, 1e-3 and 1e-6, and the residual of XPBD after
500 iterations. The error is the largest distance of a coordinate from the step's minimum, over the step's largest
displacement. The last column is the processor time of MGPBD to a residual of 1e-2 over that of XPBD.

With `--setup` the table has two numbers for each way to build the prolongation: the iterations of conjugate gradients
to a residual of 1e-6 in the first linear system of the step, and the megabytes that each of them reads.

The problems are a chain in its first step, cloths in their third step, and a cube of springs that is released from a
flat state, like the bunny of the paper.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from springbench.harness.config.config_loader import load_scene
from springbench.harness.execution.machine_info import limit_threads
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect as PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect as SpringsEffect
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.scenes.mesh.solid_meshes import BlockMesh
from springbench.harness.scenes.scene_builder import build_scene
from springbench.harness.simulation.time_loop import MotionState, build_problem, prepare, simulate_scene
from springbench.solvers.linalg.multigrid.near_nullspace import PreconditionedSolve, VCycle
from springbench.solvers.methods.local_global.prefactored import require_only_springs
from springbench.solvers.methods.newton.hybrid_newton import HybridNewton
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.methods.position_based.mgpbd import MultigridXpbd
from springbench.solvers.methods.position_based.xpbd import PreparedXpbd, Xpbd
from springbench.solvers.model.integrators import Motion
from springbench.solvers.model.step_problem import StepProblem, StopRule

from tests.bench.scripted_study import describe_provenance, publish_rows
from tests.scene_builders import build_first_problem, build_test_scene

CONFIGS = Path(__file__).parents[2] / "configs"
CLOTHS = {
    "cloth, 100 N/m, 24": ("hessians/cloth-100-pressed-0.yaml", 24),
    "cloth, 10,000 N/m, 24": ("hessians/cloth-1e4-pressed-0.yaml", 24),
    "cloth, 10,000 N/m, 64": ("hessians/cloth-1e4-pressed-0.yaml", 64),
    "cloth, 100,000 N/m, 32": ("scenes/yardstick-cloth.yaml", 32),
    "cloth, 100,000 N/m, 64": ("scenes/yardstick-cloth.yaml", 64),
}
CUBES = {"cube, 1 MPa, 11": (11, 1e6), "cube, 100 MPa, 11": (11, 1e8), "cube, 100 MPa, 16": (16, 1e8)}
LEVELS = (1e-2, 1e-3, 1e-6)
MAX_ITERATIONS, STALL = {"xpbd": 20_000, "mgpbd": 60}, 500
"""Iteration limits, and the iteration at which the residual of XPBD is stated."""
SMOOTHING_ALONE = "smoothing alone"
SOLVER_VARIANTS = {
    SMOOTHING_ALONE: MultigridXpbd(near_null_vectors=0),
    "equal tensions": MultigridXpbd(near_null_vectors=0),
    "near-kernel": MultigridXpbd(),
    "equal, smoothed": MultigridXpbd(near_null_vectors=0, smooth_prolongation=True),
    "near-kernel, smoothed": MultigridXpbd(smooth_prolongation=True),
}


class ConvergenceHistory(NamedTuple):
    """History of a solve, by iteration.

    residuals: dual residual after each iteration over the initial one; seconds: processor time up to each [s]; end:
    last positions (n, 3) [m]; linear_iterations: iterations of conjugate gradients in each.
    """

    residuals: list[float]
    seconds: list[float]
    end: np.ndarray
    linear_iterations: list[int]

    def count_iterations(self, level: float) -> int | None:
        """Count the iterations to a relative residual; return None if it is not reached."""
        return next((k for k, residual in enumerate(self.residuals, 1) if residual <= level), None)


def build_cloth_problem(path: str, size: int) -> StepProblem:
    """Build the problem of the third step of a cloth from rest."""
    made = build_scene(load_scene(CONFIGS / path), size)
    *_, last = simulate_scene(
        made, prepare(made, HybridNewton()), StopRule(500, 1e-6), initial_guess="previous", frames=3
    )
    return last.problem


def build_cube_problem(size: int, modulus: float) -> StepProblem:
    """Build the problem of the first step of a cube of 1 m and 1000 kg that is released from a flat state."""
    made = build_test_scene(
        BlockMesh(height=1.0, depth=1.0), SpringsEffect(stretch=modulus), size=size, mass=1000.0, time_step=0.01
    )
    flat = made.mesh.rest_positions * [1.0, 0.0, 1.0]
    return build_problem(made, MotionState(Motion(flat, np.zeros_like(flat)), None, 0), "previous")


def build_chain_problem() -> StepProblem:
    """Build the problem of the first step of a chain that is pinned at both ends."""
    pins = PinsEffect.model_validate({"parts": ["ends"], "weight": "exact"})
    return build_first_problem(
        build_test_scene(ChainMesh(length=2.0), SpringsEffect(stretch=1e4), GravityEffect(), pins, size=3000)
    )


PROBLEMS: dict[str, Callable[[], StepProblem]] = {
    "chain, 10,000 N, 3000": build_chain_problem,
    **{name: lambda path=path, size=size: build_cloth_problem(path, size) for name, (path, size) in CLOTHS.items()},
    **{
        name: lambda size=size, modulus=modulus: build_cube_problem(size, modulus)
        for name, (size, modulus) in CUBES.items()
    },
}


class SolveProgress(NamedTuple):
    """State of a solve after an iteration.

    residual: dual residual [J^(1/2)]; positions (n, 3) [m]; linear_iterations: iterations of conjugate gradients in
    the last iteration; seconds: processor time of all iterations [s].
    """

    residual: float
    positions: np.ndarray
    linear_iterations: int = 0
    seconds: float = 0.0


def iterate_xpbd(problem: StepProblem) -> Iterator[SolveProgress]:
    """Yield the state of XPBD before its first iteration and after each."""
    prepared = Xpbd().prepare(problem.system)
    assert isinstance(prepared, PreparedXpbd)
    run, constraints = prepared.init_state(problem, problem.initial_guess), prepared.coloured_constraints
    root, (i, j), seconds = np.sqrt(constraints.stiffness), constraints.end_vertices.T, 0.0
    while True:
        p = run.positions
        scaled = root * (np.linalg.norm(p[i] - p[j], axis=1) - constraints.rest_length)
        yield SolveProgress(float(np.linalg.norm(scaled - run.spring_tensions / root)), p, 0, seconds)
        began = time.process_time()
        run.step_state()
        seconds += time.process_time() - began


def iterate_mgpbd(problem: StepProblem, solver: MultigridXpbd) -> Iterator[SolveProgress]:
    """Yield the state of MGPBD before its first iteration and after each, until an iteration moves no vertex."""
    run, is_moving, seconds = solver.prepare(problem.system).init_state(problem, problem.initial_guess), True, 0.0
    while is_moving:
        yield SolveProgress(float(np.linalg.norm(run.dual_residual)), run.positions, run.num_cg_iterations, seconds)
        began = time.process_time()
        is_moving = run.step_state()
        seconds += time.process_time() - began


def record_history(run: Iterator[SolveProgress], max_iterations: int) -> ConvergenceHistory:
    """Record the history of a solve until it reaches the smallest of LEVELS, or the iteration limit."""
    begin = next(run)
    found = ConvergenceHistory([], [], begin.positions.copy(), [])
    for now in run:
        found.residuals.append(now.residual / begin.residual)
        found.seconds.append(now.seconds)
        found.linear_iterations.append(now.linear_iterations)
        found.end[:] = now.positions
        if now.residual <= LEVELS[-1] * begin.residual or len(found.residuals) == max_iterations:
            break
    return found


def measure_convergence(name: str) -> list[dict[str, Any]]:
    """Measure a problem: a row for each method, with its iterations to LEVELS and its error relative to the minimum."""
    problem = PROBLEMS[name]()
    minimum = NewtonSolver().prepare(problem.system).solve(problem, StopRule(2000, 1e-9)).positions
    displacement = float(np.abs(minimum - problem.current_positions).max())
    found = {
        "xpbd": record_history(iterate_xpbd(problem), MAX_ITERATIONS["xpbd"]),
        "mgpbd": record_history(iterate_mgpbd(problem, MultigridXpbd()), MAX_ITERATIONS["mgpbd"]),
    }
    springs = len(require_only_springs(problem.system, name).edges)

    def describe(method: str, one: ConvergenceHistory) -> dict[str, Any]:
        counts = [one.count_iterations(level) for level in LEVELS]
        return {
            "problem": name,
            "springs": springs,
            "method": method,
            **{f"iterations_to_{level:g}".replace("-", "_"): k for level, k in zip(LEVELS, counts, strict=True)},
            "stalled_misfit": one.residuals[STALL - 1] if len(one.residuals) >= STALL else None,
            "end_error": float(np.abs(one.end - minimum).max() / displacement),
            "linear_iterations": float(np.mean(one.linear_iterations)),
            "reaches_first_level": counts[0] is not None,
            "cpu_seconds": one.seconds[(counts[0] or len(one.seconds)) - 1],
        }

    return [describe(method, one) for method, one in found.items()]


def format_convergence(rows: list[dict[str, Any]]) -> list[str]:
    """Format the table row of a problem; < denotes that XPBD does not reach the first level."""
    xpbd, mgpbd = rows
    counts = [[row[key] for key in row if key.startswith("iterations_to_")] for row in rows]
    texts = [", ".join("-" if k is None else f"{k:,}" for k in some) for some in counts]
    ratio = f"{'' if xpbd['reaches_first_level'] else '<'}{mgpbd['cpu_seconds'] / xpbd['cpu_seconds']:.2g}"
    return [
        xpbd["problem"],
        f"{xpbd['springs']:,}",
        texts[0],
        "-" if xpbd["stalled_misfit"] is None else f"{xpbd['stalled_misfit']:.2g}",
        f"{xpbd['end_error']:.1e}",
        texts[1],
        f"{mgpbd['end_error']:.1e}",
        f"{mgpbd['linear_iterations']:.0f}",
        ratio if mgpbd["reaches_first_level"] else "-",
    ]


def measure_setups(name: str) -> list[str]:
    """Return the table row of a problem: the iterations of conjugate gradients by setup, and the megabytes of each."""
    problem = PROBLEMS[name]()
    row = [name]
    for label, solver in SOLVER_VARIANTS.items():
        prepared = solver.prepare(problem.system)
        run = prepared.init_state(problem, problem.initial_guess)
        A = prepared.dual_matrix(prepared.scaled_constraints(run.positions)[1])
        prolongation = prepared.build_prolongation(A)
        if label == SMOOTHING_ALONE:
            prolongation.prolongators.clear()
        cycle = VCycle(A, prolongation)
        count = PreconditionedSolve(A, cycle, run.dual_residual, 1e-6).solve(2000)
        row.append(f"{count:,}, {1e-6 * (cycle.matrix_bytes + 12 * A.nnz):.1f}")
    return row


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--setup", action="store_true")
    parser.add_argument("names", nargs="*", default=list(PROBLEMS), metavar="PROBLEM")
    parser.add_argument("--publish", type=Path, help="folder of a published study")
    given = parser.parse_args()
    by = "to 1e-2, 1e-3, 1e-6"
    columns = (
        *("step", "springs", f"xpbd {by}", f"after {STALL}", "its error", f"mgpbd {by}", "its error"),
        *("linear iterations", "time, over xpbd's"),
    )
    table = Table(*(("step", *SOLVER_VARIANTS) if given.setup else columns), box=SIMPLE_HEAD)
    begin, rows = describe_provenance(), list[dict[str, Any]]()
    with limit_threads(1):
        for name in given.names:
            if given.setup:
                table.add_row(*measure_setups(name))
            else:
                found = measure_convergence(name)
                table.add_row(*format_convergence(found))
                rows += found
    Console(width=150).print(table)
    if rows:
        config = CONFIGS / CLOTHS["cloth, 100,000 N/m, 32"][0]
        publish_rows(given.publish, config, rows, begin)


if __name__ == "__main__":
    main()
