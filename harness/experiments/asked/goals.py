"""Time for the same error, side by side: the cheapest way that is known now, and what it is held against.

Both are done one after the other in one process on one core, told by processor time, preparing included: its least of
some rounds. What is held against it are a peer, or steps of one length, which are shortened by the square root of two
until their end errs by no more than was asked, for each integrator, solver and tolerance; the cheapest of those counts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product
from math import inf, sqrt
from time import thread_time

import numpy as np

from harness.base.errors import RunFailed
from harness.config.goals import Goal, Goals
from harness.experiments.asked.peers import peers
from harness.experiments.asked.search import Answer, foresee, search
from harness.experiments.asked.ways import Asked
from harness.simulation.algebraic import Stop, stop_rule
from harness.simulation.step import prepare, simulate
from solvers.problem import NotPositiveDefinite, Solver, Unsupported
from solvers.registry import EVERY, load

ROUNDS = 3
_LONGEST = 20.0
"""Processor seconds that one simulation may take."""
_SHORTENED = 16
"""Times that steps are shortened by the square root of two."""


@dataclass(frozen=True, slots=True)
class Met:
    """A goal as it was found: way and other in words, their errors and processor seconds; reason: why there is none."""

    goal: Goal
    scene: str
    size: int
    vertices: int = 0
    way: str = ""
    estimated: float = inf
    seconds: float = inf
    other: str = ""
    other_error: float = inf
    other_seconds: float = inf
    reason: str = ""

    @property
    def ratio(self) -> float:
        """Of its processor time to the other's."""
        return self.seconds / self.other_seconds

    @property
    def holds(self) -> bool:
        """Whether no more than the part that was wanted is needed."""
        return not self.reason and self.ratio <= self.goal.wanted


@dataclass(frozen=True, slots=True)
class _Other:
    """What a goal is held against: its name, its error, its least processor seconds."""

    name: str
    error: float
    seconds: float


def met(goals: Goals, say: Callable[[str], None]) -> Iterator[Met]:
    """Each goal in turn; what cannot be measured is told by its reason."""
    for goal, name, size in goals.goals:
        say(f"{name} {size or ''} to {goal.error:g} after {goal.horizon:g} s:")
        asked = None
        try:
            asked = Asked.of(goals.scenes[name], size, goal.horizon)
            yield _met(goal, name, asked, say)
        except (RunFailed, Unsupported, NotPositiveDefinite) as error:
            yield Met(goal, name, asked.size if asked else size or 0, reason=str(error))


def _met(goal: Goal, name: str, asked: Asked, say: Callable[[str], None]) -> Met:
    answer = search(asked, goal.error, foresee(asked, goal.error, say), say)
    best = answer.best
    other = _peer(goal, asked, answer) if goal.peer else _steps(goal, asked, answer, say)
    ours = min(_timed(best.again) for _ in range(ROUNDS))
    return Met(
        *(goal, name, asked.size, best.path.positions.shape[1], str(best.way), best.estimated, ours),
        *(other.name, other.error, other.seconds),
    )


def _peer(goal: Goal, asked: Asked, answer: Answer) -> _Other:
    (peer,) = peers(asked, goal.error, answer, [goal.peer or ""])
    if peer.reason:
        raise RunFailed(f"{peer.name}: {peer.reason}")
    return _Other(peer.name, peer.estimated, peer.processor)


def _steps(goal: Goal, asked: Asked, answer: Answer, say: Callable[[str], None]) -> _Other:
    """The cheapest of steps of one length that keep to the error. Raises RunFailed where none do."""
    best, again = _Other("", inf, inf), None
    for integrator, solver, tolerance in product(goal.integrator or (), goal.solver, goal.tolerance):
        stop = stop_rule(goal.iterations, tolerance)
        for k in range(_SHORTENED):
            frames = round(asked.frames * sqrt(2.0) ** k)
            limit = min(_LONGEST, 1.5 * best.seconds)
            try:
                error, seconds = _run(asked, answer, integrator, solver, stop, frames, limit)
            except (RunFailed, Unsupported, NotPositiveDefinite):
                break
            if seconds > limit:
                break
            if error <= goal.error:
                if seconds < best.seconds:
                    ended = f"tolerance {tolerance:g}" if tolerance else f"{goal.iterations} iterations"
                    best = _Other(f"{integrator} with {solver}, {frames} steps, {ended}", error, seconds)
                    again = integrator, solver, stop, frames
                break
    if again is None:
        raise RunFailed(f"no steps of one length keep to the error within {_LONGEST:g} s of processor time")
    say(f"  held against {best.name}")
    least = min(_run(asked, answer, *again, inf)[1] for _ in range(ROUNDS))
    return _Other(best.name, best.error, least)


def _run(
    asked: Asked, answer: Answer, integrator: str, solver: str, stop: Stop, frames: int, limit: float
) -> tuple[float, float]:
    """The error of the end and the processor seconds of a simulation, which ends early beyond a limit."""
    scene = asked.bound(asked.horizon / frames, integrator)
    made: Solver = load(EVERY[solver])()
    guess = asked.scene.guess(integrator)
    warm = simulate(scene, prepare(scene, made), stop, first_guess=guess, frames=1)
    next(warm)  # compiles
    began, p = thread_time(), scene.mesh.rest
    for step in simulate(scene, prepare(scene, made), stop, first_guess=guess, frames=frames):
        p = step.positions
        if thread_time() - began > limit or not np.isfinite(p).all():
            return inf, inf
    return answer.error(p, scene.system.free), thread_time() - began


def _timed(call: Callable[[], object]) -> float:
    began = thread_time()
    call()
    return thread_time() - began
