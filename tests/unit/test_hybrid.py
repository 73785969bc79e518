"""The hybrid: where it starts, what it makes of soft and of stiff springs, and how much sooner it is there."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest

from solvers.methods.hybrid import Hybrid
from solvers.methods.lbfgs import Lbfgs
from solvers.methods.newton import Newton
from solvers.problem import Pins, StepProblem, StopRule, System
from tests.scenes import cloth, first_problem, random_problem


def stiff(ratio: float) -> StepProblem:
    """A step of a cloth with k dt^2/m = ratio, that gravity pulls."""
    given = first_problem(cloth(8, "exact"))
    mass = np.full(given.system.vertices, 300.0 * given.system.time_step**2 / ratio)
    force = np.zeros_like(given.force)
    force[:, 1] = -9.8 * mass
    return replace(given, system=replace(given.system, mass=mass), force=force)


@pytest.mark.parametrize("ratio", [1e6, 1e8, 1e10], ids="{:g}".format)
def test_stiff_springs_take_less_than_half_of_newtons_iterations(ratio):
    """Counted to a gap of 1e-4: 9 beside 26, 27 beside 125, 98 beside 573."""
    given = stiff(ratio)
    prepared = {solver: solver.prepare(given.system) for solver in (Newton(), Hybrid())}
    ends = [p.solve(given, StopRule(3000)).positions for p in prepared.values()]
    best, start = min(map(given.value, ends)), given.value(given.current)

    def count(solver) -> int:
        iterates = islice(prepared[solver].iterates(given), 3000)
        return next(k for k, p in enumerate(iterates, 1) if given.value(p) - best <= 1e-4 * (start - best))

    assert count(Hybrid()) < 0.5 * count(Newton())


def test_soft_springs_are_left_to_lbfgs():
    """Two rounds are 20 of its iterations, from the same start, bit for bit."""
    given = stiff(0.1)
    hybrid = [p.copy() for p in islice(Hybrid().prepare(given.system).iterates(given), 2)]
    fall = given.target + given.force / given.system.inertia[:, None]
    fall[given.system.pins.vertices] = given.pin_targets
    assert given.value(fall) < given.value(given.current)
    prepared = Lbfgs(precision="float32").prepare(given.system)
    lbfgs = [p.copy() for p in islice(prepared.iterates(replace(given, first_guess=fall)), 20)]
    np.testing.assert_array_equal(hybrid[0], lbfgs[9])
    np.testing.assert_array_equal(hybrid[1], lbfgs[19])


@pytest.mark.parametrize("guess", ["fall", "rest"])
def test_free_flight_is_found_at_once_from_any_guess(guess):
    """Without springs the minimum is free fall."""
    n = 5
    given = random_problem(0, n=n, m=1, weights=())
    system = System(given.system.mass, given.system.time_step, (), Pins())
    given = replace(given, system=system)
    fall = given.target + given.force / system.inertia[:, None]
    given = replace(given, first_guess=fall if guess == "fall" else given.current)
    found = next(Hybrid().prepare(system).iterates(given))
    np.testing.assert_allclose(found, fall, rtol=1e-14, atol=1e-14)  # a sum and a quotient, in another order


def test_vertices_without_mass_do_not_fall():
    given = random_problem(2, n=20, m=60)
    mass = np.where(np.arange(20) % 2, 0.0, 1.0)
    given = replace(given, system=replace(given.system, mass=mass))
    solution = Hybrid().prepare(given.system).solve(given, StopRule(200))
    assert np.isfinite(solution.positions).all()
    assert solution.stopped == "stalled"


def test_no_iterate_is_higher_than_the_one_before():
    given = stiff(1e6)
    path = [p.copy() for p in islice(Hybrid().prepare(given.system).iterates(given), 60)]
    values = [given.value(p) for p in (given.first_guess, *path)]
    # Sums of a thousand terms, each good to round-off over the strain of its spring.
    assert (np.diff(values) <= 1e-12 * given.magnitude(path[0])).all()
