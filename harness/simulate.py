"""Steps through time: p^t and p^(t-dt) make the step's problem, a prepared solver makes p^(t+dt)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import reduce
from time import perf_counter

import numpy as np

from harness.scene import Scene
from solvers.problem import Positions, Prepared, Solution, StepProblem, StopRule


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """positions p^t (n, 3) [m]; previous p^(t-dt) (n, 3) [m]; index of the last step, 0 at the start."""

    positions: Positions
    previous: Positions
    index: int


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """One step that was done: its index from 1, its problem, its solution, its wall seconds."""

    index: int
    problem: StepProblem
    solution: Solution
    seconds: float


def start(scene: Scene) -> State:
    """The rest shape, moving with the scene's velocity."""
    rest = scene.mesh.rest
    return State(rest, rest - scene.system.time_step * np.array(scene.velocity), 0)


def problem(scene: Scene, state: State, first_guess: str) -> StepProblem:
    """The next step's problem from a state; `first_guess` is a key of `FIRST_GUESSES`."""
    dt, p = scene.system.time_step, state.positions
    target = p - state.previous
    if scene.filters:
        target = dt * reduce(lambda v, filtered: filtered(v), scene.filters, target / dt)
    force = scene.load
    if scene.forces:
        v = target / dt
        force = reduce(lambda total, effect: total + effect(p, v, state.index * dt), scene.forces, force)
    target += p
    current = _pinned(scene, state.positions)
    stated = StepProblem(scene.system, target, force, scene.pin_targets, current, current)
    return FIRST_GUESSES[first_guess](stated, scene, state)


def simulate(scene: Scene, prepared: Prepared, stop: StopRule, *, first_guess: str, frames: int) -> Iterator[Step]:
    """The scene's first steps, one more each time it is asked; the clock stands still in between."""
    state = start(scene)
    for index in range(1, frames + 1):
        began = perf_counter()
        stated = problem(scene, state, first_guess)
        solution = prepared.solve(stated, stop)
        seconds = perf_counter() - began
        yield Step(index, stated, solution, seconds)
        state = State(solution.positions, state.positions, index)


def _pinned(scene: Scene, p: Positions) -> Positions:
    """A copy of p with its pinned vertices on their targets."""
    placed = p.copy()
    placed[scene.system.pins.vertices] = scene.pin_targets
    return placed


def _assignment(stated: StepProblem, scene: Scene, state: State) -> StepProblem:
    """The current positions as they are, pinned vertices where the penalty left them."""
    return replace(stated, first_guess=state.positions)


def _current(stated: StepProblem, scene: Scene, state: State) -> StepProblem:
    return stated


def _inertial(stated: StepProblem, scene: Scene, state: State) -> StepProblem:
    """Where the vertices would go by inertia alone (Liu et al. 2013)."""
    return replace(stated, first_guess=_pinned(scene, stated.target))


FIRST_GUESSES: dict[str, Callable[[StepProblem, Scene, State], StepProblem]] = {
    "assignment": _assignment,
    "current": _current,
    "inertial": _inertial,
}
