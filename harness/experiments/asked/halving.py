"""What can be had where no error can be promised: how far a motion still moves when its steps are halved.

    |p_h(T) - p_(h/2)(T)| / |p_(h/2)(T) - p(0)|,    Frobenius norms over the free vertices

by implicit Euler with converged steps, of order 1 as all methods are where contact begins and ends: the error that is
left is about as large.
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
    """The last step that was halved [s], and how far the end moved by that, relative to the motion; None for neither
    within the time allowed."""

    step: float
    moved: float | None

    def __str__(self) -> str:
        if self.moved is None:
            return f"steps of {self.step:.3g} s alone take longer than is spent on saying what can be had"
        return f"what can be had: steps of {self.step:.3g} s end within {self.moved:.1g} of where steps half as long do"


def halved(bound: Callable[[float, str], Scene], horizon: float, frames: int, *, seconds: float) -> Halved:
    """Halve the steps of a motion, frames of which make the horizon [s], for about so many wall seconds.

    bound: the scene with steps of a length [s] and an integrator by name."""
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
    """Where the motion ends; None where the clock passed a time."""
    for step in simulate(scene, prepare(scene, Newton()), _SOLVED, first_guess="current", frames=frames):
        if perf_counter() > until:
            return None
        if step.index == frames:
            return step.positions
    return None
