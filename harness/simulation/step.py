"""Time loop: an integrator builds each step's problem, and a prepared solver minimises it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import reduce
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from harness.base.errors import InputError
from harness.scenes.bind import COARSEST, Scene
from harness.simulation.algebraic import LocalErrors, Stated, Stop
from harness.simulation.coarser import Coarser
from harness.simulation.stages import Guess, Stages, require_mass
from solvers.contact.friction_rounds import FrictionRounds, solve_with_friction
from solvers.core.clearing import begun_free
from solvers.core.driver import EXACT
from solvers.integrators import IMPLICIT_EULER, Integrator, Motion
from solvers.problem import Positions, Prepared, Solution, Solver, Start, StepProblem, StopRule, System, Unsupported
from solvers.registry import SOLVERS, load, name_of


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """State between two steps.

    Attributes:
      now: motion at the start of the next step.
      before: motion one step earlier, filtered; None where there is none.
      index: index of the last step, 0 at the start.
      acceleration: acceleration (n, 3) [m/s^2] at `now`, None where it is unknown.
      kept: warm-start data of the last step's solution.
    """

    now: Motion
    before: Motion | None
    index: int
    acceleration: Positions | None = None
    kept: NDArray[np.float64] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """A completed step.

    Attributes:
      problem: step problem; that of the last stage in a step of several stages.
      solution: its solution.
      state: state after the step.
      counts: number of iterations of each solve.
      stages: problem and solution of each stage, in order.
      stop: stop rule of each solve.
      friction: friction rounds of the step.
      error: error of the motion by an embedded method, None without one.
    """

    problem: StepProblem
    solution: Solution
    state: State
    counts: tuple[int, ...]
    stages: tuple[tuple[StepProblem, Solution], ...]
    stop: StopRule
    friction: FrictionRounds | None = None
    error: Motion | None = None

    @property
    def iterations(self) -> int:
        """The total number of iterations of all solves."""
        return sum(self.counts)

    @property
    def index(self) -> int:
        """The number of the step, counted from 1."""
        return self.state.index

    @property
    def positions(self) -> Positions:
        """The positions (n, 3) [m] after the step.

        They differ from a solution at the middle of the step.
        """
        return self.state.now.positions


def start(scene: Scene) -> State:
    """Build the scene's initial state, with its velocity and its spin."""
    p = scene.start.positions(scene.mesh.rest)
    return State(Motion(p, scene.velocity + scene.start.velocity(p)), None, 0)


def problem(scene: Scene, state: State, first_guess: str) -> StepProblem:
    """Build the problem of the next step, or of its first stage.

    Args:
      scene: scene that is stepped.
      state: state at the start of the step.
      first_guess: a key of `FIRST_GUESSES`, or COARSE, which solves the step on a coarser mesh.

    Raises:
      Unsupported: there is no coarser mesh.
    """
    usual = scene.integrator
    if not isinstance(usual, Integrator):
        return _of_stages(first_guess)(_stages(scene, state).first())
    scene, time = scene.at(state.index), scene.time(state.index)
    dt = scene.system.time_step
    # The previous motion was filtered when it was the current one. The second filtering makes it decay for as long as
    # the current one (an integrating factor); without that, BDF2 would decay at twice the rate.
    now, before = (_filtered(scene, motion) for motion in (state.now, state.before or state.now))
    starts = usual.history and state.before is None
    method, system = (IMPLICIT_EULER, _first(scene)) if starts else (usual, scene.system)
    target, origin = method.predict(now, before, dt)
    when, ahead = time + method.when * dt, method.ahead * dt
    led = (now.velocity - before.velocity) / dt if first_guess == "motion" and state.before else None
    begun = Start(
        now.positions, now.velocity, time, origin, system.rate, when, ahead, acceleration=led, kept=state.kept
    )
    force = scene.load
    if scene.forces:
        a = method.ahead
        p, v = (x + a * (x - y) for x, y in zip(now, before, strict=True)) if a and state.before else now
        force = reduce(lambda total, effect: total + effect(p, v, time + a * dt), scene.forces, force)
    held = scene.pins_at(time + dt)
    if method.when < 1.0:
        held = now.positions[system.pins.vertices] + method.when * (held - now.positions[system.pins.vertices])
    current = _pinned(system, now.positions, held)
    stated = StepProblem(system, target, force, held, current, current, begun)
    guessed = _coarse(scene, state, stated) if first_guess == COARSE else FIRST_GUESSES[first_guess](stated)
    return begun_free(guessed)


