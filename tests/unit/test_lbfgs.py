"""L-BFGS against the two-loop recursion as textbooks have it."""

from __future__ import annotations

from itertools import islice

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.sparse import csr_array
from springbench.solvers.iteration.descent_method import ResidualMetric
from springbench.solvers.methods.local_global.aggregated_jacobi import AggregatedSweeps
from springbench.solvers.methods.quasi_newton.lbfgs import Lbfgs
from springbench.solvers.model.step_problem import Positions, ProjectiveEnergy, StepProblem, StopRule, Unsupported
from springbench.solvers.model.system_matrix_assembly import assemble_system_matrix

from tests.effect_scenes import EFFECT_SCENES as EFFECTS
from tests.scene_builders import build_random_problem

PROBLEMS = {"random": lambda: build_random_problem(4), "larger": lambda: build_random_problem(8, n=30, m=80)}


def free_matrix(problem: StepProblem) -> csr_array:
    """Q of the free vertices."""
    system = problem.system
    Q = assemble_system_matrix(system, [e for e in system.energies if isinstance(e, ProjectiveEnergy)])
    return csr_array(Q[system.free_vertices][:, system.free_vertices])


def two_loops(
    problem: StepProblem, pairs: int, count: int, inverse: NDArray[np.float64] | None = None
) -> list[Positions]:
    """Nocedal and Wright 2006, algorithms 7.4 and 7.5, in NumPy, with steps of full length. inverse: in the place of
    Q^-1, which it is if left out."""
    system = problem.system
    free = system.free_vertices
    inverse = np.linalg.inv(free_matrix(problem).toarray()) if inverse is None else inverse
    p = problem.initial_guess.copy()
    p[system.pins.vertices[system.pins.exact_mask]] = problem.pin_targets[system.pins.exact_mask]
    window: list[tuple[Positions, Positions]] = []
    path = []
    gradient = problem.gradient(p)[free]
    for _ in range(count):
        q, alphas = gradient.copy(), []
        for s, y in reversed(window):
            alphas.append(np.vdot(s, q) / np.vdot(s, y))
            q -= alphas[-1] * y
        direction = inverse @ q
        if window:
            s, y = window[-1]
            direction *= np.vdot(s, y) / np.vdot(y, inverse @ y)
        for (s, y), alpha in zip(window, reversed(alphas), strict=True):
            direction += s * (alpha - np.vdot(y, direction) / np.vdot(s, y))
        p = p.copy()
        p[free] -= direction
        before, gradient = gradient, problem.gradient(p)[free]
        window = [*window, (-direction, gradient - before)][-pairs:]
        path.append(p)
    return path


@pytest.mark.parametrize("name", PROBLEMS)
@pytest.mark.parametrize("pairs", [1, 3, 5])
@pytest.mark.parametrize("linear", ["supernodal", "cholespy"])
def test_iterates_are_those_of_the_two_loop_recursion(name, pairs, linear):
    problem = PROBLEMS[name]()
    expected = two_loops(problem, pairs, 9)
    values = [problem.value(p) for p in expected]
    assert values == sorted(values, reverse=True), "the recursion needs shorter steps here"
    for p, q in zip(islice(Lbfgs(pairs, linear).prepare(problem.system).iterates(problem), 9), expected, strict=True):
        # The same products in another order: round-off by the condition of Q, more in each iteration.
        assert np.abs(p - q).max() <= 1e-8 * np.abs(q).max()


def test_pairs_of_negative_curvature_are_left_out():
    """From one point all springs are compressed, and the Hessian is indefinite for many iterations."""
    problem = build_random_problem(5, n=30, m=120)
    guess = 1e-3 * problem.initial_guess
    path = [p.copy() for p in islice(Lbfgs().prepare(problem.system).iterates(problem), 400)]
    assert problem.value(path[-1]) < problem.value(guess)
    begun = np.abs(problem.gradient(problem.current_positions)).max()
    assert np.abs(problem.gradient(path[-1])).max() <= 1e-7 * begun  # half of the digits, by the condition of Q


@pytest.mark.parametrize("sweeps", [1, 2])
def test_with_a_sparse_matrix_iterates_are_those_of_the_recursion_with_it(sweeps: int) -> None:
    problem = build_random_problem(8, n=30, m=80)
    S = AggregatedSweeps(free_matrix(problem), sweeps).matrix.toarray()
    solver = Lbfgs(3, preconditioner="a-jacobi", jacobi_sweeps=sweeps)
    expected = two_loops(problem, 3, 6, S)
    values = [problem.value(p) for p in expected]
    assert values == sorted(values, reverse=True), "the recursion needs shorter steps here"
    for p, q in zip(islice(solver.prepare(problem.system).iterates(problem), 6), expected, strict=True):
        assert np.abs(p - q).max() <= 1e-8 * np.abs(q).max()  # as above


def test_with_a_sparse_matrix_residuals_are_those_of_q() -> None:
    problem = build_random_problem(4)
    solved = Lbfgs(preconditioner="a-jacobi").prepare(problem.system).solve(problem, StopRule(500, 1e-8))
    assert solved.termination_reason == "converged"
    assert solved.residual == pytest.approx(ResidualMetric(problem.system).residual(problem.gradient(solved.positions)))
    assert solved.residual <= 1e-8 * solved.initial_residual


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"jacobi_sweeps": 9}, "jacobi_sweeps: should be from 1 to 8"),
        ({"linear_solver": "cg"}, "a-jacobi solves no system"),
        ({"precision": "float32"}, "float32 is for `preconditioner: cholesky`; remove it"),
    ],
)
def test_what_has_no_meaning_with_a_sparse_matrix_is_refused(given: dict[str, object], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        Lbfgs(preconditioner="a-jacobi", **given)  # pyright: ignore[reportArgumentType]


def test_with_a_sparse_matrix_contact_is_refused() -> None:
    with pytest.raises(Unsupported, match="does not include contact"):
        Lbfgs(preconditioner="a-jacobi").prepare(EFFECTS["contact"]().system)
