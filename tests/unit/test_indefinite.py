"""What Newton's method does about indefinite Hessians: each rule on elements whose eigenvalues are known, and where it
ends."""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from springbench.solvers.iteration.descent_method import DescentPoint, PreparedDescent, ResidualMetric
from springbench.solvers.methods.newton.hessian_regularisation import (
    REGULARISATION_RULES,
    ClampRule,
    ContactScheduleRule,
    IndefiniteStrategy,
    ProgressiveRule,
    TrustRegionRule,
)
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.step_problem import DirichletPins, StepProblem, StopRule, Unsupported
from springbench.solvers.objective.fixed_objective import FixedObjective
from springbench.solvers.objective.psd_projection import PsdProjection
from springbench.solvers.objective.step_objective import StepObjective

from tests.effect_scenes import EFFECT_SCENES, build_moving_problem
from tests.scene_builders import build_cloth, build_first_problem
from tests.self_contact_scenes import build_touching_sheets

OTHERS = [name for name in get_args(IndefiniteStrategy) if name != "shift-schedule"]
others = pytest.mark.parametrize("rule", OTHERS)

FILTERS = {"clamp": lambda x: np.maximum(x, 0.0), "absolute": np.abs}
filters = pytest.mark.parametrize("name", FILTERS)

FIRST, SECOND = 0.4, 0.1
"""Lengths of two springs of length 1 at rest."""


def build_compressed_step() -> StepProblem:
    """Two springs of 1 N/m along x, each from a vertex that is pinned to one that is free, k dt^2/m = 1/10."""
    given = build_first_problem(build_cloth(2, "exact"))
    edges = np.array([[0, 1], [2, 3]])
    springs = Springs(edges, np.ones(2), np.ones(2), np.tile([1.0, 0.0, 0.0], (2, 1)))
    p = np.zeros((4, 3))
    p[:, 0] = [0.0, FIRST, 5.0, 5.0 + SECOND]
    pins = DirichletPins(np.array([0, 2]), np.full(2, np.inf))
    system = replace(given.system, mass=np.full(4, 10.0), time_step=1.0, energies=(springs,), pins=pins)
    return replace(
        given,
        system=system,
        inertial_target=p,
        external_force=np.zeros_like(p),
        current_positions=p,
        initial_guess=p,
        pin_targets=p[[0, 2]],
    )


def lateral(length: float) -> float:
    return 1.0 - 1.0 / length


def begin_descent(given: StepProblem) -> tuple[StepObjective, DescentPoint, np.ndarray]:
    step = StepObjective(FixedObjective(given.system), given)
    p = step.apply_exact_pins(given.initial_guess)
    return step, DescentPoint(p, step.gradient(p)), np.repeat(ResidualMetric(given.system).free_diagonal, 3)


def curvatures(hessian) -> list[float]:
    """What was factorised last, across each spring [N/m]."""
    across = np.zeros((4, 3))
    across[[1, 3], 1] = 1.0
    return [float(1.0 / x) for x in hessian.solve(across)[[1, 3], 1]]


@filters
def test_a_spring_retains_its_stiffness_and_its_lateral_part_is_filtered(name):
    step, at, diagonal = begin_descent(build_compressed_step())
    hessian = step.hessian(at.positions)
    assert REGULARISATION_RULES[name]().factorise_hessian(hessian, at, diagonal) == 1
    expected = [10.0 + FILTERS[name](lateral(length)) for length in (FIRST, SECOND)]
    np.testing.assert_allclose(curvatures(hessian), expected, rtol=1e-12)
    along = np.zeros((4, 3))
    along[[1, 3], 0] = 1.0
    np.testing.assert_allclose(hessian.solve(along)[[1, 3], 0], 1.0 / 11.0, rtol=1e-12)


@filters
def test_a_block_is_filtered_in_its_own_axes(name):
    axes = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    known = np.array([[3.0, -2.0, 0.5], [1.0, 2.0, 3.0]])
    whole = np.einsum("ij,mj,kj->mik", axes, known, axes)
    packed = whole[:, *np.triu_indices(3)]
    by = PsdProjection(use_absolute=name == "absolute")
    out = by.project_packed(np.array([[0], [1]]), packed)
    expected = np.einsum("ij,mj,kj->mik", axes, FILTERS[name](known), axes)
    np.testing.assert_allclose(out[0], expected[0][np.triu_indices(3)], atol=1e-14)
    np.testing.assert_array_equal(out[1], packed[1])
    assert (by.num_examined, by.num_projected) == (2, 1)


def test_absolute_values_of_a_part_of_the_elements_are_refused():
    with pytest.raises(ValueError, match="omit the mask, or clamp"):
        PsdProjection(use_absolute=True, vertex_mask=np.ones(3, np.bool_))


@filters
def test_pairs_of_surfaces_are_filtered_too(name):
    energy, p, _ = build_touching_sheets()
    exact = energy.hessian_blocks(p)
    size = np.linalg.eigvalsh(exact.values)
    assert size.min() < -1e-3 * size.max()
    found = PsdProjection(use_absolute=name == "absolute").project_pairs(exact)
    expected = np.sort(FILTERS[name](size), axis=1)
    np.testing.assert_allclose(np.linalg.eigvalsh(found.values), expected, atol=1e-12 * size.max())


