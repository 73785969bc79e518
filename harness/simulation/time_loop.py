"""Time loop: an integrator builds each step's problem, and a prepared solver minimises it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from springbench.harness.errors import InputError
from springbench.harness.scenes.scene_builder import MIN_COARSENING_SIZE, Scene
from springbench.harness.simulation.auto_tolerance import ConstantStopRule, LocalErrorStopRule, StopCriterion
from springbench.harness.simulation.nested_iteration import CoarseLevel
from springbench.harness.simulation.step_stages import GuessFunction, StageSequence, require_masses
from springbench.solvers.contact.lagged_friction import FrictionConvergence, solve_with_friction
from springbench.solvers.contact.obstacle_advancement import intersection_free_guess
from springbench.solvers.iteration.iterative_solver import EXACT_LENGTHS_UNSUPPORTED
from springbench.solvers.model.integrators import IMPLICIT_EULER, Motion, SingleStageIntegrator
from springbench.solvers.model.step_problem import (
    Positions,
    PreparedSolver,
    Solution,
    Solver,
    StepProblem,
    StepStart,
    StopRule,
    System,
    Unsupported,
)
from springbench.solvers.registry import SOLVERS, find_solver_name, load_target


@dataclass(frozen=True, slots=True, eq=False)
class MotionState:
    """State between two steps.

    Attributes:
        motion: motion at the start of the next step.
        previous_motion: motion one step earlier, filtered; None where there is none.
        index: index of the last step, 0 at the start.
        acceleration: acceleration (n, 3) [m/s^2] at `motion`, None where it is unknown.
        warm_start: warm-start data of the last step's solution.
    """

    motion: Motion
    previous_motion: Motion | None
    index: int
    acceleration: Positions | None = None
    warm_start: NDArray[np.float64] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class SimulationStep:
    """A completed step.

    Attributes:
        problem: step problem; that of the last stage in a step of several stages.
        solution: its solution.
        state: state after the step.
        iteration_counts: number of iterations of each solve.
        stages: problem and solution of each stage, in order.
        stop_rule: stop rule of each solve.
        friction_rounds: friction rounds of the step.
        local_error: error of the motion by an embedded method, None without one.
    """

    problem: StepProblem
    solution: Solution
    state: MotionState
    iteration_counts: tuple[int, ...]
    stages: tuple[tuple[StepProblem, Solution], ...]
    stop_rule: StopRule
    friction_rounds: FrictionConvergence | None = None
    local_error: Motion | None = None

    @property
    def num_iterations(self) -> int:
        """The total number of iterations of all solves."""
        return sum(self.iteration_counts)

    @property
    def index(self) -> int:
        """The number of the step, counted from 1."""
        return self.state.index

    @property
    def positions(self) -> Positions:
        """The positions (n, 3) [m] after the step.

        They differ from a solution at the middle of the step.
        """
        return self.state.motion.positions


def build_initial_state(scene: Scene) -> MotionState:
    """Build the scene's initial state, with its velocity and its spin."""
    p = scene.start.compute_positions(scene.mesh.rest_positions)
    return MotionState(Motion(p, scene.initial_velocity + scene.start.compute_spin_velocity(p)), None, 0)


