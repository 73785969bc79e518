"""Pins by penalty, exact pins, and what joins them: as the weight grows the one becomes the other."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from springbench.solvers.methods.local_global.reference_local_global import SparseLocalGlobal
from springbench.solvers.model.step_problem import DirichletPins, StepProblem, StopRule

from tests.scene_builders import LOCAL_GLOBAL_BACKENDS, build_cloth, build_first_problem, build_random_problem

backends = pytest.mark.parametrize("backend", LOCAL_GLOBAL_BACKENDS, ids=lambda b: type(b).__name__)

CONVERGED_STOP = StopRule(3000, 1e-13)


def add_pins(problem: StepProblem, vertices: list[int], weight: float, seed: int = 0) -> StepProblem:
    """The problem with these pins, their targets away from the rest positions."""
    pins = DirichletPins(np.array(vertices, np.int64), np.full(len(vertices), weight))
    targets = problem.current_positions[vertices] + 0.1 * np.random.default_rng(seed).normal(size=(len(vertices), 3))
    return replace(problem, system=replace(problem.system, pins=pins), pin_targets=targets)


@backends
@pytest.mark.parametrize("weight", [1e4, 1e7, 1e10])
def test_a_penalty_pin_yields_by_the_force_on_it_over_its_weight(backend, weight):
    problem = add_pins(build_random_problem(0), [0, 3], weight)
    p = backend.prepare(problem.system).solve(problem, CONVERGED_STOP).positions
    free = replace(problem, system=replace(problem.system, pins=DirichletPins()), pin_targets=np.empty((0, 3)))
    reaction = -free.gradient(p)[[0, 3]]  # what springs, inertia and forces pull at the pins with
    gives = p[[0, 3]] - problem.pin_targets
    # Positions of order one are known to 1e-15 after the last solve, the reaction to 1e-9 after convergence.
    np.testing.assert_allclose(gives, reaction / weight, rtol=1e-8, atol=1e-14)


@backends
def test_a_penalty_becomes_an_exact_pin_in_proportion_to_its_weight(backend):
    exact = add_pins(build_random_problem(0), [0, 3], np.inf)
    expected = backend.prepare(exact.system).solve(exact, CONVERGED_STOP).positions
    away = []
    for weight in (1e6, 1e7, 1e8):
        soft = add_pins(build_random_problem(0), [0, 3], weight)
        away.append(np.abs(backend.prepare(soft.system).solve(soft, CONVERGED_STOP).positions - expected).max())
    # 1/w is the leading term; the next is smaller by stiffness / weight, at most 1e4 / 1e6.
    np.testing.assert_allclose([away[0] / away[1], away[1] / away[2]], 10.0, rtol=0.02)


@backends
def test_the_weight_of_the_assignment_pins_a_cloth_to_a_billionth(backend):
    made = build_cloth(8)
    problem = build_first_problem(made)
    p = backend.prepare(made.system).solve(problem, StopRule(50)).positions
    pinned_vertices = made.system.pins.vertices
    # A cloth of 1 kg pulls at a pin with some tens of newtons, which 1e10 N/m answer at some 1e-9 m.
    assert np.abs(p[pinned_vertices] - made.pin_targets).max() <= 1e-8


@backends
def test_all_vertices_may_be_pinned_exactly(backend):
    problem = add_pins(build_random_problem(1), list(range(12)), np.inf)
    prepared = backend.prepare(problem.system)
    solution = prepared.solve(problem, StopRule(5, 1e-6))
    np.testing.assert_array_equal(solution.positions, problem.pin_targets)
    assert (solution.num_iterations, solution.residual) == (1, 0.0)
    assert not problem.gradient(solution.positions).any()


@backends
def test_all_vertices_may_be_pinned_by_penalties(backend):
    problem = add_pins(build_random_problem(1), list(range(12)), 1e10)
    p = backend.prepare(problem.system).solve(problem, StopRule(5, 1e-6)).positions
    # Forces of some thousand newtons over the weight.
    np.testing.assert_allclose(p, problem.pin_targets, rtol=0, atol=1e-5)


@backends
@pytest.mark.parametrize("weight", [1e3, np.inf])
def test_a_vertex_alone_may_be_pinned(backend, weight):
    problem = add_pins(build_random_problem(2, n=1, m=0, weights=()), [0], weight)
    (p,) = islice(backend.prepare(problem.system).iterates(problem), 1)
    inertia = problem.system.mass[0] / problem.system.time_step**2
    pulled = (inertia * problem.inertial_target + problem.external_force + 1e3 * problem.pin_targets) / (inertia + 1e3)
    np.testing.assert_allclose(p, problem.pin_targets if np.isinf(weight) else pulled, rtol=1e-14)


@backends
def test_massless_vertices_follow_springs_and_pins(backend):
    problem = add_pins(build_random_problem(3), [0, 1], np.inf)
    light = replace(problem.system, mass=np.where(np.arange(12) % 2, 0.0, problem.system.mass))
    problem = replace(problem, system=light)
    p = backend.prepare(light).solve(problem, CONVERGED_STOP).positions
    # Without inertia to hold it the slack part of the network settles slowly: six digits in 3000 iterations.
    assert np.abs(problem.gradient(p)).max() <= 1e-6 * np.abs(problem.gradient(problem.initial_guess)).max()


@backends
def test_the_order_of_magnitude_of_one_pin_does_not_blur_the_others(backend):
    """Weights of 1 and 1e12 N/m in one system, against elimination of the stiff one."""
    problem = build_random_problem(4)
    problem = replace(problem, initial_guess=problem.current_positions)
    mixed = replace(problem.system, pins=DirichletPins(np.array([0, 1]), np.array([1.0, 1e12])))
    limit = replace(problem.system, pins=DirichletPins(np.array([0, 1]), np.array([1.0, np.inf])))
    found = [
        backend.prepare(system).solve(replace(problem, system=system), StopRule(50)).positions
        for system in (mixed, limit)
    ]
    # The stiff pin gives way by some 1e4 N / 1e12 N/m, once.
    np.testing.assert_allclose(found[0], found[1], rtol=0, atol=1e-7)


def test_targets_follow_the_order_of_the_pins_where_exact_ones_and_penalties_alternate():
    problem = build_random_problem(5)
    weights = np.array([np.inf, 1e8, np.inf, 1e8])
    vertices, targets = np.array([1, 2, 5, 8]), np.arange(12.0).reshape(4, 3)
    problem = replace(
        problem, system=replace(problem.system, pins=DirichletPins(vertices, weights)), pin_targets=targets
    )
    p = SparseLocalGlobal().prepare(problem.system).solve(problem, StopRule(20)).positions
    # Some 1e4 N over 1e8 N/m.
    np.testing.assert_allclose(p[vertices], targets, rtol=0, atol=1e-3)
    np.testing.assert_array_equal(p[[1, 5]], targets[[0, 2]])
