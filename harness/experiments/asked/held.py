"""Baselines of performance targets.

A baseline is a third-party integrator, or the cheapest fixed step size for the same error.

Step sizes are divided by sqrt(2) until the error at the end is at most the requested one, for each integrator, solver
and tolerance. The best combination is thus known in hindsight. Where none reaches the error within
`LONGEST`, the baseline is a lower bound of the cost.
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
"""CPU time limit of one simulation [s]."""
_SHORTENED = 40
"""Largest number of divisions of the step size by sqrt(2), by a factor of 10^6 in total; the time limit comes first."""
_PATIENCE = 1.5
"""Time limit of a combination as a multiple of the cheapest time so far."""

Error = Callable[[Positions], float]
"""Function that returns the relative error of end positions (n, 3) [m]."""


@dataclass(frozen=True, slots=True)
class Held:
    """Baseline of a performance target.

    Attributes:
        name: name of the baseline.
        error: its relative error.
        seconds: its CPU time [s].
        bound: whether it misses the error, so that reaching it would take longer.
        again: repeats the simulation and returns its CPU seconds; None where that is not possible.
    """

    name: str
    error: float
    seconds: float
    bound: bool = False
    again: Callable[[], float] | None = None


@dataclass(frozen=True, slots=True)
class _Fixed:
    """Simulation with a fixed step size."""

    integrator: str
    solver: str
    stop: Stop
    ended: str
    frames: int

    def __str__(self) -> str:
        return f"{self.integrator} with {self.solver}, {self.frames} steps{self.ended}"


def held(one: OneGoal, asked: Asked, answer: Answer, error: Error, say: Callable[[str], None]) -> Held:
    """Measure the baseline of a performance target.

    Args:
        one: the target.
        asked: the scene and its end time.
        answer: result of the method search.
        error: returns the error of end positions.
        say: prints a remark.

    Raises:
        RunFailed: no baseline can be measured.
    """
    return _peer(one, asked, answer) if one.goal.peer else _steps(one, asked, error, say)


def _peer(one: OneGoal, asked: Asked, answer: Answer) -> Held:
    (peer,) = peers(asked, one.error, answer, [one.goal.peer or ""])
    if peer.reason:
        raise RunFailed(f"{peer.name}: {peer.reason}")
    return Held(peer.name, peer.estimated, peer.processor)


def _steps(one: OneGoal, asked: Asked, error: Error, say: Callable[[str], None]) -> Held:
    """Return the cheapest fixed step size for the error, or a lower bound.

    The bound is the smallest of those on the cost.
    """
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
    """Return the combinations of integrators, solvers and tolerances.

    Solvers with their own integrator come first, since they are the quickest to run; they are listed once, as `own`.
    """
    alone = {name: about(load(EVERY[name]), name).own_steps for name in goal.solver}
    every = goal.integrator or ()
    own = [("own", solver, None) for solver in goal.solver if alone[solver] and "own" in every]
    others = [name for name in every if name != "own"]
    rest = product(others, (solver for solver in goal.solver if not alone[solver]), goal.tolerance)
    return [*own, *rest]


def _bound(fixed: _Fixed, found: Held, nearest: Held | None) -> Held:
    """Build the lower bound from steps that were still too long at the time limit."""
    reached = f"; {nearest.name} err by {nearest.error:.2g}" if nearest else ""
    name = f"{fixed}, given up after {found.seconds:.3g} s{reached}"
    return Held(name, nearest.error if nearest else inf, found.seconds, bound=True)


def _run(asked: Asked, error: Error, fixed: _Fixed, limit: float) -> Held:
    """Simulate with a fixed step size; the simulation ends early beyond a time limit [s]."""
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