def prepare(scene: Scene, solver: Solver) -> Prepared:
    """Prepare the solver for all of the scene's steps.

    Raises:
      Unsupported: the scene alternates step sizes with a multistep integrator, the integrator needs masses that are
        zero, or the solver does not support exact lengths; also as `solver.prepare` raises.
    """
    require_mass(scene)
    if scene.system.lengths and not getattr(solver, "keeps_lengths", False):
        raise Unsupported(f"{name_of(solver)}: {EXACT}")
    history, alternate = isinstance(scene.integrator, Integrator) and scene.integrator.history, scene.alternate
    if history and alternate:
        raise Unsupported("the integrator's formula holds for steps of one length, and the scene alternates two")
    prepared, other = solver.prepare(scene.system), alternate.system if alternate else _first(scene)
    return Turns(prepared, solver.prepare(other), other.rate) if history or alternate else prepared


def simulate(
    scene: Scene, prepared: Prepared, stop: Stop, *, first_guess: str, frames: int, state: State | None = None
) -> Iterator[Step]:
    """Iterate over the steps from a state up to a frame, each computed on demand.

    Args:
      scene: scene that is stepped.
      prepared: result of `prepare`.
      stop: stop criterion of the solves.
      first_guess: name of the initial guess.
      frames: number of the last step.
      state: state to start from; the scene's start if omitted.

    Raises:
      Unsupported: the automatic tolerance does not support the scene.
    """
    state = state or start(scene)
    step = _single if isinstance(scene.integrator, Integrator) else _staged
    rules = Stated(stop) if isinstance(stop, StopRule) else LocalErrors(stop, scene, state.now, frames)
    while state.index < frames:
        done = step(scene, prepared, rules.rule, first_guess, state)
        state = done.state
        rules.done(state.now, done.error)
        yield done


def _single(scene: Scene, prepared: Prepared, stop: StopRule, first_guess: str, state: State) -> Step:
    """Take a step of an integrator with one stage."""
    stated = problem(scene, state, first_guess)
    solved = solve_with_friction(prepared, stated, stop)
    stated, solution = solved.problem, solved.solution
    usual = scene.integrator
    assert isinstance(usual, Integrator)
    method = IMPLICIT_EULER if usual.history and state.before is None else usual
    before = Motion(stated.start.positions, stated.start.velocity)
    after = State(method.advance(stated.start, solution), before, state.index + 1, kept=solution.kept)
    return Step(stated, solution, after, solved.counts, ((stated, solution),), stop, solved.friction)


def _staged(scene: Scene, prepared: Prepared, stop: StopRule, first_guess: str, state: State) -> Step:
    """Take a step of an integrator with several stages."""
    begun = _stages(scene, state)
    done = begun.done(prepared, stop, _of_stages(first_guess))
    after = State(done.end.motion, begun.now, state.index + 1, done.end.acceleration)
    return Step(*done.stages[-1], after, done.counts, done.stages, stop, done.friction, done.end.error)


def _stages(scene: Scene, state: State) -> Stages:
    of = scene.at(state.index)
    return Stages(of, _filtered(of, state.now), state.acceleration, scene.time(state.index))


class Turns:
    """A solver prepared for two systems of one scene that differ in their rate."""

    def __init__(self, usual: Prepared, other: Prepared, rate: float) -> None:
        """Combine two prepared solvers; `rate` [1/s] is that of the other system."""
        self.usual, self.other, self._rate = usual, other, rate
        self.choice, self.facts = usual.choice, usual.facts

    def of(self, problem: StepProblem) -> Prepared:
        """Return the solver that is prepared for the problem."""
        return self.other if problem.system.rate == self._rate else self.usual

    def iterates(self, problem: StepProblem) -> Iterator[Positions]:
        return self.of(problem).iterates(problem)

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        return self.of(problem).solve(problem, stop)

    def residual_at(self, problem: StepProblem, p: Positions) -> float:
        return self.of(problem).residual_at(problem, p)

    def phases(self, problem: StepProblem) -> dict[str, Callable[[], object]]:
        return self.of(problem).phases(problem)


