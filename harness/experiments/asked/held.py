"""What goals are held against: a peer, or the cheapest steps of one length that keep to an error, known in hindsight.

Steps are shortened by the square root of two until their end errs by no more than was asked, for each integrator,
solver and tolerance. Where none of them gets there within `LONGEST`, what they cost at the least is told.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product
from math import inf, sqrt
from time import thread_time

import numpy as np

from harness.base.errors import RunFailed
from harness.config.goals import Goal, OneGoal
from harness.experiments.asked.peers import peers
from harness.experiments.asked.search import Answer
from harness.experiments.asked.ways import Asked
from harness.simulation.algebraic import Stop, stop_rule
from harness.simulation.step import prepare, simulate
from solvers.problem import NotPositiveDefinite, Positions, Solver, Unsupported
from solvers.registry import EVERY, about, load

LONGEST = 20.0
"""Processor seconds that one simulation may take."""
_SHORTENED = 40
"""Times that steps are shortened by the square root of two, a million times in all: before that time is over."""
_PATIENCE = 1.5
"""Times the cheapest so far, what another may take."""

Error = Callable[[Positions], float]
"""The relative error of the end (n, 3) [m] of a motion."""


@dataclass(frozen=True, slots=True)
class Held:
    """What a goal is held against: its name, its error, its processor seconds; bound: whether it does not keep to the
    error, and would take longer; again: does it once more, and returns the seconds."""

    name: str
    error: float
    seconds: float
    bound: bool = False
    again: Callable[[], float] | None = None


@dataclass(frozen=True, slots=True)
class _Fixed:
    """Steps of one length."""

    integrator: str
    solver: str
    stop: Stop
    ended: str
    frames: int

    def __str__(self) -> str:
        return f"{self.integrator} with {self.solver}, {self.frames} steps{self.ended}"


def held(one: OneGoal, asked: Asked, answer: Answer, error: Error, say: Callable[[str], None]) -> Held:
    """What a goal names, done. Raises RunFailed where nothing of it can be done."""
    return _peer(one, asked, answer) if one.goal.peer else _steps(one, asked, error, say)


def _peer(one: OneGoal, asked: Asked, answer: Answer) -> Held:
    (peer,) = peers(asked, one.error, answer, [one.goal.peer or ""])
    if peer.reason:
        raise RunFailed(f"{peer.name}: {peer.reason}")
    return Held(peer.name, peer.estimated, peer.processor)


def _steps(one: OneGoal, asked: Asked, error: Error, say: Callable[[str], None]) -> Held:
    """The cheapest of steps of one length that keep to the error, or the least that all cost more than."""
    best, again, bounds = Held("", inf, inf), None, list[Held]()
    for integrator, solver, tolerance in _choices(one.goal):
        limit = min(LONGEST, _PATIENCE * best.seconds)
        stop = stop_rule(one.goal.iterations, tolerance)
        ended = f", tolerance {tolerance:g}" if tolerance else f", {one.goal.iterations} iterations"
        ended = "" if integrator == "own" else ended
        nearest = None
        for k in range(_SHORTENED):
            fixed = _Fixed(integrator, solver, stop, ended, round(asked.frames * sqrt(2.0) ** k))
            try:
                found = _run(asked, error, fixed, limit)
            except (RunFailed, Unsupported, NotPositiveDefinite):
                break
            if found.error <= one.error:
                if found.seconds < best.seconds:
                    best, again = found, fixed
                break
            if found.bound and limit == LONGEST:
                bounds.append(_bound(fixed, found, nearest))
            if found.bound:
                break
            nearest = found
    if again is None:
        if not bounds:
            raise RunFailed(f"no steps of one length keep to the error within {LONGEST:g} s of processor time")
        least = min(bounds, key=lambda bound: bound.seconds)
        say(f"  held against {least.name}")
        return least
    say(f"  held against {best.name}")
    return replace(best, again=lambda: _run(asked, error, again, inf).seconds)


def _choices(goal: Goal) -> list[tuple[str, str, float | None]]:
    """Integrators, solvers and tolerances that go together: solvers with steps of their own come first, once, as `own`;
    they are the quickest to try."""
    alone = {name: about(load(EVERY[name]), name).own_steps for name in goal.solver}
    every = goal.integrator or ()
    own = [("own", solver, None) for solver in goal.solver if alone[solver] and "own" in every]
    others = [name for name in every if name != "own"]
    rest = product(others, (solver for solver in goal.solver if not alone[solver]), goal.tolerance)
    return [*own, *rest]


def _bound(fixed: _Fixed, found: Held, nearest: Held | None) -> Held:
    """Of steps that were still too long when their time was over."""
    reached = f"; {nearest.name} err by {nearest.error:.2g}" if nearest else ""
    name = f"{fixed}, given up after {found.seconds:.3g} s{reached}"
    return Held(name, nearest.error if nearest else inf, found.seconds, bound=True)


def _run(asked: Asked, error: Error, fixed: _Fixed, limit: float) -> Held:
    """A simulation, which ends early beyond a limit [s]."""
    scene = asked.bound(asked.horizon / fixed.frames, fixed.integrator)
    made: Solver = load(EVERY[fixed.solver])()
    guess = asked.scene.guess(fixed.integrator)
    warm = simulate(scene, prepare(scene, made), fixed.stop, first_guess=guess, frames=1)
    next(warm)  # compiles
    began, p = thread_time(), scene.mesh.rest
    for step in simulate(scene, prepare(scene, made), fixed.stop, first_guess=guess, frames=fixed.frames):
        p = step.positions
        if not np.isfinite(p).all():
            break
        if thread_time() - began > limit and step.index < fixed.frames:
            return Held(str(fixed), inf, thread_time() - began, bound=True)
    found = error(p) if np.isfinite(p).all() else inf
    return Held(str(fixed), found, thread_time() - began)
