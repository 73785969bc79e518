"""Dense, sparse and compiled do the same iterations: to the last few digits, whatever the scene and the threads."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice
from pathlib import Path

import numba
import numpy as np
import pytest
from springbench.harness.config.config_loader import convert_assignment_scene
from springbench.harness.scenes.scene_builder import Scene, build_scene
from springbench.harness.simulation.time_loop import INITIAL_GUESSES
from springbench.solvers.linalg.solver_selection import LinearSolverName
from springbench.solvers.methods.local_global.compiled_local_global import CompiledLocalGlobal
from springbench.solvers.methods.local_global.prefactored import require_only_springs
from springbench.solvers.methods.local_global.reference_local_global import DenseLocalGlobal
from springbench.solvers.model.step_problem import Positions, Solver

from tests.scene_builders import (
    LOCAL_GLOBAL_BACKENDS,
    SCENE_BUILDERS,
    THREAD_COUNT,
    build_first_problem,
    build_random_problem,
    simulate_trajectory,
)

LINEAR_SOLVERS: tuple[LinearSolverName, ...] = ("inverse", "cholespy", "supernodal", "cg")
BACKENDS: tuple[Solver, ...] = (*LOCAL_GLOBAL_BACKENDS, *(CompiledLocalGlobal(linear) for linear in LINEAR_SOLVERS))
"""The backends, and the compiled one with every linear solver that it could choose."""

AGREEMENT = 1e-10
"""Of the scene's size. One step leaves 1e-15 to 2e-14, by the condition of Q; motion amplifies it, a hundred steps of
the cloth and of the net to 1e-12, the assignment's flag, whose springs are stiff, to 1e-10 in thirty."""

SMALL = ("single-spring", "chain", "net", "cloth")
SLOW = pytest.param("stiff-cloth", marks=pytest.mark.long)
"""4096 vertices, of which the dense backend takes an inverse."""
LARGE = (SLOW, "tower", "block", "skirt")
WEIGHTS = {"penalty": 1e10, "exact": "exact"}

ASSIGNMENT = Path(__file__).resolve().parents[3] / "shared" / "scenes"

small = pytest.mark.parametrize("name", SMALL)
pins = pytest.mark.parametrize("weight", WEIGHTS.values(), ids=list(WEIGHTS))
first_guesses = pytest.mark.parametrize("first_guess", INITIAL_GUESSES)


def compute_spread(found: list[Positions]) -> float:
    """The largest difference of a coordinate between any two."""
    return float(np.ptp(found, axis=0).max())


def after_iterations(backend: Solver, problem, count: int) -> Positions:
    *_, p = islice(backend.prepare(problem.system).iterates(problem), count)
    return p


@pytest.mark.parametrize("steps", [25, pytest.param(100, marks=pytest.mark.long)])
@small
@pins
def test_backends_agree_after_many_steps(name, weight, steps):
    made = SCENE_BUILDERS[name](weight)
    assert (
        compute_spread([simulate_trajectory(made, backend, steps) for backend in BACKENDS])
        <= AGREEMENT * made.mesh.bounding_box_diagonal
    )


@pins
@first_guesses
def test_backends_agree_from_every_first_guess(weight, first_guess):
    made = SCENE_BUILDERS["cloth"](weight)
    found = [simulate_trajectory(made, backend, 20, initial_guess=first_guess) for backend in BACKENDS]
    assert compute_spread(found) <= AGREEMENT * made.mesh.bounding_box_diagonal


@pytest.mark.parametrize("name", LARGE)
@pins
def test_backends_agree_on_a_step_of_a_large_scene(name, weight):
    made = SCENE_BUILDERS[name](weight)
    problem = build_first_problem(made)
    assert (
        compute_spread([after_iterations(backend, problem, 15) for backend in BACKENDS])
        <= AGREEMENT * made.mesh.bounding_box_diagonal
    )