def _filtered(scene: Scene, motion: Motion) -> Motion:
    return Motion(motion.positions, reduce(lambda v, filtered: filtered(v), scene.filters, motion.velocity))


def _first(scene: Scene) -> System:
    """Build the system of the first step of an integrator that needs a history."""
    return replace(scene.system, factor=IMPLICIT_EULER.factor)


def _pinned(system: System, p: Positions, targets: Positions) -> Positions:
    """Return a copy of p with its pinned vertices at their targets."""
    placed = p.copy()
    placed[system.pins.vertices] = targets
    return placed


def _assignment(stated: StepProblem) -> StepProblem:
    """Guess the current positions unchanged, with pinned vertices where the penalty left them."""
    return replace(stated, first_guess=stated.start.positions)


def _current(stated: StepProblem) -> StepProblem:
    return stated


def _inertial(stated: StepProblem) -> StepProblem:
    """Guess the inertial motion of the vertices (Liu et al. 2013)."""
    return replace(stated, first_guess=_pinned(stated.system, stated.target, stated.pin_targets))


def _motion(stated: StepProblem) -> StepProblem:
    """Guess by extrapolation with the current velocity and the last acceleration."""
    if stated.start.acceleration is None:
        return _inertial(stated)
    led = stated.target + stated.system.time_step**2 / stated.system.factor * stated.start.acceleration
    return replace(stated, first_guess=_pinned(stated.system, led, stated.pin_targets))


FIRST_GUESSES: dict[str, Callable[[StepProblem], StepProblem]] = {
    "assignment": _assignment,
    "current": _current,
    "inertial": _inertial,
    "motion": _motion,
}


def guessed(stated: StepProblem, first_guess: str) -> StepProblem:
    """Set an initial guess by name, made intersection-free.

    It raises what `solvers.core.clearing.begun_free` raises.
    """
    return begun_free(FIRST_GUESSES[first_guess](stated))


COARSE = "coarse"
"""Initial guess that depends on more than the problem: the solution on a coarser mesh."""
COARSE_BY = "hybrid"
"""Solver on coarser meshes, by name, so that runs without this guess do not depend on its code."""

_NEAR_ENOUGH = StopRule(100, 1e-3)
"""Stop rule of the solves on coarser meshes. The remaining error is smooth, and costs the finer mesh more: with 1e-2,
L-BFGS needs five times the iterations on a stiff cloth of 256 a side."""

_COARSER: WeakKeyDictionary[Scene, Coarser] = WeakKeyDictionary()


def _coarse(scene: Scene, state: State, stated: StepProblem) -> StepProblem:
    """Guess the displacement of this step on a mesh of half the size, interpolated.

    The coarser solve itself starts from a still coarser one (nested iteration: Kronsjö and Dahlquist 1972). The shape
    of the finer mesh is preserved, since only the displacement is interpolated.
    """
    level = _COARSER.get(scene)
    if level is None:
        if scene.halved is None:
            raise Unsupported(
                "first_guess: coarse needs the scene on a mesh of half the size, and there is none: the mesh is from a "
                f"file, or smaller than {2 * COARSEST - 1}, or effects name vertices by `indices` or `every`; take "
                "current, inertial or motion"
            )
        try:
            coarse = scene.halved()
        except InputError as error:
            raise Unsupported(f"first_guess: coarse needs the scene on a mesh of half the size: {error}") from error
        level = _COARSER[scene] = Coarser.of(scene, coarse, prepare(coarse, load(SOLVERS[COARSE_BY])()))
    there = State(level.down(state.now), level.down(state.before) if state.before else None, state.index)
    below = problem(level.scene, there, COARSE if level.scene.halved else "current")
    found = level.prepared.solve(below, _NEAR_ENOUGH).positions
    guess = stated.current + level.up(found - below.current)
    return replace(stated, first_guess=_pinned(stated.system, guess, stated.pin_targets))


def _of_stages(first_guess: str) -> Guess:
    """Return the initial guess of each stage of a step that has several; raises Unsupported."""
    if first_guess == COARSE:
        raise Unsupported(
            "first_guess: coarse is for integrators with one stage per step (implicit-euler, bdf2, midpoint); "
            "use motion, current or inertial"
        )
    return FIRST_GUESSES[first_guess]
