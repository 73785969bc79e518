"""Steps through time: an integrator makes the step's problem, a prepared solver its minimiser, and that the motion."""

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
    """now, the motion at the start of the next step; before, one step earlier and filtered, None where there is none;
    index of the last step, 0 at the start; acceleration (n, 3) [m/s^2] now, None where it is not known; kept: of the
    last step's solution."""

    now: Motion
    before: Motion | None
    index: int
    acceleration: Positions | None = None
    kept: NDArray[np.float64] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """A step that was done: its problem, its solution, the state after it and the iterations of each of its solves.

    A step of several unknowns has the problem and the solution of the last one; stages: those of all, in their order;
    stop: by which each was solved; friction: how friction was solved; error: of the motion, by an embedded method, None
    without one.
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
        """Of all solves."""
        return sum(self.counts)

    @property
    def index(self) -> int:
        """Counted from 1."""
        return self.state.index

    @property
    def positions(self) -> Positions:
        """Where the vertices are after the step, (n, 3) [m]: not the solution, which may lie in the step's middle."""
        return self.state.now.positions


def start(scene: Scene) -> State:
    """The scene's start, moving with its velocity and its spin."""
    p = scene.start.positions(scene.mesh.rest)
    return State(Motion(p, scene.velocity + scene.start.velocity(p)), None, 0)


def problem(scene: Scene, state: State, first_guess: str) -> StepProblem:
    """The next step's problem from a state, that of its first unknown; `first_guess` is a key of `FIRST_GUESSES`, or
    COARSE, which solves the step on a coarser mesh and raises Unsupported where there is none."""
    usual = scene.integrator
    if not isinstance(usual, Integrator):
        return _of_stages(first_guess)(_stages(scene, state).first())
    scene, time = scene.at(state.index), scene.time(state.index)
    dt = scene.system.time_step
    # `before` was filtered when it was `now`. Filtered once more it has decayed as long as `now` has (an integrating
    # factor); without that, BDF2 would decay at twice the rate.
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
    """The solver, ready for all of the scene's steps; raises what `solver.prepare` raises, and Unsupported where steps
    differ in length and the integrator goes by two of them, where it needs masses that are not there, or where lengths
    are exact and the solver does not keep them."""
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
    """The steps from a state (the scene's start if it is left out), one more each time it is asked, up to the frame
    `frames`. prepared: by `prepare`. Raises Unsupported where a scene cannot be solved to the errors of its steps."""
    state = state or start(scene)
    step = _single if isinstance(scene.integrator, Integrator) else _staged
    rules = Stated(stop) if isinstance(stop, StopRule) else LocalErrors(stop, scene, state.now, frames)
    while state.index < frames:
        done = step(scene, prepared, rules.rule, first_guess, state)
        state = done.state
        rules.done(state.now, done.error)
        yield done


def _single(scene: Scene, prepared: Prepared, stop: StopRule, first_guess: str, state: State) -> Step:
    """The step of an integrator of one unknown."""
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
    """The step of an integrator of several unknowns."""
    begun = _stages(scene, state)
    done = begun.done(prepared, stop, _of_stages(first_guess))
    after = State(done.end.motion, begun.now, state.index + 1, done.end.acceleration)
    return Step(*done.stages[-1], after, done.counts, done.stages, stop, done.friction, done.end.error)


def _stages(scene: Scene, state: State) -> Stages:
    of = scene.at(state.index)
    return Stages(of, _filtered(of, state.now), state.acceleration, scene.time(state.index))


class Turns:
    """Prepared for two systems of one scene, which differ in their rate."""

    def __init__(self, usual: Prepared, other: Prepared, rate: float) -> None:
        """rate: of the other [1/s]."""
        self.usual, self.other, self._rate = usual, other, rate
        self.choice, self.facts = usual.choice, usual.facts

    def of(self, problem: StepProblem) -> Prepared:
        """The one that the problem is for."""
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
    """The system of the first step of an integrator that needs a history."""
    return replace(scene.system, factor=IMPLICIT_EULER.factor)


def _pinned(system: System, p: Positions, targets: Positions) -> Positions:
    """A copy of p with its pinned vertices on their targets."""
    placed = p.copy()
    placed[system.pins.vertices] = targets
    return placed


def _assignment(stated: StepProblem) -> StepProblem:
    """The current positions as they are, pinned vertices where the penalty left them."""
    return replace(stated, first_guess=stated.start.positions)


def _current(stated: StepProblem) -> StepProblem:
    return stated


def _inertial(stated: StepProblem) -> StepProblem:
    """Where the vertices would go by inertia alone (Liu et al. 2013)."""
    return replace(stated, first_guess=_pinned(stated.system, stated.target, stated.pin_targets))


def _motion(stated: StepProblem) -> StepProblem:
    """Where the motion so far leads: by inertia, and by the acceleration that it had last."""
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
    """A problem with one of these first guesses, where that is free of intersections; see
    `solvers.core.clearing.begun_free`, also for what it raises."""
    return begun_free(FIRST_GUESSES[first_guess](stated))


COARSE = "coarse"
"""The first guess that is no function of the problem alone: it is where the coarser mesh goes."""
COARSE_BY = "hybrid"
"""What solves there; by name, so that runs which do not ask for it do not depend on its code."""

_NEAR_ENOUGH = StopRule(100, 1e-3)
"""Of the solves on coarser meshes. What is left there is smooth, and costs the finer mesh more: with 1e-2 L-BFGS takes
five times the iterations on a stiff cloth of 256 a side."""

_COARSER: WeakKeyDictionary[Scene, Coarser] = WeakKeyDictionary()


def _coarse(scene: Scene, state: State, stated: StepProblem) -> StepProblem:
    """Where the same scene on a mesh of half the size goes in this step, which itself starts from a coarser one (nested
    iteration: Kronsjö and Dahlquist 1972); the mesh's own shape is kept beside that displacement."""
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
    """A first guess of each unknown of a step that has several. Raises Unsupported."""
    if first_guess == COARSE:
        raise Unsupported(
            "first_guess: coarse is for integrators of one unknown a step (implicit-euler, bdf2, midpoint); "
            "take motion, current or inertial"
        )
    return FIRST_GUESSES[first_guess]