def test_the_trust_region_takes_absolute_values_until_the_model_is_right():
    """Absolute values first; clamped after a step that the quadratic model foretold within 1 %, and only then."""
    given = build_compressed_step()
    step, at, _ = begin_descent(given)
    hessian, rule = step.hessian(at.positions), TrustRegionRule()
    assert rule.use_absolute
    for by, absolute in ((1e-6, False), (0.5, True), (1e-6, False)):
        q = at.positions.copy()
        q[3, 1] += by
        along = replace(given, external_force=np.where(q > at.positions, 1.0, 0.0))
        stated = StepObjective(FixedObjective(given.system), along)
        here = DescentPoint(at.positions, stated.gradient(at.positions))
        rule.record_step(stated, hessian, here, DescentPoint(q, here.gradient))
        assert rule.use_absolute is absolute


def test_progressive_projection_leaves_a_definite_hessian_as_it_is():
    step, at, diagonal = begin_descent(build_compressed_step())
    rule = ProgressiveRule()
    hessian = step.hessian(at.positions)
    assert rule.factorise_hessian(hessian, at, diagonal) == 0
    assert (rule.num_examined, rule.num_projected) == (0, 0)
    np.testing.assert_allclose(curvatures(hessian), [10.0 + lateral(x) for x in (FIRST, SECOND)], rtol=1e-12)


def test_progressive_projection_takes_the_elements_where_the_gradient_is_largest():
    """Without the inertia that stabilises it, the shorter spring makes the Hessian indefinite; its force is the larger
    one, so that the other one retains its negative lateral part."""
    given = build_compressed_step()
    system = replace(given.system, mass=np.full(4, 2.0))
    step, at, diagonal = begin_descent(replace(given, system=system))
    hessian, rule = step.hessian(at.positions), ProgressiveRule()
    force = at.gradient.copy()
    force[1] *= 0.1
    assert rule.factorise_hessian(hessian, at._replace(gradient=force), diagonal) == 1
    np.testing.assert_allclose(curvatures(hessian), [2.0 + lateral(FIRST), 2.0], rtol=1e-12)
    assert (rule.num_examined, rule.num_projected) == (1, 1)
    everywhere = ClampRule()
    everywhere.factorise_hessian(hessian, at, diagonal)
    assert everywhere.num_projected == 2


@others
@pytest.mark.parametrize("name", ["springs", "all that are projective", "contact"])
def test_all_rules_descend_to_the_same_certified_minimum(rule, name):
    given = (
        build_first_problem(build_cloth(8, "exact", stretch=1e4))
        if name == "springs"
        else build_moving_problem(EFFECT_SCENES[name]())
    )
    expected = NewtonSolver().prepare(given.system).solve(given, StopRule(300, 1e-11))
    prepared = NewtonSolver(rule).prepare(given.system)
    found = prepared.solve(given, StopRule(300, 1e-11))
    assert found.termination_reason in ("converged", "roundoff", "stalled")
    size = np.ptp(expected.positions, axis=0).max()
    np.testing.assert_allclose(found.positions, expected.positions, atol=1e-9 * size)
    _, at, _ = begin_descent(replace(given, initial_guess=found.positions))
    assert isinstance(prepared, PreparedDescent)
    assert prepared.method.can_terminate(StepObjective(FixedObjective(given.system), given), at)


@others
def test_all_rules_leave_a_saddle(rule):
    """Both springs pressed along their lines, in balance, and unstable across them."""
    given = build_compressed_step()
    system = replace(given.system, mass=np.full(4, 0.1))
    _, at, _ = begin_descent(replace(given, system=system))
    given = replace(given, system=system, external_force=at.gradient)
    start = StepObjective(FixedObjective(system), given)
    assert not start.gradient(at.positions).any()
    found = NewtonSolver(rule).prepare(system).solve(given, StopRule(300, 1e-10))
    p, free = found.positions, system.free_vertices
    assert given.value(p) < given.value(at.positions)
    (springs,) = system.energies
    hessian = springs.hessian(p).toarray()
    inner = (3 * free[:, None] + np.arange(3)).ravel()
    assert np.linalg.eigvalsh(hessian[np.ix_(inner, inner)] + 0.1 * np.eye(6)).min() > 0.0


@others
def test_energies_without_elements_are_refused_by_name(rule):
    made = EFFECT_SCENES["gas"]()
    with pytest.raises(
        Unsupported,
        match=f"newton, indefinite_strategy: {rule}: .*none of Gas; take indefinite_strategy: shift-schedule",
    ):
        NewtonSolver(rule).prepare(made.system)


def test_the_hessian_of_touching_pairs_becomes_exact_progressively():
    step, at, diagonal = begin_descent(build_compressed_step())
    rule, levels = ContactScheduleRule(), list[int | None]()
    for length in (0.05, 0.06, *[FIRST] * 4):
        p = at.positions.copy()
        p[3, 0] = p[2, 0] + length
        levels.append(rule.factorise_hessian(step.hessian(p), at._replace(positions=p), diagonal))
    # Inertia of 10 N/m outweighs a half of -19 N/m and of -15.7, no three quarters of them, and all of -1.5.
    assert levels == [2, 2, 1, 0, 0, 0]
