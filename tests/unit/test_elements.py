"""Energies compiled from the law of one element, against their own NumPy text, which is the reference."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import csr_array
from springbench.harness.scenes.effects.contact_effect import ContactEffect
from springbench.solvers.model.energies.element_energies import JoinedElements, add_blocks
from springbench.solvers.objective.fixed_objective import FixedObjective
from springbench.solvers.objective.step_objective import StepObjective

from tests.effect_scenes import (
    DASHPOT_EFFECT,
    FLOOR_CONTACT,
    RAYLEIGH_EFFECT,
    STRAIN_LIMIT_EFFECT,
    build_effect_cloth,
    build_moving_problem,
)

ENERGIES = {
    "strain limits": (STRAIN_LIMIT_EFFECT, "StrainLimits"),
    "dashpots": (DASHPOT_EFFECT, "Dashpots"),
    "rayleigh": (RAYLEIGH_EFFECT, "RayleighDashpots"),
    "contact": (FLOOR_CONTACT, "HalfSpaceContact"),
}
SUMS = 1e-13
"""Sums of some dozen terms in another order, relative to the largest."""


@pytest.fixture(params=ENERGIES)
def begun_energy(request):
    """An energy of a step that has begun, and two points that it acts at."""
    effect, name = ENERGIES[request.param]
    problem = build_moving_problem(build_effect_cloth(effect))
    (energy,) = (e for e in problem.energies if type(e).__name__ == name)
    rng = np.random.default_rng(1)
    p, q = (
        problem.initial_guess - [0, 0.03, 0] + 0.02 * rng.normal(size=problem.inertial_target.shape) for _ in range(2)
    )
    assert energy.value(p) > 0.0
    return energy, p, q


def hessian(energy, p) -> np.ndarray:
    """(3n, 3n), from the second derivatives of the elements."""
    elements, n = energy.elements, len(p)
    curvature = np.empty((len(elements.vertices), 6))
    energy.element_law.evaluate_hessians(elements, p, curvature)
    k = elements.vertices.shape[1]
    places = np.repeat(elements.vertices, k, axis=1) * n + np.tile(elements.vertices, k)
    blocks = np.zeros((n * n, 3, 3))
    add_blocks(elements, places, curvature, blocks)
    return blocks.reshape(n, n, 3, 3).transpose(0, 2, 1, 3).reshape(3 * n, 3 * n)


def test_the_value_is_that_of_the_energy(begun_energy):
    energy, p, _ = begun_energy
    assert energy.element_law.value(energy.elements, p) == pytest.approx(energy.value(p), rel=SUMS)


def test_the_gradient_is_that_of_the_energy(begun_energy):
    energy, p, _ = begun_energy
    found, expected = np.zeros_like(p), np.zeros_like(p)
    energy.element_law.add_gradient(energy.elements, p, found)
    energy.add_gradient(p, expected)
    np.testing.assert_allclose(found, expected, rtol=0, atol=SUMS * np.abs(expected).max())


def test_the_hessian_is_that_of_the_energy(begun_energy):
    energy, p, _ = begun_energy
    expected = csr_array(energy.hessian(p)).toarray()
    np.testing.assert_allclose(hessian(energy, p), expected, rtol=0, atol=SUMS * np.abs(expected).max())


def test_the_objective_change_is_the_difference_of_the_values(begun_energy):
    energy, p, q = begun_energy
    expected, size = energy.value(q) - energy.value(p), energy.value(q) + energy.value(p)
    assert energy.element_law.energy_change(energy.elements, p, q) == pytest.approx(expected, rel=0, abs=SUMS * size)


def test_the_objective_change_is_accurate_where_the_difference_of_values_has_no_digits(begun_energy):
    energy, p, q = begun_energy
    slope = np.zeros_like(p)
    energy.add_gradient(p, slope)
    q = p + 1e-13 * (q - p)
    expected = float((slope * (q - p)).sum())  # to first order; what follows is less by the length of the step
    # A difference of values is off by 1e-16 of an energy of 1e13 times the rise.
    assert energy.element_law.energy_change(energy.elements, p, q) == pytest.approx(expected, rel=1e-5)


def test_elements_have_constant_second_derivatives_exactly_where_declared(begun_energy):
    energy, p, q = begun_energy
    assert np.array_equal(hessian(energy, p), hessian(energy, q)) == energy.element_law.has_constant_hessian


def test_a_product_is_that_of_all_energies_together():
    problem = build_moving_problem(build_effect_cloth(STRAIN_LIMIT_EFFECT, DASHPOT_EFFECT, FLOOR_CONTACT))
    step = StepObjective(FixedObjective(problem.system), problem)
    assert isinstance(step.joined_elements, JoinedElements)
    p = step.apply_exact_pins(problem.initial_guess - [0, 0.03, 0])
    x = np.random.default_rng(2).normal(size=p.shape)
    x[problem.system.pins.vertices] = 0.0
    expected = problem.system.inertia_diagonal[:, None] * x
    for energy in problem.energies:
        expected += (csr_array(energy.hessian(p)) @ x.ravel()).reshape(-1, 3)
    expected[problem.system.pins.vertices[problem.system.pins.exact_mask]] = 0.0
    _, vertices, weight = problem.system.penalty_pins
    expected[vertices] += weight[:, None] * x[vertices]
    np.testing.assert_allclose(step.hessian(p).matvec(x), expected, rtol=0, atol=SUMS * np.abs(expected).max())


def test_energies_that_have_no_elements_in_a_step_are_left_out_of_it():
    far = ContactEffect.model_validate({"obstacles": [{"kind": "plane", "point": (0, -50, 0)}]})
    problem = build_moving_problem(build_effect_cloth(far))
    assert not StepObjective(FixedObjective(problem.system), problem).element_energies
