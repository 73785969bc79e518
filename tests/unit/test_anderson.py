"""Anderson acceleration against a least-squares solve, and its safeguard."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from scipy.linalg import cholesky
from springbench.solvers.methods.quasi_newton.anderson import Anderson
from springbench.solvers.model.step_problem import Positions, ProjectiveEnergy, StepProblem, StopRule, Unsupported
from springbench.solvers.model.system_matrix_assembly import assemble_system_matrix

from tests.scene_builders import build_cloth, build_first_problem, build_random_problem
from tests.unit.test_accelerated import Barrier

PROBLEMS = {"cloth": lambda: build_first_problem(build_cloth(7, "exact")), "random": lambda: build_random_problem(4)}


def by_least_squares(problem: StepProblem, pairs: int, count: int) -> list[Positions]:
    """Peng et al. 2018, algorithm 1, in NumPy: residuals in the norm of Q, by LAPACK's least squares."""
    system, free = problem.system, problem.system.free_vertices
    Q = assemble_system_matrix(system, [e for e in system.energies if isinstance(e, ProjectiveEnergy)]).toarray()[
        np.ix_(free, free)
    ]
    root = cholesky(Q)
    p = problem.initial_guess.copy()
    p[system.pins.vertices[system.pins.exact_mask]] = problem.pin_targets[system.pins.exact_mask]
    visited: list[tuple[Positions, Positions]] = []
    path = []
    for _ in range(count):
        residual = -np.linalg.solve(Q, problem.gradient(p)[free])
        plain = p[free] + residual
        visited = [*visited, (plain, residual)][-pairs - 1 :]
        best = plain
        if len(visited) > 1:
            moved, changed = (np.diff([v[k] for v in visited], axis=0) for k in (0, 1))
            columns = np.stack([(root @ c).ravel() for c in changed], axis=1)
            theta = np.linalg.lstsq(columns, (root @ residual).ravel())[0]
            best = plain - np.tensordot(theta, moved, axes=1)
        candidate = p.copy()
        candidate[free] = best
        if problem.value(candidate) > problem.value(p):
            candidate[free] = plain
        p = candidate
        path.append(p)
    return path


@pytest.mark.parametrize("name", PROBLEMS)
@pytest.mark.parametrize("pairs", [1, 2, 5])
@pytest.mark.parametrize("linear", ["supernodal", "cholespy"])
def test_iterates_are_those_of_the_least_squares_problem(name, pairs, linear):
    problem = PROBLEMS[name]()
    expected = by_least_squares(problem, pairs, 10)
    for p, q in zip(
        islice(Anderson(pairs, linear).prepare(problem.system).iterates(problem), 10), expected, strict=True
    ):
        # Normal equations lose twice the digits that the differences' dependence costs LAPACK.
        assert np.abs(p - q).max() <= 1e-6 * np.abs(q).max()


def test_energies_that_are_not_projective_are_refused_by_name():
    system = build_first_problem(build_cloth(4)).system
    with pytest.raises(Unsupported, match=r"anderson.*Barrier"):
        Anderson().prepare(replace(system, energies=(*system.energies, Barrier(1.0))))


def test_differences_that_depend_on_each_other_do_no_harm():
    """One free vertex has three coordinates: five differences are never independent."""
    problem = build_random_problem(6, n=3, m=6, weights=(np.inf, np.inf))
    solution = Anderson(8).prepare(problem.system).solve(problem, StopRule(500, 1e-12))
    assert solution.termination_reason in ("converged", "roundoff")
    begun = np.abs(problem.gradient(problem.current_positions)).max()
    assert (
        np.abs(problem.gradient(solution.positions)).max() <= 1e-10 * begun
    )  # as requested, by the condition of one row
