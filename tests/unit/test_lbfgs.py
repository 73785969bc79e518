"""L-BFGS against the two-loop recursion as textbooks have it."""

from __future__ import annotations

from itertools import islice

import numpy as np
import pytest

from solvers.matrices import assemble
from solvers.methods.lbfgs import Lbfgs
from solvers.problem import Positions, ProjectiveEnergy, StepProblem
from tests.scenes import random_problem

PROBLEMS = {"random": lambda: random_problem(4), "larger": lambda: random_problem(8, n=30, m=80)}


def two_loops(problem: StepProblem, pairs: int, count: int) -> list[Positions]:
    """Nocedal and Wright 2006, algorithms 7.4 and 7.5, in NumPy, with steps of full length."""
    system = problem.system
    free = system.free
    Q = assemble(system, [e for e in system.energies if isinstance(e, ProjectiveEnergy)]).toarray()[np.ix_(free, free)]
    p = problem.first_guess.copy()
    p[system.pins.vertices[system.pins.exact]] = problem.pin_targets[system.pins.exact]
    window: list[tuple[Positions, Positions]] = []
    path = []
    gradient = problem.gradient(p)[free]
    for _ in range(count):
        q, alphas = gradient.copy(), []
        for s, y in reversed(window):
            alphas.append(np.vdot(s, q) / np.vdot(s, y))
            q -= alphas[-1] * y
        direction = np.linalg.solve(Q, q)
        if window:
            s, y = window[-1]
            direction *= np.vdot(s, y) / np.vdot(y, np.linalg.solve(Q, y))
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
    wanted = two_loops(problem, pairs, 9)
    values = [problem.value(p) for p in wanted]
    assert values == sorted(values, reverse=True), "the recursion needs shorter steps here"
    for p, q in zip(islice(Lbfgs(pairs, linear).prepare(problem.system).iterates(problem), 9), wanted, strict=True):
        # The same products in another order: round-off by the condition of Q, more in each iteration.
        assert np.abs(p - q).max() <= 1e-8 * np.abs(q).max()


def test_pairs_of_negative_curvature_are_left_out():
    """From one point all springs are compressed, and the Hessian is indefinite for many iterations."""
    problem = random_problem(5, n=30, m=120)
    guess = 1e-3 * problem.first_guess
    path = [p.copy() for p in islice(Lbfgs().prepare(problem.system).iterates(problem), 400)]
    assert problem.value(path[-1]) < problem.value(guess)
    begun = np.abs(problem.gradient(problem.current)).max()
    assert np.abs(problem.gradient(path[-1])).max() <= 1e-7 * begun  # half of the digits, by the condition of Q
