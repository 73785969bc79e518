"""What holds of every network: random ones, small enough to shrink.

Positions are drawn from a normal distribution, so that no spring is without a direction: what happens there is a
convention, and `tests.stability.test_hard_scenes` has it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import islice, pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.judge import Oracle
from solvers.energies.springs import Springs
from solvers.problem import Pins, Positions, Start, StepProblem, StopRule, System
from solvers.registry import SOLVERS, load

ALL = {name: load(target)() for name, target in SOLVERS.items()}
MINIMISERS = {name: solver for name, solver in ALL.items() if solver.minimises}
GLOBAL = ("dense", "sparse", "numba", "anderson", "chebyshev", "newton")
"""Methods whose every iterate is a global solve with all inertia in it, so that it has the right momentum; those that
go vertex by vertex, or shorten or cut off a step, have it when they have converged."""
DECIDING = ("anderson", "lbfgs", "newton-cg", "hybrid", "vbd")
"""Methods that ask of two nearly equal numbers which is larger: round-off may answer, and an iterate more or less is
the difference."""
ITERATIONS = 4

EPS = float(np.finfo(float).eps)
VALUE, ROUNDED = 1e-12, 2e-13
"""As in `tests.stability.test_hard_scenes`."""


@dataclass(frozen=True)
class Case:
    """A random network: n vertices, m springs, seed of all numbers; powers of ten of the stiffness number k dt^2/m and
    of how far stiffnesses lie apart; pinned: how many vertices."""

    n: int
    m: int
    seed: int
    number: float
    spread: float
    pinned: int

    def problem(self) -> StepProblem:
        """A step of the network, which moves and is pushed."""
        rng, dt, n = np.random.default_rng(self.seed), 1 / 30, self.n
        rest, first = rng.normal(size=(n, 3)), rng.integers(0, n, self.m)
        second = (first + rng.integers(1, n, self.m)) % n  # never itself; twins are welcome
        mass = rng.uniform(0.5, 1.5, n)
        k = 10.0 ** (self.number + self.spread * rng.uniform(-0.5, 0.5, self.m)) / dt**2
        springs = Springs.at_rest(rest, np.stack([first, second], axis=1), k)
        pins = Pins(np.arange(self.pinned), np.where(np.arange(self.pinned) % 2, 1e8, np.inf))
        system = System(mass, dt, (springs,), pins)
        p, v = rest + 0.3 * rng.normal(size=(n, 3)), rng.normal(size=(n, 3))
        current = p.copy()
        current[: self.pinned] = rest[: self.pinned]
        start = Start(p, v, 0.0, p, 1.0 / dt, dt)
        force = rng.normal(size=(n, 3))
        return StepProblem(system, p + dt * v, force, rest[: self.pinned], current, current, start)

    @property
    def tolerance(self) -> float:
        """Of positions, where two ways to the same iterate differ by round-off alone: the condition of Q times eps,
        a hundredfold, for each of the iterations multiplies what the one before has left."""
        return 100.0 * ITERATIONS * EPS * 10.0 ** max(0.0, self.number + self.spread)


EXAMPLES = settings(max_examples=12)
"""Of each property and method; there are sixty of these pairs."""

networks = st.builds(
    Case,
    n=st.integers(2, 9),
    m=st.integers(0, 16),
    seed=st.integers(0, 2**16),
    number=st.floats(-6, 5),
    spread=st.floats(0, 3),
    pinned=st.integers(0, 2),
)
minimisers = pytest.mark.parametrize("name", MINIMISERS)


def ends(name: str, problem: StepProblem) -> Positions:
    return ALL[name].prepare(problem.system).solve(problem, StopRule(ITERATIONS)).positions


def changed(problem: StepProblem, places, vectors, *, springs: Springs | None = None) -> StepProblem:
    """The problem with `places` applied to its positions [m] and `vectors` to its forces and velocities."""
    system = replace(problem.system, energies=(springs,)) if springs else problem.system
    start, at = problem.start, ("target", "pin_targets", "current", "first_guess")
    begun = replace(
        start, positions=places(start.positions), velocity=vectors(start.velocity), origin=places(start.origin)
    )
    moved = {key: places(getattr(problem, key)) for key in at}
    return replace(problem, system=system, force=vectors(problem.force), start=begun, **moved)


@minimisers
@EXAMPLES
@given(case=networks)
def test_iterates_are_finite_and_descend(name: str, case: Case):
    problem = case.problem()
    iterates = ALL[name].prepare(problem.system).iterates(problem)
    found = [problem.first_guess, *(p.copy() for p in islice(iterates, 8))]
    assert np.isfinite(found).all()
    floor = Oracle(problem.system).floor(problem.first_guess) / StopRule().floor
    slack = VALUE * max(map(problem.magnitude, found)) + 0.5 * (ROUNDED * floor) ** 2
    assert all(problem.value(q) <= problem.value(p) + slack for p, q in pairwise(found))


@minimisers
@EXAMPLES
@given(case=networks, turn=st.integers(0, 2**16), mirror=st.booleans())
def test_what_is_turned_shifted_or_mirrored_moves_as_before(name: str, case: Case, turn: int, mirror: bool):
    problem, rng = case.problem(), np.random.default_rng(turn)
    R, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    R = R * (np.sign(np.linalg.det(R)) * (-1.0 if mirror else 1.0))
    shift, springs = rng.normal(size=3), problem.system.energies[0]
    assert isinstance(springs, Springs)
    turned = replace(springs, rest_direction=springs.rest_direction @ R.T)
    other = changed(problem, lambda p: p @ R.T + shift, lambda v: v @ R.T, springs=turned)
    p = ends(name, problem)
    atol = case.tolerance
    if name in DECIDING:  # what is left to do: |e|_Q is at least sqrt(m)/dt |e|
        atol += 2.0 * Oracle(problem.system).residual(problem, p) / problem.system.inertia.min() ** 0.5
    np.testing.assert_allclose(ends(name, other), p @ R.T + shift, rtol=0, atol=atol)


@pytest.mark.parametrize("name", ["dense", "sparse", "numba", "newton"])
@EXAMPLES
@given(case=networks, order=st.integers(0, 2**16))
def test_the_numbering_of_vertices_and_springs_and_their_direction_mean_nothing(name: str, case: Case, order: int):
    problem, rng = case.problem(), np.random.default_rng(order)
    springs, n, q = problem.system.energies[0], case.n, case.pinned
    assert isinstance(springs, Springs)
    place = rng.permutation(n)  # where vertex i goes
    back = np.argsort(place)
    rows, flip = rng.permutation(case.m), rng.random(case.m) < 0.5
    edges = np.where(flip[:, None], place[springs.edges][:, ::-1], place[springs.edges])[rows]
    direction = np.where(flip[:, None], -springs.rest_direction, springs.rest_direction)[rows]
    renamed = Springs(edges, springs.stiffness[rows], springs.rest_length[rows], direction)
    where = np.argsort(place[:q])
    pins = Pins(place[:q][where], problem.system.pins.weight[where])
    system = System(problem.system.mass[back], problem.system.time_step, (renamed,), pins)
    other = changed(problem, lambda p: p[back] if len(p) == n else p, lambda v: v[back])
    other = replace(other, system=system, pin_targets=problem.pin_targets[where])
    np.testing.assert_allclose(ends(name, other)[place], ends(name, problem), rtol=0, atol=case.tolerance)


@minimisers
@EXAMPLES
@given(case=networks)
def test_units_of_length_time_and_mass_mean_nothing(name: str, case: Case):
    """Powers of two change no bit, so nothing but an absolute constant in a solver could change a digit."""
    problem, length, time, mass = case.problem(), 2.0**10, 2.0**-6, 2.0**4
    springs = problem.system.energies[0]
    assert isinstance(springs, Springs)
    k = mass / time**2
    scaled = replace(springs, stiffness=springs.stiffness * k, rest_length=springs.rest_length * length)
    pins = replace(problem.system.pins, weight=problem.system.pins.weight * k)
    system = System(problem.system.mass * mass, problem.system.time_step * time, (scaled,), pins)
    other = changed(problem, lambda p: p * length, lambda v: v * length / time)
    other = replace(other, system=system, force=problem.force * (k * length))
    other = replace(other, start=replace(other.start, rate=other.start.rate / time, until=other.start.until * time))
    np.testing.assert_array_equal(ends(name, other), ends(name, problem) * length)


@pytest.mark.parametrize("name", ALL)
@EXAMPLES
@given(case=networks)
def test_the_same_step_twice_has_the_same_bits(name: str, case: Case):
    problem = case.problem()
    np.testing.assert_array_equal(ends(name, problem), ends(name, problem))


@pytest.mark.parametrize("name", GLOBAL)
@EXAMPLES
@given(case=networks)
def test_what_nothing_holds_keeps_its_momentum(name: str, case: Case):
    problem = replace(case, pinned=0).problem()
    mass, dt = problem.system.mass[:, None], problem.system.time_step
    free = replace(problem, force=np.zeros_like(problem.force))
    moved = (mass * (ends(name, free) - free.start.positions)).sum(axis=0) / dt
    before = (mass * free.start.velocity).sum(axis=0)
    scale = (mass * np.abs(free.start.positions)).sum() / dt  # what the differences above are taken of
    np.testing.assert_allclose(
        moved, before, rtol=0, atol=100 * EPS * 10.0 ** max(0.0, case.number + case.spread) * scale
    )


@minimisers
@EXAMPLES
@given(case=networks)
def test_springs_of_no_strength_leave_free_fall(name: str, case: Case):
    problem = replace(case, number=-40.0, spread=0.0, pinned=0).problem()
    fall = problem.target + problem.force / problem.system.inertia[:, None]
    np.testing.assert_allclose(ends(name, problem), fall, rtol=0, atol=1e-13)  # a thousand eps of coordinates of some m
