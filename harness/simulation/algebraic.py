"""When a step is solved well enough: once what is left of its residual adds little to the step's own local error.

    rate |dp|_M <= |residual|_Q,    |dp|_M + T rate |dp|_M <= PART (|e_p|_M + T |e_v|_M),    T the simulated time

An error dp of the unknown moves the motion by dp now and by T rate dp until its end, as the local errors e_p of the
positions and e_v of the velocities do. Backward differences of the velocity at the ends of steps tell both of the step
before, for an integrator of order q; an embedded method does so too, where it has one, though of the lower order. The
lesser counts:

    e_p = h |D^q v|_M / (q + 1)!,    e_v = |D^(q+1) v|_M / (q + 1)!

What is left of the residuals themselves enters there by a factor of at most PART 2^(q+1)/(q + 1)! <= 0.2 a step: the
noise of one step lets the next have less of it, and none can keep itself alive. The first steps have no past.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from math import factorial

import numpy as np

from harness.scenes.bind import Scene
from solvers.integrators import Motion
from solvers.problem import Positions, StopRule, Unsupported

PART = 0.1
"""Of the local error, what residuals may add to it."""
FIRST = 1e-10
"""The tolerance of the steps that have no past, relative to the residual at their start."""
_NOTHING = 1e-300
"""Residuals [J^(1/2)] below it are none: a scene at rest is solved to round-off, which ends it at once."""


@dataclass(frozen=True, slots=True)
class Auto:
    """`tolerance: auto` with a limit of iterations."""

    iterations: int


Stop = StopRule | Auto


def stop_rule(iterations: int, tolerance: float | str | None) -> Stop:
    """Of a run's options."""
    return Auto(iterations) if isinstance(tolerance, str) else StopRule(iterations, tolerance)


@dataclass(frozen=True, slots=True)
class Stated:
    """One rule for all steps."""

    rule: StopRule

    def done(self, after: Motion, error: Motion | None) -> None:
        """A step ended."""


class LocalErrors:
    """Of the steps of one motion as they are done; `rule` is that of the next one."""

    def __init__(self, auto: Auto, scene: Scene, now: Motion, frames: int) -> None:
        """frames: up to the end. Raises Unsupported where steps differ in length."""
        if scene.alternate:
            raise Unsupported("tolerance: auto differences steps of one length, and the scene alternates two; give one")
        system, order = scene.system, scene.integrator.order
        self._iterations, self._span, self._order = auto.iterations, frames * system.time_step, order
        self._step, self._rate, self._free = system.time_step, system.rate, system.free
        self._mass = system.mass[self._free, None]
        self._past = deque([now.velocity], order + 2)
        self.rule = StopRule(auto.iterations, FIRST)

    def done(self, after: Motion, error: Motion | None) -> None:
        """A step ended so; error: what an embedded method tells of it."""
        self._past.append(after.velocity)
        if len(self._past) < self._order + 2:
            return
        differences = np.diff(np.array(self._past), self._order, axis=0) / factorial(self._order + 1)
        least = self._size(self._step * differences[-1], differences[1] - differences[0])
        if error is not None:
            least = min(least, self._size(*error))
        within = PART * least / (1.0 / self._rate + self._span)
        self.rule = StopRule(self._iterations, within=max(within, _NOTHING))

    def _size(self, moved: Positions, sped: Positions) -> float:
        """Of e_p [m] and e_v [m/s], (n, 3), together [kg^(1/2) m]."""
        return self._norm(moved) + self._span * self._norm(sped)

    def _norm(self, x: Positions) -> float:
        """|x|_M over the free vertices."""
        return float(np.sqrt((self._mass * x[self._free] ** 2).sum()))
