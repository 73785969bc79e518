"""Estimate the time-stepping error by halving the step, where error control is impossible.

    |p_h(T) - p_(h/2)(T)| / |p_(h/2)(T) - p(0)|,    Frobenius norms over the free vertices

with implicit Euler and converged steps. Its order is 1, as that of all methods is where contact starts and ends.
Therefore the remaining error is about as large as this change.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from time import perf_counter

import numpy as np

from harness.scenes.bind import Scene
from harness.simulation.step import prepare, simulate, start
from solvers.methods.newton import Newton
from solvers.problem import Positions, StopRule

_SOLVED = StopRule(50, 1e-6)


@dataclass(frozen=True, slots=True)
class Halved:
    """Step-doubling estimate.

    Attributes:
        step: last step size that was halved [s].
        moved: change of the end positions by that, relative to the displacement; None if time ran out first.
    """

    step: float
    moved: float | None

    def __str__(self) -> str:
        if self.moved is None:
            return f"steps of {self.step:.3g} s alone take longer than is spent on saying what can be had"
        return f"what can be had: steps of {self.step:.3g} s end within {self.moved:.1g} of where steps half as long do"


def halved(bound: Callable[[float, str], Scene], horizon: float, frames: int, *, seconds: float) -> Halved:
    """Halve the step size within a time budget, and return the last change.

    Args:
        bound: returns the scene for a time step [s] and an integrator by name.
        horizon: simulated time [s].
        frames: number of steps to start with.
        seconds: wall time [s].
    """
    _end(bound(horizon / frames, "implicit-euler"), 1, inf)  # compiles
    began, before, found = perf_counter(), None, Halved(horizon / frames, None)
    while True:
        scene = bound(horizon / frames, "implicit-euler")
        end = _end(scene, frames, began + seconds)
        if end is None:
            return found
        if before is not None:
            free, first = scene.system.free, start(scene).now.positions
            away, moved = (float(np.linalg.norm((end - other)[free])) for other in (before, first))
            found = Halved(2.0 * horizon / frames, away / moved if moved else 0.0)
        before, frames = end, 2 * frames


def _end(scene: Scene, frames: int, until: float) -> Positions | None:
    """Return the positions at the end of the motion; None after the deadline."""
    for step in simulate(scene, prepare(scene, Newton()), _SOLVED, first_guess="current", frames=frames):
        if perf_counter() > until:
            return None
        if step.index == frames:
            return step.positions
    return None