def build_problem(scene: Scene, state: MotionState, initial_guess: str) -> StepProblem:
    """Build the problem of the next step, or of its first stage.

    Args:
        scene: scene that is stepped.
        state: state at the start of the step.
        initial_guess: a key of `INITIAL_GUESSES`, or COARSE_TO_FINE, which solves the step on a coarser mesh.

    Raises:
        Unsupported: there is no coarser mesh.
    """
    usual = scene.integrator
    if not isinstance(usual, SingleStageIntegrator):
        return _select_stage_guess(initial_guess)(_build_stages(scene, state).build_first_problem())
    scene, time = scene.find_step_scene(state.index), scene.compute_time(state.index)
    dt = scene.system.time_step
    # The previous motion was filtered when it was the current one. The second filtering makes it decay for as long as
    # the current one (an integrating factor); without that, BDF2 would decay at twice the rate.
    now = before = _filter_velocity(scene, state.motion)
    a, is_extrapolated = usual.extrapolation_fraction, initial_guess == "extrapolated"
    if state.previous_motion and (usual.needs_history or is_extrapolated or (a and scene.varying_forces)):
        before = _filter_velocity(scene, state.previous_motion)
    starts = usual.needs_history and state.previous_motion is None
    method, system = (IMPLICIT_EULER, _build_first_system(scene)) if starts else (usual, scene.system)
    target, origin = method.predict_target(now, before, dt)
    when, ahead = time + method.stage_fraction * dt, method.extrapolation_fraction * dt
    led = (now.velocity - before.velocity) / dt if is_extrapolated and state.previous_motion else None
    begun = StepStart(
        now.positions,
        now.velocity,
        time,
        origin,
        system.velocity_rate,
        when,
        ahead,
        predicted_acceleration=led,
        warm_start=state.warm_start,
    )
    force = scene.constant_force
    if scene.varying_forces:
        a = method.extrapolation_fraction
        p, v = (x + a * (x - y) for x, y in zip(now, before, strict=True)) if a and state.previous_motion else now
        for effect in scene.varying_forces:
            force = force + effect(p, v, time + a * dt)
    pin_targets = scene.compute_pin_targets(time + dt)
    if method.stage_fraction < 1.0:
        pin_targets = now.positions[system.pins.vertices] + method.stage_fraction * (
            pin_targets - now.positions[system.pins.vertices]
        )
    current = _place_pins(system, now.positions, pin_targets)
    stated = StepProblem(system, target, force, pin_targets, current, current, begun)
    guessed = (
        _guess_coarse_to_fine(scene, state, stated)
        if initial_guess == COARSE_TO_FINE
        else INITIAL_GUESSES[initial_guess](stated)
    )
    return intersection_free_guess(guessed)


def build_integrated_step(problem: StepProblem, state: MotionState) -> SimulationStep:
    """Build the step of a solver that integrated a frame itself.

    Args:
        problem: problem of the frame.
        state: state after the frame; its positions and velocity become the solution, of one iteration.
    """
    solution = Solution(state.motion.positions, 1, np.nan, np.nan, "max-iter", state.motion.velocity)
    return SimulationStep(problem, solution, state, (1,), ((problem, solution),), StopRule(1))


def prepare(scene: Scene, solver: Solver) -> PreparedSolver:
    """Prepare the solver for all of the scene's steps.

    Args:
        scene: scene that is stepped, with one system or two.
        solver: solver of the steps.

    Returns:
        The prepared solver; an `AlternatingSolver` for two systems.

    Raises:
        Unsupported: the scene alternates step sizes with a multistep integrator, the integrator needs masses that are
            zero, or the solver does not support exact lengths; also as `solver.prepare` raises.
    """
    require_masses(scene)
    if scene.system.length_constraints and not getattr(solver, "supports_length_constraints", False):
        raise Unsupported(f"{find_solver_name(solver)}: {EXACT_LENGTHS_UNSUPPORTED}")
    history, alternate = (
        isinstance(scene.integrator, SingleStageIntegrator) and scene.integrator.needs_history,
        scene.alternate_scene,
    )
    if history and alternate:
        raise Unsupported(
            "the integrator requires a constant step size, and the scene alternates two; use implicit-euler"
        )
    prepared, other = solver.prepare(scene.system), alternate.system if alternate else _build_first_system(scene)
    return AlternatingSolver(prepared, solver.prepare(other), other.velocity_rate) if history or alternate else prepared


def simulate_scene(
    scene: Scene,
    prepared: PreparedSolver,
    stop: StopCriterion,
    *,
    initial_guess: str,
    frames: int,
    initial_state: MotionState | None = None,
) -> Iterator[SimulationStep]:
    """Iterate over the steps from a state up to a frame, each computed on demand.

    Args:
        scene: scene that is stepped.
        prepared: result of `prepare`.
        stop: stop criterion of the solves.
        initial_guess: name of the initial guess.
        frames: number of the last step.
        initial_state: state to start from; the scene's start if omitted.

    Raises:
        Unsupported: the automatic tolerance does not support the scene.
    """
    initial_state = initial_state or build_initial_state(scene)
    step = _step_single_stage if isinstance(scene.integrator, SingleStageIntegrator) else _step_stages
    rules = (
        ConstantStopRule(stop)
        if isinstance(stop, StopRule)
        else LocalErrorStopRule(stop, scene, initial_state.motion, frames)
    )
    while initial_state.index < frames:
        done = step(scene, prepared, rules.rule, initial_guess, initial_state)
        initial_state = done.state
        rules.record_step(initial_state.motion, done.local_error)
        yield done


