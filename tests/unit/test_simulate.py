"""Stepping: what a step's problem is made of, in which order, and where its iteration starts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from time import perf_counter, sleep

import numpy as np
import pytest
from springbench.harness.scenes.effects.constant_force_effect import ConstantForceEffect
from springbench.harness.scenes.effects.ether_drag_effect import EtherDragEffect
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.simulation.stopwatch import PhaseWatch, Stopwatch
from springbench.harness.simulation.time_loop import (
    INITIAL_GUESSES,
    MotionState,
    build_initial_state,
    build_problem,
    simulate_scene,
)
from springbench.harness.simulation.timing_pass import SteppingSettings, iterate_steps
from springbench.solvers.model.integrators import Motion
from springbench.solvers.model.step_problem import Positions, Solution, StepProblem, StopRule

from tests.scene_builders import LOCAL_GLOBAL_BACKENDS, SCENE_BUILDERS, build_test_scene, simulate_trajectory

DT = 1 / 30
VELOCITY = (1.0, -2.0, 0.5)
SCENE = build_test_scene(
    ChainMesh(),
    SpringsEffect(stretch=10.0),
    GravityEffect(),
    PinsEffect(parts=("first",), weight=1e4),
    size=4,
    time_step=DT,
    velocity=VELOCITY,
)
RNG = np.random.default_rng(0)
NOW, BEFORE = (Motion(RNG.normal(size=(4, 3)), RNG.normal(size=(4, 3))) for _ in range(2))
STATE = MotionState(NOW, BEFORE, 7)


@dataclass
class ShiftingSolver:
    """A prepared solver that moves every vertex by one, and records its arguments."""

    asked: list[tuple[StepProblem, StopRule]] = field(default_factory=list)
    stats: dict[str, float] = field(default_factory=dict)
    description: str = ""

    def iterates(self, problem: StepProblem) -> Iterator[Positions]:
        yield problem.initial_guess + 1.0

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        self.asked.append((problem, stop))
        return Solution(problem.initial_guess + 1.0, 3, 0.0, 0.0, "converged")

    def residual_at(self, problem: StepProblem, p: Positions) -> float:
        return 0.0

    def iteration_phases(self, problem: StepProblem) -> dict:
        return {}


def test_a_scene_starts_at_rest_or_with_its_velocity():
    state = build_initial_state(SCENE)
    np.testing.assert_array_equal(state.motion.positions, SCENE.mesh.rest_positions)
    np.testing.assert_array_equal(state.motion.velocity, np.tile(VELOCITY, (4, 1)))
    assert (state.previous_motion, state.index) == (None, 0)
    assert not build_initial_state(replace(SCENE, initial_velocity=(0.0, 0.0, 0.0))).motion.velocity.any()


@pytest.mark.parametrize("first_guess", INITIAL_GUESSES)
def test_the_target_is_where_inertia_leads(first_guess):
    stated = build_problem(SCENE, STATE, first_guess)
    np.testing.assert_allclose(stated.inertial_target, NOW.positions + DT * NOW.velocity, rtol=1e-14)
    np.testing.assert_array_equal(stated.external_force, np.outer(SCENE.system.mass, [0.0, -9.81, 0.0]))
    np.testing.assert_array_equal(stated.pin_targets, SCENE.mesh.rest_positions[[0]])


@pytest.mark.parametrize("first_guess", INITIAL_GUESSES)
def test_the_current_positions_have_their_pins_on_target(first_guess):
    current = build_problem(SCENE, STATE, first_guess).current_positions
    np.testing.assert_array_equal(current[0], SCENE.mesh.rest_positions[0])
    np.testing.assert_array_equal(current[1:], NOW.positions[1:])


def test_the_assignments_first_guess_leaves_pins_where_the_penalty_left_them():
    np.testing.assert_array_equal(build_problem(SCENE, STATE, "assignment").initial_guess, NOW.positions)


def test_the_current_first_guess_puts_pins_on_target():
    guess = build_problem(SCENE, STATE, "previous").initial_guess
    np.testing.assert_array_equal(guess, [SCENE.mesh.rest_positions[0], *NOW.positions[1:]])


def test_the_inertial_first_guess_is_the_target_with_pins_on_their_targets():
    stated = build_problem(SCENE, STATE, "inertial")
    np.testing.assert_array_equal(stated.initial_guess, [SCENE.mesh.rest_positions[0], *stated.inertial_target[1:]])


@pytest.mark.parametrize("first_guess", INITIAL_GUESSES)
def test_stating_a_problem_writes_to_nothing(first_guess):
    now = Motion(NOW.positions.copy(), NOW.velocity.copy())
    for array in now:
        array.flags.writeable = False
    frozen = MotionState(now, BEFORE, 7)
    stated = build_problem(SCENE, frozen, first_guess)
    np.testing.assert_array_equal(now.positions, NOW.positions)
    assert not np.shares_memory(stated.inertial_target, now.positions)


def test_forces_are_taken_at_the_start_of_the_step():
    seen = []

    def force(p, v, t):
        seen.append((p.copy(), v.copy(), t))
        return np.ones_like(p)

    stated = build_problem(replace(SCENE, varying_forces=(force, force)), STATE, "previous")
    (p, v, t), _ = seen
    np.testing.assert_array_equal(p, NOW.positions)
    np.testing.assert_array_equal(v, NOW.velocity)
    assert t == 7 * DT
    np.testing.assert_array_equal(stated.external_force, SCENE.constant_force + 2.0)


def test_filters_change_the_velocity_before_inertia_and_forces_see_it():
    seen = []

    def force(p, v, t):
        seen.append(v.copy())
        return 0.0 * p

    made = replace(
        SCENE, varying_forces=(force,), velocity_filters=(lambda v: 0.5 * v, lambda v: v + np.array([1.0, 0.0, 0.0]))
    )
    stated = build_problem(made, STATE, "previous")
    expected = 0.5 * NOW.velocity + [1.0, 0.0, 0.0]  # in the order of the effects
    np.testing.assert_allclose(stated.inertial_target, NOW.positions + DT * expected, rtol=1e-14)
    np.testing.assert_allclose(seen[0], expected, rtol=1e-14)


def test_each_step_starts_from_the_two_before_it():
    prepared, rule = ShiftingSolver(), StopRule(9, 0.1)
    done = list(simulate_scene(SCENE, prepared, rule, initial_guess="assignment", frames=3))
    assert [step.index for step in done] == [1, 2, 3]
    rest = SCENE.mesh.rest_positions
    for k, (stated, stop) in enumerate(prepared.asked):
        np.testing.assert_allclose(stated.initial_guess, rest + k, rtol=1e-15)
        moved = np.array(VELOCITY) * DT if k == 0 else 1.0
        np.testing.assert_allclose(stated.inertial_target, rest + k + moved, rtol=0, atol=1e-14)
        assert stop == rule
    assert all(step.problem is stated for step, (stated, _) in zip(done, prepared.asked, strict=True))


class Slow(ShiftingSolver):
    """It sleeps while it solves."""

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        began = perf_counter()
        sleep(0.005)
        self.slept = perf_counter() - began
        return super().solve(problem, stop)


def test_the_seconds_of_a_step_include_its_solve_and_nothing_between_steps():
    prepared, clock = Slow(), Stopwatch(PhaseWatch())
    run = iterate_steps(SCENE, prepared, SteppingSettings(StopRule(), "previous", 3, 1), clock)
    for _ in range(3):
        began = perf_counter()
        next(run)
        around = perf_counter() - began
        assert prepared.slept <= clock.seconds <= around  # intervals on one clock, each within the next
        sleep(0.01)


def test_steps_are_done_only_on_request():
    prepared = ShiftingSolver()
    run = simulate_scene(SCENE, prepared, StopRule(), initial_guess="previous", frames=1000)
    next(run)
    assert len(prepared.asked) == 1


def test_a_simulation_can_be_repeated_to_the_last_bit():
    made = SCENE_BUILDERS["cloth"](1e10)
    one, two = (simulate_trajectory(made, LOCAL_GLOBAL_BACKENDS[2], 5) for _ in range(2))
    np.testing.assert_array_equal(one, two)


@pytest.mark.parametrize("rate", [0.5, 20.0])
def test_ether_drag_slows_a_free_particle_exponentially(rate):
    made = build_test_scene(ChainMesh(), EtherDragEffect(decay_rate=rate), size=2, velocity=VELOCITY, time_step=DT)
    p = simulate_trajectory(made, LOCAL_GLOBAL_BACKENDS[0], 12)
    moved = np.diff(np.concatenate([made.mesh.rest_positions[None], p]), axis=0)
    decay = np.exp(-rate * DT * np.arange(1, 13))
    expected = DT * decay[:, None, None] * np.tile(VELOCITY, (2, 1))
    np.testing.assert_allclose(moved, expected, rtol=0, atol=1e-14)  # differences of positions of order one


def test_a_force_acts_once_a_step():
    """x_n = f dt^2 n(n+1) / 2m: the closed form of implicit Euler under a constant force."""
    made = build_test_scene(ChainMesh(), ConstantForceEffect(force=(3.0, 0.0, 0.0)), size=2, mass=2.0, time_step=DT)
    p = simulate_trajectory(made, LOCAL_GLOBAL_BACKENDS[1], 10)
    n = np.arange(1, 11)
    expected = made.mesh.rest_positions[:, 0] + (3.0 * DT**2 * n * (n + 1) / 2)[:, None]
    np.testing.assert_allclose(p[:, :, 0], expected, rtol=1e-13)
