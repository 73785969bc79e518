"""Define gates on the prefactored solve with three right-hand sides, and on steps by linear solver."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.sparse import csr_array
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.simulation.time_loop import build_initial_state, build_problem
from springbench.solvers.linalg.cholesky.supernodal_cholesky import SupernodalCholesky
from springbench.solvers.linalg.direct_solvers import LinearSolver, SimplicialCholesky, SparseLU
from springbench.solvers.linalg.solver_selection import LinearSolverName
from springbench.solvers.methods.local_global.compiled_local_global import CompiledLocalGlobal
from springbench.solvers.model import system_matrix_assembly
from springbench.solvers.model.step_problem import Positions

from tests.bench.gates import STOP, Gate, Work, build_sheet

GUARDS = ("test_a_supernodal_factor_is_as_large_as_stored",)


def build_system_matrix(scene: Scene) -> csr_array:
    """Build the system matrix Q of a scene of springs."""
    return system_matrix_assembly.assemble_system_matrix(scene.system, [scene.all_springs])


def build_solves(factorise: Callable[[csr_array], LinearSolver], size: int, repeats: int) -> Work:
    """Build work that solves systems of the sheet's Q with a solution of entries up to 1, and returns that (n, 3)."""
    scene = build_sheet(size)
    Q = build_system_matrix(scene)
    factor = factorise(Q)
    b = np.ascontiguousarray(Q @ np.random.default_rng(size).uniform(-1.0, 1.0, (scene.system.num_vertices, 3)))
    out = np.empty_like(b)

    def work() -> Positions:
        for _ in range(repeats):
            factor.solve(b, out)
        return out

    return work


def build_steps(linear: LinearSolverName, size: int, repeats: int) -> Work:
    """Build work that solves the first step of the sheet repeatedly by local-global with a linear solver.

    It returns the positions (n, 3) [m].
    """
    scene = build_sheet(size)
    prepared = CompiledLocalGlobal(linear_solver=linear).prepare(scene.system)
    problem = build_problem(scene, build_initial_state(scene), "previous")
    return lambda: [prepared.solve(problem, STOP) for _ in range(repeats)][-1].positions


def _build_solve_gate(
    baseline: str, factorise: Callable[[csr_array], LinearSolver], size: int, limit: float, why: str
) -> Gate:
    repeats = max(4, 50 * 64**2 // size**2)
    return Gate(
        name=f"supernodal-solve-against-{baseline}-{size}",
        candidate=lambda: build_solves(SupernodalCholesky, size, repeats),
        baseline=lambda: build_solves(factorise, size, repeats),
        tolerance=1e-9,  # two factorisations of a matrix with pin weights of 1e10 and stiffnesses of 1e3
        limit=limit,
        guards=GUARDS,
        short=size == 64,
        why=why,
    )


def _build_step_gate(size: int) -> Gate:
    return Gate(
        name=f"supernodal-step-against-cholespy-{size}",
        candidate=lambda: build_steps("supernodal", size, max(1, 64**2 // size**2)),
        baseline=lambda: build_steps("cholespy", size, max(1, 64**2 // size**2)),
        tolerance=1e-9,  # relative to positions of 1 m
        limit=0.8,
        guards=GUARDS,
        why="measured 0.39 to 0.46 with vectors of 512 bits, half as much again without; the rest is a margin",
    )


_CHOLESPY = "faster on every machine; measured 0.36 to 0.44 with vectors of 512 bits here, and 0.64 on a Xeon"
_SUPERLU = "twice as fast on every machine; measured 0.11 to 0.15 with vectors of 512 bits here, and 0.26 on a Xeon"

SOLVES = (
    *(_build_solve_gate("cholespy", SimplicialCholesky, size, 0.9, _CHOLESPY) for size in (32, 64, 128)),
    *(_build_solve_gate("splu", SparseLU, size, 0.5, _SUPERLU) for size in (32, 64, 128)),
    *(_build_step_gate(size) for size in (32, 64, 128)),
)