def _step_single_stage(
    scene: Scene, prepared: PreparedSolver, stop: StopRule, initial_guess: str, state: MotionState
) -> SimulationStep:
    """Take a step of an integrator with one stage."""
    stated = build_problem(scene, state, initial_guess)
    solved = solve_with_friction(prepared, stated, stop)
    stated, solution = solved.problem, solved.solution
    usual = scene.integrator
    assert isinstance(usual, SingleStageIntegrator)
    method = IMPLICIT_EULER if usual.needs_history and state.previous_motion is None else usual
    before = Motion(stated.step_start.positions, stated.step_start.velocity)
    after = MotionState(
        method.complete_step(stated.step_start, solution), before, state.index + 1, warm_start=solution.warm_start
    )
    return SimulationStep(
        stated, solution, after, solved.iteration_counts, ((stated, solution),), stop, solved.convergence
    )


def _step_stages(
    scene: Scene, prepared: PreparedSolver, stop: StopRule, initial_guess: str, state: MotionState
) -> SimulationStep:
    """Take a step of an integrator with several stages."""
    begun = _build_stages(scene, state)
    done = begun.solve_stages(prepared, stop, _select_stage_guess(initial_guess))
    after = MotionState(done.end.motion, begun.now, state.index + 1, done.end.acceleration)
    return SimulationStep(
        *done.stages[-1], after, done.iteration_counts, done.stages, stop, done.friction_rounds, done.end.error
    )


def _build_stages(scene: Scene, state: MotionState) -> StageSequence:
    of = scene.find_step_scene(state.index)
    return StageSequence(of, _filter_velocity(of, state.motion), state.acceleration, scene.compute_time(state.index))


class AlternatingSolver:
    """A solver prepared for two systems of one scene that differ in their rate."""

    def __init__(self, usual: PreparedSolver, other: PreparedSolver, rate: float) -> None:
        """Combine two prepared solvers.

        Args:
            usual: solver prepared for the scene's own system.
            other: solver prepared for the other system, that of the first step or of every second one.
            rate: velocity rate [1/s] of the other system, by which its problems are recognised.
        """
        self.usual, self.other, self._rate = usual, other, rate
        self.description, self.stats = usual.description, usual.stats

    def select_solver(self, problem: StepProblem) -> PreparedSolver:
        """Return the solver that is prepared for the problem."""
        return self.other if problem.system.velocity_rate == self._rate else self.usual

    def iterates(self, problem: StepProblem) -> Iterator[Positions]:
        """Return the iterates of the solver that is prepared for the problem."""
        return self.select_solver(problem).iterates(problem)

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        """Solve a problem with the solver that is prepared for it.

        Args:
            problem: step problem of one of the two systems.
            stop: stop rule of the solve.
        """
        return self.select_solver(problem).solve(problem, stop)

    def residual_at(self, problem: StepProblem, p: Positions) -> float:
        """Return the residual [J^(1/2)] by the solver that is prepared for the problem.

        Args:
            problem: step problem of one of the two systems.
            p: positions (n, 3) [m].
        """
        return self.select_solver(problem).residual_at(problem, p)

    def iteration_phases(self, problem: StepProblem) -> dict[str, Callable[[], object]]:
        """Return the phases of an iteration of the solver that is prepared for the problem."""
        return self.select_solver(problem).iteration_phases(problem)


def _filter_velocity(scene: Scene, motion: Motion) -> Motion:
    if not scene.velocity_filters:
        return motion
    p, v = motion
    for velocity_filter in scene.velocity_filters:
        v = velocity_filter(v)
    return Motion(p, v)


def _build_first_system(scene: Scene) -> System:
    """Build the system of the first step of an integrator that needs a history."""
    return replace(scene.system, inertia_factor=IMPLICIT_EULER.inertia_factor)


def _place_pins(system: System, p: Positions, targets: Positions) -> Positions:
    """Return a copy of p with its pinned vertices at their targets."""
    placed = p.copy()
    placed[system.pins.vertices] = targets
    return placed


def _guess_assignment(step_problem: StepProblem) -> StepProblem:
    """Guess the positions at the start of the step.

    Pinned vertices are not moved to their targets.
    """
    return replace(step_problem, initial_guess=step_problem.step_start.positions)


def _guess_previous(step_problem: StepProblem) -> StepProblem:
    return step_problem


