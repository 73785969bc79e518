"""Chebyshev acceleration: its estimate of the spectral radius, and what comes of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import eigh
from springbench.solvers.kernels.iteration_loop import RESIDUAL_EACH, LoopLimits
from springbench.solvers.methods.quasi_newton.chebyshev import Chebyshev
from springbench.solvers.methods.quasi_newton.windowed_acceleration import PreparedAccelerated
from springbench.solvers.model.step_problem import ProjectiveEnergy, StepProblem, StopRule, Unsupported
from springbench.solvers.model.system_matrix_assembly import assemble_system_matrix

from tests.scene_builders import build_cloth, build_first_problem, build_random_problem
from tests.unit.test_accelerated import Barrier

PROBLEMS = {
    "cloth": lambda: build_first_problem(build_cloth(8, "exact")),
    "stiff cloth": lambda: build_first_problem(build_cloth(8, "exact", stretch=1e4)),
    "random": lambda: build_random_problem(0),
}
problems = pytest.mark.parametrize("name", PROBLEMS)


def radius(problem: StepProblem, p) -> float:
    """The largest eigenvalue of I - Q^-1 Hessian at p, by LAPACK."""
    system, free = problem.system, problem.system.free_vertices
    Q = assemble_system_matrix(system, [e for e in system.energies if isinstance(e, ProjectiveEnergy)]).toarray()[
        np.ix_(free, free)
    ]
    _, soft, weight = system.penalty_pins
    diagonal = system.inertia_diagonal.copy()
    diagonal[soft] += weight
    coordinates = (3 * free[:, None] + np.arange(3)).ravel()
    H = np.diag(np.repeat(diagonal, 3)) + np.sum([e.hessian(p).toarray() for e in system.energies], axis=0)
    H, Q3 = H[np.ix_(coordinates, coordinates)], np.kron(Q, np.eye(3))
    return 1.0 - float(eigh(H, Q3, eigvals_only=True)[0])


@problems
def test_the_estimate_tends_to_the_radius_of_convergence_and_not_beyond(name):
    problem = PROBLEMS[name]()
    prepared = Chebyshev("cholespy").prepare(problem.system)
    assert isinstance(prepared, PreparedAccelerated)
    run = prepared.init_state(problem, problem.initial_guess)
    run.run_iterations(LoopLimits(4000, 1e-9 * run.residual(), 0.0, RESIDUAL_EACH))
    now = run._window.window_state  # type: ignore[attr-defined]  the runs of every engine have one
    expected, found = radius(problem, run.positions), float(now["spectral_radius"][0])
    # The rate goes with the root of 1 - rho: twice too far from 1 costs 1.4 times the iterations, half as far too.
    assert 0.5 <= (1.0 - found) / (1.0 - expected) <= 3.0


@problems
def test_the_residual_shrinks_as_the_radius_predicts(name):
    problem = PROBLEMS[name]()
    prepared = Chebyshev().prepare(problem.system)
    end = prepared.solve(problem, StopRule(6000, 1e-11))
    near = replace(
        problem, initial_guess=end.positions + 1e-6 * np.random.default_rng(0).normal(size=end.positions.shape)
    )
    begun = prepared.solve(near, StopRule(0)).residual
    solution = prepared.solve(near, StopRule(3000, 1e-5 * begun / end.initial_residual))
    rho = radius(problem, end.positions)
    sigma = rho / (2.0 - rho)
    rate = -np.log(sigma / (1.0 + np.sqrt(1.0 - sigma**2)))
    # Twelve e-folds by theory once rho is known, three times as many while it is learnt, a few to begin with.
    assert solution.num_iterations <= 3.0 * np.log(1e5) / rate + 10


def test_energies_that_are_not_projective_are_refused_by_name():
    system = build_first_problem(build_cloth(4)).system
    with pytest.raises(Unsupported, match=r"chebyshev.*Barrier"):
        Chebyshev().prepare(replace(system, energies=(*system.energies, Barrier(1.0))))