@pytest.mark.parametrize("name", [SLOW if name == "stiff-cloth" else name for name in SCENE_BUILDERS])
def test_backends_agree_from_random_positions(name):
    made = SCENE_BUILDERS[name](1e10)
    problem = build_first_problem(made)
    rng = np.random.default_rng(0)
    guess = problem.current_positions + 0.3 * made.mesh.bounding_box_diagonal * rng.normal(
        size=problem.current_positions.shape
    )
    problem = replace(problem, initial_guess=guess)
    assert (
        compute_spread([after_iterations(backend, problem, 10) for backend in BACKENDS])
        <= AGREEMENT * made.mesh.bounding_box_diagonal
    )


@pytest.mark.parametrize("seed", range(8))
def test_backends_agree_on_random_networks(seed):
    problem = build_random_problem(seed)
    assert compute_spread([after_iterations(backend, problem, 30) for backend in BACKENDS]) <= AGREEMENT


@pytest.mark.skipif(not ASSIGNMENT.is_dir(), reason="the assignment's scenes are not beside the repository")
@pytest.mark.parametrize("name", ["single-spring-horizontal", "horizontal-chain", "net"])
def test_backends_agree_on_the_small_scenes_of_the_assignment(name):
    made = assignment_scene(name)
    found = [simulate_trajectory(made, backend, 100, initial_guess="assignment") for backend in BACKENDS]
    assert compute_spread(found) <= AGREEMENT * made.mesh.bounding_box_diagonal


@pytest.mark.skipif(not ASSIGNMENT.is_dir(), reason="the assignment's scenes are not beside the repository")
@pytest.mark.long
def test_all_but_the_dense_backend_agree_on_the_assignments_flag():
    made = assignment_scene("flag")
    found = [simulate_trajectory(made, backend, 12, initial_guess="assignment") for backend in BACKENDS[1:]]
    assert compute_spread(found) <= AGREEMENT * made.mesh.bounding_box_diagonal


def assignment_scene(name: str) -> Scene:
    return build_scene(convert_assignment_scene(ASSIGNMENT / f"{name}.json"), 0)


@pytest.mark.skipif(THREAD_COUNT < 2, reason="Numba was started with one thread")
@pytest.mark.parametrize("name", ["chain", "stiff-cloth", "block", "skirt"])
def test_the_compiled_backend_gives_the_same_bits_with_any_number_of_threads(name):
    problem = build_first_problem(SCENE_BUILDERS[name](1e10))
    before, found = numba.get_num_threads(), []
    try:
        for threads in (1, 2):
            numba.set_num_threads(threads)
            found.append(after_iterations(CompiledLocalGlobal(), problem, 10).copy())
    finally:
        numba.set_num_threads(before)
    np.testing.assert_array_equal(found[0], found[1])


def test_the_dense_backend_is_the_formulas_of_the_paper():
    """One iteration, written out with the matrices' names."""
    problem = build_random_problem(3, weights=(1e4,))
    s = problem.system
    springs = require_only_springs(s, "the test")
    n, m = s.num_vertices, len(springs.edges)
    A, C, K = np.zeros((m, n)), np.zeros((1, n)), np.diag(springs.stiffness)
    for e, (i, j) in enumerate(springs.edges):
        A[e, i] += 1.0
        A[e, j] -= 1.0
    C[0, 0] = 1.0
    M, dt, w, r = np.diag(s.mass), s.time_step, 1e4, springs.rest_length
    v = A @ problem.initial_guess
    length = np.linalg.norm(v, axis=1)
    d = (r / np.where(length, length, 1.0))[:, None] * v
    Q = A.T @ K @ A + M / dt**2 + w * C.T @ C
    y = M @ problem.inertial_target / dt**2 + problem.external_force + w * C.T @ problem.pin_targets
    expected = np.linalg.solve(Q, A.T @ K @ d + y)
    np.testing.assert_allclose(after_iterations(DenseLocalGlobal(), problem, 1), expected, rtol=0, atol=AGREEMENT)
