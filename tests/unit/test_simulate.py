"""Stepping: what a step's problem is made of, in which order, and where its iteration starts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from time import perf_counter, sleep

import numpy as np
import pytest

from harness.scenes.effects.constant_force import ConstantForce
from harness.scenes.effects.ether_drag import EtherDrag
from harness.scenes.effects.gravity import Gravity
from harness.scenes.effects.pins import Pins
from harness.scenes.effects.springs import Springs
from harness.scenes.mesh.chain import Chain
from harness.simulation.clock import Clock, Watch
from harness.simulation.measure import Settings, steps
from harness.simulation.step import FIRST_GUESSES, State, problem, simulate, start
from solvers.integrators import Motion
from solvers.problem import Positions, Solution, StepProblem, StopRule
from tests.scenes import BACKENDS, SCENES, scene, trajectory

DT = 1 / 30
VELOCITY = (1.0, -2.0, 0.5)
MADE = scene(
    Chain(), Springs(stretch=10.0), Gravity(), Pins(at=("first",), weight=1e4), size=4, time_step=DT, velocity=VELOCITY
)
RNG = np.random.default_rng(0)
NOW, BEFORE = (Motion(RNG.normal(size=(4, 3)), RNG.normal(size=(4, 3))) for _ in range(2))
STATE = State(NOW, BEFORE, 7)


@dataclass
class Pushed:
    """A prepared solver that moves every vertex by one, and keeps what it was asked."""

    asked: list[tuple[StepProblem, StopRule]] = field(default_factory=list)
    facts: dict[str, float] = field(default_factory=dict)
    choice: str = ""

    def iterates(self, problem: StepProblem) -> Iterator[Positions]:
        yield problem.first_guess + 1.0

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        self.asked.append((problem, stop))
        return Solution(problem.first_guess + 1.0, 3, 0.0, 0.0, "tolerance")

    def residual_at(self, problem: StepProblem, p: Positions) -> float:
        return 0.0

    def phases(self, problem: StepProblem) -> dict:
        return {}


def test_a_scene_starts_at_rest_or_with_its_velocity():
    state = start(MADE)
    np.testing.assert_array_equal(state.now.positions, MADE.mesh.rest)
    np.testing.assert_array_equal(state.now.velocity, np.tile(VELOCITY, (4, 1)))
    assert (state.before, state.index) == (None, 0)
    assert not start(replace(MADE, velocity=(0.0, 0.0, 0.0))).now.velocity.any()


@pytest.mark.parametrize("first_guess", FIRST_GUESSES)
def test_the_target_is_where_inertia_leads(first_guess):
    stated = problem(MADE, STATE, first_guess)
    np.testing.assert_allclose(stated.target, NOW.positions + DT * NOW.velocity, rtol=1e-14)
    np.testing.assert_array_equal(stated.force, np.outer(MADE.system.mass, [0.0, -9.81, 0.0]))
    np.testing.assert_array_equal(stated.pin_targets, MADE.mesh.rest[[0]])


@pytest.mark.parametrize("first_guess", FIRST_GUESSES)
def test_the_current_positions_have_their_pins_on_target(first_guess):
    current = problem(MADE, STATE, first_guess).current
    np.testing.assert_array_equal(current[0], MADE.mesh.rest[0])
    np.testing.assert_array_equal(current[1:], NOW.positions[1:])


def test_the_assignments_first_guess_leaves_pins_where_the_penalty_left_them():
    np.testing.assert_array_equal(problem(MADE, STATE, "assignment").first_guess, NOW.positions)


def test_the_current_first_guess_puts_pins_on_target():
    guess = problem(MADE, STATE, "current").first_guess
    np.testing.assert_array_equal(guess, [MADE.mesh.rest[0], *NOW.positions[1:]])


def test_the_inertial_first_guess_is_the_target_with_pins_on_theirs():
    stated = problem(MADE, STATE, "inertial")
    np.testing.assert_array_equal(stated.first_guess, [MADE.mesh.rest[0], *stated.target[1:]])


@pytest.mark.parametrize("first_guess", FIRST_GUESSES)
def test_stating_a_problem_writes_to_nothing(first_guess):
    now = Motion(NOW.positions.copy(), NOW.velocity.copy())
    for array in now:
        array.flags.writeable = False
    frozen = State(now, BEFORE, 7)
    stated = problem(MADE, frozen, first_guess)
    np.testing.assert_array_equal(now.positions, NOW.positions)
    assert not np.shares_memory(stated.target, now.positions)


def test_forces_are_taken_at_the_start_of_the_step():
    seen = []

    def force(p, v, t):
        seen.append((p.copy(), v.copy(), t))
        return np.ones_like(p)

    stated = problem(replace(MADE, forces=(force, force)), STATE, "current")
    (p, v, t), _ = seen
    np.testing.assert_array_equal(p, NOW.positions)
    np.testing.assert_array_equal(v, NOW.velocity)
    assert t == 7 * DT
    np.testing.assert_array_equal(stated.force, MADE.load + 2.0)


def test_filters_change_the_velocity_before_inertia_and_forces_see_it():
    seen = []

    def force(p, v, t):
        seen.append(v.copy())
        return 0.0 * p

    made = replace(MADE, forces=(force,), filters=(lambda v: 0.5 * v, lambda v: v + np.array([1.0, 0.0, 0.0])))
    stated = problem(made, STATE, "current")
    wanted = 0.5 * NOW.velocity + [1.0, 0.0, 0.0]  # in the order of the effects
    np.testing.assert_allclose(stated.target, NOW.positions + DT * wanted, rtol=1e-14)
    np.testing.assert_allclose(seen[0], wanted, rtol=1e-14)


def test_each_step_starts_from_the_two_before_it():
    prepared, rule = Pushed(), StopRule(9, 0.1)
    done = list(simulate(MADE, prepared, rule, first_guess="assignment", frames=3))
    assert [step.index for step in done] == [1, 2, 3]
    rest = MADE.mesh.rest
    for k, (stated, stop) in enumerate(prepared.asked):
        np.testing.assert_allclose(stated.first_guess, rest + k, rtol=1e-15)
        moved = np.array(VELOCITY) * DT if k == 0 else 1.0
        np.testing.assert_allclose(stated.target, rest + k + moved, rtol=0, atol=1e-14)
        assert stop == rule
    assert all(step.problem is stated for step, (stated, _) in zip(done, prepared.asked, strict=True))


class Slow(Pushed):
    """It sleeps while it solves."""

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        began = perf_counter()
        sleep(0.005)
        self.slept = perf_counter() - began
        return super().solve(problem, stop)


def test_a_steps_seconds_hold_its_solve_and_nothing_between_steps():
    prepared, clock = Slow(), Clock(Watch())
    run = steps(MADE, prepared, Settings(StopRule(), "current", 3, 1), clock)
    for _ in range(3):
        began = perf_counter()
        next(run)
        around = perf_counter() - began
        assert prepared.slept <= clock.seconds <= around  # intervals on one clock, each within the next
        sleep(0.01)


def test_steps_are_done_only_when_asked_for():
    prepared = Pushed()
    run = simulate(MADE, prepared, StopRule(), first_guess="current", frames=1000)
    next(run)
    assert len(prepared.asked) == 1


def test_a_simulation_can_be_repeated_to_the_last_bit():
    made = SCENES["cloth"](1e10)
    one, two = (trajectory(made, BACKENDS[2], 5) for _ in range(2))
    np.testing.assert_array_equal(one, two)


@pytest.mark.parametrize("rate", [0.5, 20.0])
def test_ether_drag_slows_a_free_particle_exponentially(rate):
    made = scene(Chain(), EtherDrag(rate=rate), size=2, velocity=VELOCITY, time_step=DT)
    p = trajectory(made, BACKENDS[0], 12)
    moved = np.diff(np.concatenate([made.mesh.rest[None], p]), axis=0)
    decay = np.exp(-rate * DT * np.arange(1, 13))
    wanted = DT * decay[:, None, None] * np.tile(VELOCITY, (2, 1))
    np.testing.assert_allclose(moved, wanted, rtol=0, atol=1e-14)  # differences of positions of order one


def test_a_force_acts_once_a_step():
    """x_n = f dt^2 n(n+1) / 2m: the closed form of implicit Euler under a constant force."""
    made = scene(Chain(), ConstantForce(force=(3.0, 0.0, 0.0)), size=2, mass=2.0, time_step=DT)
    p = trajectory(made, BACKENDS[1], 10)
    n = np.arange(1, 11)
    wanted = made.mesh.rest[:, 0] + (3.0 * DT**2 * n * (n + 1) / 2)[:, None]
    np.testing.assert_allclose(p[:, :, 0], wanted, rtol=1e-13)
