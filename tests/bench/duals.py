"""XPBD compared with MGPBD, where papers measure them: in the dual.

    python -m tests.bench.duals [--setup] [--publish results/published/duals] [PROBLEM ...]

What the tensions of springs are off by, |K^1/2 C - K^-1/2 t|, over what it is where a step begins (MGPBD draws
|C - t/k|, which is the same where all springs are alike): how many iterations it takes to a hundredth, a thousandth, a
millionth, and where XPBD is after 500. Then how far the end is from the step's minimum, over how far the step goes, at
the worst vertex; and the processor time to a hundredth, MGPBD's over XPBD's. --setup: iterations of conjugate gradients
to 1e-6 in the step's first linear system, by what makes the prolongations, and the megabytes that each goes through.

A chain, cloths in their third step, and a cube of springs that was pressed flat and lets go, as the paper's bunny does.
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
MOST, STALL = {"xpbd": 20_000, "mgpbd": 60}, 500
ALONE = "smoothing alone"
SOLVER_VARIANTS = {
    ALONE: MultigridXpbd(near_null_vectors=0),
    "equal tensions": MultigridXpbd(near_null_vectors=0),
    "near-kernel": MultigridXpbd(),
    "equal, smoothed": MultigridXpbd(near_null_vectors=0, smooth_prolongation=True),
    "near-kernel, smoothed": MultigridXpbd(smooth_prolongation=True),
}


class Course(NamedTuple):
    """misfits: after each iteration, over that before the first; seconds: of processor time until each; end: positions
    (n, 3) [m]; linear: iterations of conjugate gradients in each."""

    misfits: list[float]
    seconds: list[float]
    end: np.ndarray
    linear: list[int]

    def until(self, level: float) -> int | None:
        """How many iterations it takes to a level; None where it does not come there."""
        return next((k for k, misfit in enumerate(self.misfits, 1) if misfit <= level), None)


def cloth(path: str, size: int) -> StepProblem:
    """The third step of a cloth from rest."""
    made = build_scene(load_scene(CONFIGS / path), size)
    *_, last = simulate_scene(
        made, prepare(made, HybridNewton()), StopRule(500, 1e-6), initial_guess="previous", frames=3
    )
    return last.problem


def cube(size: int, modulus: float) -> StepProblem:
    """The first step of a cube of a metre and a ton that was pressed flat."""
    made = build_test_scene(
        BlockMesh(height=1.0, depth=1.0), SpringsEffect(stretch=modulus), size=size, mass=1000.0, time_step=0.01
    )
    flat = made.mesh.rest_positions * [1.0, 0.0, 1.0]
    return build_problem(made, MotionState(Motion(flat, np.zeros_like(flat)), None, 0), "previous")


def chain() -> StepProblem:
    """The first step of a chain that is pinned at both ends."""
    pins = PinsEffect.model_validate({"parts": ["ends"], "weight": "exact"})
    return build_first_problem(
        build_test_scene(ChainMesh(length=2.0), SpringsEffect(stretch=1e4), GravityEffect(), pins, size=3000)
    )


PROBLEMS: dict[str, Callable[[], StepProblem]] = {
    "chain, 10,000 N, 3000": chain,
    **{name: lambda path=path, size=size: cloth(path, size) for name, (path, size) in CLOTHS.items()},
    **{name: lambda size=size, modulus=modulus: cube(size, modulus) for name, (size, modulus) in CUBES.items()},
}


class SolveProgress(NamedTuple):
    """misfit [J^(1/2)], positions (n, 3) [m], iterations of conjugate gradients in the last iteration, and what
    processor time all of them took [s]."""

    misfit: float
    positions: np.ndarray
    linear: int = 0
    seconds: float = 0.0


def xpbd(stated: StepProblem) -> Iterator[SolveProgress]:
    """XPBD, before its first iteration and after each."""
    made = Xpbd().prepare(stated.system)
    assert isinstance(made, PreparedXpbd)
    run, own = made.init_state(stated, stated.initial_guess), made.coloured_constraints
    root, (i, j), seconds = np.sqrt(own.stiffness), own.end_vertices.T, 0.0
    while True:
        p = run.positions
        stretched = root * (np.linalg.norm(p[i] - p[j], axis=1) - own.rest_length)
        yield SolveProgress(float(np.linalg.norm(stretched - run.spring_tensions / root)), p, 0, seconds)
        began = time.process_time()
        run.step_state()
        seconds += time.process_time() - began


def mgpbd(stated: StepProblem, solver: MultigridXpbd) -> Iterator[SolveProgress]:
    """MGPBD, likewise; it ends where nothing moves any more."""
    run, moved, seconds = solver.prepare(stated.system).init_state(stated, stated.initial_guess), True, 0.0
    while moved:
        yield SolveProgress(float(np.linalg.norm(run.dual_residual)), run.positions, run.num_cg_iterations, seconds)
        began = time.process_time()
        moved = run.step_state()
        seconds += time.process_time() - began


def course(run: Iterator[SolveProgress], most: int) -> Course:
    """Until the last level is reached, or for so many iterations."""
    begin = next(run)
    found = Course([], [], begin.positions.copy(), [])
    for now in run:
        found.misfits.append(now.misfit / begin.misfit)
        found.seconds.append(now.seconds)
        found.linear.append(now.linear)
        found.end[:] = now.positions
        if now.misfit <= LEVELS[-1] * begin.misfit or len(found.misfits) == most:
            break
    return found


def measure_courses(name: str) -> list[dict[str, Any]]:
    """Measure a problem: a row for each method, with its iterations to LEVELS and its distance from the minimum."""
    stated = PROBLEMS[name]()
    minimum = NewtonSolver().prepare(stated.system).solve(stated, StopRule(2000, 1e-9)).positions
    displacement = float(np.abs(minimum - stated.current_positions).max())
    found = {
        "xpbd": course(xpbd(stated), MOST["xpbd"]),
        "mgpbd": course(mgpbd(stated, MultigridXpbd()), MOST["mgpbd"]),
    }
    springs = len(require_only_springs(stated.system, name).edges)

    def describe(method: str, one: Course) -> dict[str, Any]:
        counts = [one.until(level) for level in LEVELS]
        return {
            "problem": name,
            "springs": springs,
            "method": method,
            **{f"iterations_to_{level:g}".replace("-", "_"): k for level, k in zip(LEVELS, counts, strict=True)},
            "stalled_misfit": one.misfits[STALL - 1] if len(one.misfits) >= STALL else None,
            "end_error": float(np.abs(one.end - minimum).max() / displacement),
            "linear_iterations": float(np.mean(one.linear)),
            "reaches_first_level": counts[0] is not None,
            "cpu_seconds": one.seconds[(counts[0] or len(one.seconds)) - 1],
        }

    return [describe(method, one) for method, one in found.items()]


def format_courses(rows: list[dict[str, Any]]) -> list[str]:
    """Format the line of a problem."""
    plain, multigrid = rows
    counts = [[row[key] for key in row if key.startswith("iterations_to_")] for row in rows]
    texts = [", ".join("-" if k is None else f"{k:,}" for k in some) for some in counts]
    ratio = f"{'' if plain['reaches_first_level'] else '<'}{multigrid['cpu_seconds'] / plain['cpu_seconds']:.2g}"
    return [
        plain["problem"],
        f"{plain['springs']:,}",
        texts[0],
        "-" if plain["stalled_misfit"] is None else f"{plain['stalled_misfit']:.2g}",
        f"{plain['end_error']:.1e}",
        texts[1],
        f"{multigrid['end_error']:.1e}",
        f"{multigrid['linear_iterations']:.0f}",
        ratio if multigrid["reaches_first_level"] else "-",
    ]


def setups(name: str) -> list[str]:
    """The row of a problem: iterations of conjugate gradients, and the megabytes of each."""
    stated = PROBLEMS[name]()
    row = [name]
    for label, solver in SOLVER_VARIANTS.items():
        made = solver.prepare(stated.system)
        run = made.init_state(stated, stated.initial_guess)
        A = made.dual_matrix(made.scaled_constraints(run.positions)[1])
        prolongation = made.build_prolongation(A)
        if label == ALONE:
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
                table.add_row(*setups(name))
            else:
                found = measure_courses(name)
                table.add_row(*format_courses(found))
                rows += found
    Console(width=150).print(table)
    if rows:
        config = CONFIGS / CLOTHS["cloth, 100,000 N/m, 32"][0]
        publish_rows(given.publish, config, "python -m tests.bench.duals", rows, begin)


if __name__ == "__main__":
    main()
