"""Every energy of an effect against differences of itself, and what local-global requires of projective ones."""

from __future__ import annotations

import numpy as np
import pytest
from springbench.solvers.model.step_problem import Energy, Positions, ProjectiveEnergy, StepProblem, is_lagged
from springbench.solvers.model.system_matrix_assembly import assemble_system_matrix

from tests.effect_scenes import EFFECT_SCENES, build_effect_cloth, build_moving_problem

INTEGRATORS = ("implicit-euler", "bdf2", "midpoint")
PROBLEMS = {
    f"{name}, {integrator}": (name, integrator) for name in EFFECT_SCENES for integrator in INTEGRATORS if "all" in name
} | {name: (name, "implicit-euler") for name in EFFECT_SCENES if "all" not in name}
problems = pytest.mark.parametrize("case", PROBLEMS)

STEP = 1e-7
"""Of differences [m]: so short that no length passes a strain limit within it, where the Hessian jumps; round-off of
positions of order one, 1e-16, leaves seven digits or more."""


def of(case: str) -> StepProblem:
    name, integrator = PROBLEMS[case]
    return build_moving_problem(EFFECT_SCENES[name](), integrator)


def gradient(energy: Energy, p: Positions) -> Positions:
    out = np.zeros_like(p)
    energy.add_gradient(p, out)
    return out


def places(problem: StepProblem) -> tuple[Positions, Positions]:
    rng = np.random.default_rng(1)
    return problem.current_positions + 0.02 * rng.normal(size=problem.current_positions.shape), rng.normal(
        size=problem.current_positions.shape
    )


@problems
def test_the_gradient_is_the_slope_of_the_value(case):
    problem = of(case)
    p, u = places(problem)
    for energy in problem.energies:
        found = (energy.value(p + STEP * u) - energy.value(p - STEP * u)) / (2 * STEP)
        g = gradient(energy, p)
        assert found == pytest.approx(
            np.sum(g * u), abs=1e-5 * float(np.linalg.norm(g) * np.linalg.norm(u))
        )  # as above


@problems
def test_the_hessian_is_the_slope_of_the_gradient(case):
    problem = of(case)
    p, u = places(problem)
    for energy in problem.energies:
        found = (gradient(energy, p + STEP * u) - gradient(energy, p - STEP * u)) / (2 * STEP)
        expected = (energy.hessian(p) @ u.ravel()).reshape(p.shape)
        assert np.linalg.norm(found - expected) <= 1e-5 * np.linalg.norm(expected)  # as above


@problems
def test_the_hessian_is_symmetric(case):
    problem = of(case)
    p, _ = places(problem)
    for energy in problem.energies:
        H = energy.hessian(p)
        assert abs(H - H.T).max() <= 1e-13 * abs(H).max()  # the order of products


@problems
def test_a_projective_energys_gradient_is_its_stiffness_less_its_projection(case):
    problem = of(case)
    p, _ = places(problem)
    for energy in problem.energies:
        if isinstance(energy, ProjectiveEnergy):
            expected = energy.stiffness_matrix(len(p)) @ p
            energy.add_projection(p, pulled := np.zeros_like(p))
            scale = np.abs(expected).max()  # whose last digits cancel
            np.testing.assert_allclose(gradient(energy, p), expected - pulled, rtol=0, atol=1e-13 * scale)


@problems
def test_a_projective_energys_stiffness_is_nowhere_less_than_its_hessian(case):
    problem = of(case)
    p, _ = places(problem)
    for energy in problem.energies:
        if isinstance(energy, ProjectiveEnergy):
            K = np.kron(energy.stiffness_matrix(len(p)).toarray(), np.eye(3))
            # Round-off of eigenvalues of the size of the largest.
            assert np.linalg.eigvalsh(K - energy.hessian(p).toarray()).min() >= -1e-13 * np.abs(K).max() * len(K)


@problems
def test_the_system_matrix_has_the_stiffness_of_the_step(case):
    problem = of(case)
    n = problem.system.num_vertices
    projective = [energy for energy in problem.system.energies if isinstance(energy, ProjectiveEnergy)]
    Q = assemble_system_matrix(problem.system, projective).toarray()
    s = problem.system
    pinned = s.inertia_diagonal + np.bincount(*s.penalty_pins[1:], minlength=n)
    expected = np.diag(pinned)
    for energy in problem.energies:
        expected = expected + (energy.stiffness_matrix(n).toarray() if isinstance(energy, ProjectiveEnergy) else 0.0)
    assert np.abs(Q - expected).max() <= 1e-13 * np.abs(expected).max()  # the order of sums


def test_a_lagged_energy_stores_no_state_of_a_step():
    problem = build_moving_problem(build_effect_cloth())
    one, two = (build_moving_problem(EFFECT_SCENES["all that are projective"]()) for _ in range(2))
    assert problem.value(problem.current_positions) < one.value(one.current_positions)
    lagged = [energy for energy in one.system.energies if is_lagged(energy)]
    assert len(lagged) == 6  # dashpots, Rayleigh damping of masses, springs and bending, air drag, attachments
    for energy in lagged:
        once, again = (energy.begin_step(one.step_start).value(one.current_positions) for _ in range(2))
        assert once == again
    assert one.value(one.current_positions) == two.value(two.current_positions)
