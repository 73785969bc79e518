"""Properties of every network: random ones, small enough to shrink.

Positions are drawn from a normal distribution, so that no spring is without a direction: what happens there is a
convention, and `tests.stability.test_hard_scenes` has it.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import islice, pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from springbench.solvers.model.step_problem import Positions, StepProblem, StopRule, System

from tests.scene_builders import rounding_scale
from tests.stability.random_networks import (
    ALL,
    EPS,
    MINIMISERS,
    Case,
    examples,
    networks,
    renumber_problem,
    rotate_problem,
    springs_of,
    transform_problem,
)

GLOBAL = ("dense", "sparse", "numba", "anderson", "chebyshev", "newton")
"""Methods whose every iterate is a global solve with all inertia in it, so that it has the right momentum; those that
go vertex by vertex, or shorten or cut off a step, have it when they have converged."""
STEADY = ("dense", "sparse", "numba", "chebyshev", "newton")
"""Methods that compare no two nearly equal numbers: round-off would decide, and an iterate more or less
be the difference. The others are tested likewise where they have converged, in `test_properties_converged`."""
ITERATIONS = 4

VALUE, POSITION_ROUNDOFF = 1e-12, 2e-13
"""As in `tests.stability.test_hard_scenes`."""

EXAMPLES = examples(12)
"""Of each property and method; there are sixty of these pairs."""

minimisers = pytest.mark.parametrize("name", MINIMISERS)
steady = pytest.mark.parametrize("name", STEADY)


def ends(name: str, problem: StepProblem) -> Positions:
    return ALL[name].prepare(problem.system).solve(problem, StopRule(ITERATIONS)).positions


def tolerance(case: Case) -> float:
    """Of positions, where two ways to the same iterate differ by round-off alone: the condition of Q times eps, a
    hundredfold, for each of the iterations multiplies what the one before has left."""
    return 100.0 * ITERATIONS * EPS * case.worst


@minimisers
@EXAMPLES
@given(case=networks())
def test_iterates_are_finite_and_descend(name: str, case: Case):
    problem = case.problem()
    iterates = ALL[name].prepare(problem.system).iterates(problem)
    found = [problem.initial_guess, *(p.copy() for p in islice(iterates, 8))]
    assert np.isfinite(found).all()
    if not ALL[name].is_monotone:
        return
    floor = rounding_scale(problem)
    slack = VALUE * max(map(problem.value_scale, found)) + 0.5 * (POSITION_ROUNDOFF * floor) ** 2
    assert all(problem.value(q) <= problem.value(p) + slack for p, q in pairwise(found))


@steady
@EXAMPLES
@given(case=networks(), turn=st.integers(0, 2**16), mirror=st.booleans())
def test_rotated_shifted_and_mirrored_scenes_have_the_same_motion(name: str, case: Case, turn: int, mirror: bool):
    problem = case.problem()
    other, moved = rotate_problem(problem, turn, mirror)
    np.testing.assert_allclose(ends(name, other), moved(ends(name, problem)), rtol=0, atol=tolerance(case))


@steady
@EXAMPLES
@given(case=networks(), order=st.integers(0, 2**16))
def test_the_motion_does_not_depend_on_the_numbering_or_direction_of_vertices_and_springs(
    name: str, case: Case, order: int
):
    problem = case.problem()
    other, moved = renumber_problem(problem, order)
    np.testing.assert_allclose(ends(name, other), moved(ends(name, problem)), rtol=0, atol=tolerance(case))


@minimisers
@EXAMPLES
@given(case=networks())
def test_the_motion_does_not_depend_on_the_units_of_length_time_and_mass(name: str, case: Case):
    """Powers of two change no bit, so nothing but an absolute constant in a solver could change a digit."""
    problem, length, time, mass = case.problem(), 2.0**10, 2.0**-6, 2.0**4
    springs = springs_of(problem)
    k = mass / time**2
    scaled = replace(springs, stiffness=springs.stiffness * k, rest_length=springs.rest_length * length)
    pins = replace(problem.system.pins, weight=problem.system.pins.weight * k)
    system = System(problem.system.mass * mass, problem.system.time_step * time, (scaled,), pins)
    other = transform_problem(problem, lambda p: p * length, lambda v: v * length / time)
    other = replace(other, system=system, external_force=problem.external_force * (k * length))
    other = replace(
        other,
        step_start=replace(
            other.step_start,
            velocity_rate=other.step_start.velocity_rate / time,
            stage_time=other.step_start.stage_time * time,
        ),
    )
    np.testing.assert_array_equal(ends(name, other), ends(name, problem) * length)


@pytest.mark.parametrize("name", ALL)
@EXAMPLES
@given(case=networks())
def test_the_same_step_twice_has_the_same_bits(name: str, case: Case):
    problem = case.problem()
    np.testing.assert_array_equal(ends(name, problem), ends(name, problem))


@pytest.mark.parametrize("name", GLOBAL)
@EXAMPLES
@given(case=networks())
def test_a_free_body_conserves_momentum(name: str, case: Case):
    problem = replace(case, pinned=0).problem()
    mass, dt = problem.system.mass[:, None], problem.system.time_step
    free = replace(problem, external_force=np.zeros_like(problem.external_force))
    moved = (mass * (ends(name, free) - free.step_start.positions)).sum(axis=0) / dt
    before = (mass * free.step_start.velocity).sum(axis=0)
    scale = (mass * np.abs(free.step_start.positions)).sum() / dt  # what the differences above are taken of
    np.testing.assert_allclose(moved, before, rtol=0, atol=100 * EPS * case.worst * scale)


@pytest.mark.parametrize("name", GLOBAL)
@EXAMPLES
@given(case=networks())
def test_a_free_body_at_rest_length_moves_uniformly(name: str, case: Case):
    free, expected = case.flying()
    atol = 100 * EPS * case.worst * np.abs(expected).max()
    np.testing.assert_allclose(ends(name, free), expected, rtol=0, atol=atol)


@minimisers
@EXAMPLES
@given(case=networks())
def test_springs_of_no_strength_leave_free_fall(name: str, case: Case):
    problem = replace(case, number=-40.0, spread=0.0, pinned=0).problem()
    fall = problem.inertial_target + problem.external_force / problem.system.inertia_diagonal[:, None]
    np.testing.assert_allclose(ends(name, problem), fall, rtol=0, atol=1e-13)  # a thousand eps of coordinates of some m