def _guess_inertial(step_problem: StepProblem) -> StepProblem:
    """Guess the inertial motion of the vertices (Liu et al. 2013)."""
    return replace(
        step_problem,
        initial_guess=_place_pins(step_problem.system, step_problem.inertial_target, step_problem.pin_targets),
    )


def _guess_extrapolated(step_problem: StepProblem) -> StepProblem:
    """Guess by extrapolation with the current velocity and the last acceleration."""
    if step_problem.step_start.predicted_acceleration is None:
        return _guess_inertial(step_problem)
    led = (
        step_problem.inertial_target
        + step_problem.system.time_step**2
        / step_problem.system.inertia_factor
        * step_problem.step_start.predicted_acceleration
    )
    return replace(step_problem, initial_guess=_place_pins(step_problem.system, led, step_problem.pin_targets))


INITIAL_GUESSES: dict[str, Callable[[StepProblem], StepProblem]] = {
    "assignment": _guess_assignment,
    "previous": _guess_previous,
    "inertial": _guess_inertial,
    "extrapolated": _guess_extrapolated,
}


def apply_initial_guess(step_problem: StepProblem, initial_guess: str) -> StepProblem:
    """Set an initial guess by name, made intersection-free.

    Args:
        step_problem: problem that gets the guess.
        initial_guess: a key of `INITIAL_GUESSES`.

    Raises:
        NoClearance: no intersection-free start was found.
    """
    return intersection_free_guess(INITIAL_GUESSES[initial_guess](step_problem))


COARSE_TO_FINE = "coarse-to-fine"
"""Initial guess that depends on more than the problem: the solution on a coarser mesh."""
COARSE_SOLVER = "hybrid"
"""Solver on coarser meshes, by name, so that runs without this guess do not depend on its code."""

_COARSE_STOP_RULE = StopRule(100, 1e-3)
"""Stop rule of the solves on coarser meshes. The remaining error is smooth, and costs the finer mesh more: with 1e-2,
L-BFGS needs five times the iterations on a stiff cloth of 256 a side."""

_COARSE_LEVELS: WeakKeyDictionary[Scene, CoarseLevel] = WeakKeyDictionary()


def _guess_coarse_to_fine(scene: Scene, state: MotionState, step_problem: StepProblem) -> StepProblem:
    """Guess the displacement of this step by interpolation from a mesh of half the size.

    The coarser solve itself starts from a still coarser one (nested iteration: Kronsjö and Dahlquist 1972). The shape
    of the finer mesh is preserved, since only the displacement is interpolated.
    """
    level = _COARSE_LEVELS.get(scene)
    if level is None:
        if scene.build_coarser is None:
            raise Unsupported(
                "initial_guess: coarse-to-fine needs the scene on a mesh of half the size, and there is none: the mesh "
                f"is from a file, or smaller than {2 * MIN_COARSENING_SIZE - 1}, or effects name vertices by `indices` "
                "or `stride`, or the start is `merged`; take previous, inertial or extrapolated"
            )
        try:
            coarse = scene.build_coarser()
        except InputError as error:
            raise Unsupported(
                f"initial_guess: coarse-to-fine needs the scene on a mesh of half the size: {error}"
            ) from error
        level = _COARSE_LEVELS[scene] = CoarseLevel.from_scenes(
            scene, coarse, prepare(coarse, load_target(SOLVERS[COARSE_SOLVER])())
        )
    there = MotionState(
        level.restrict_motion(state.motion),
        level.restrict_motion(state.previous_motion) if state.previous_motion else None,
        state.index,
    )
    below = build_problem(level.scene, there, COARSE_TO_FINE if level.scene.build_coarser else "previous")
    found = level.prepared.solve(below, _COARSE_STOP_RULE).positions
    guess = step_problem.current_positions + level.prolong_displacement(found - below.current_positions)
    return replace(step_problem, initial_guess=_place_pins(step_problem.system, guess, step_problem.pin_targets))


def _select_stage_guess(initial_guess: str) -> GuessFunction:
    """Return the initial guess of each stage of a step that has several; raises Unsupported."""
    if initial_guess == COARSE_TO_FINE:
        raise Unsupported(
            "initial_guess: coarse-to-fine is for integrators with one stage per step (implicit-euler, bdf2, "
            "midpoint); use extrapolated, previous or inertial"
        )
    return INITIAL_GUESSES[initial_guess]
