"""Time stepping by an integrator with a fixed step size and automatic tolerance (`tolerance: auto`)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import ceil, inf
from time import perf_counter, thread_time
from typing import ClassVar

import numpy as np

from harness.scenes.bind import Scene
from harness.simulation.algebraic import Auto
from harness.simulation.controlled import TRIES, Follower, Path, TooSlow, shares
from harness.simulation.step import prepare, simulate, start
from solvers.problem import Solver


@dataclass(frozen=True, eq=False)
class ImplicitEven(Follower):
    """Stepping by an integrator with a fixed step size.

    Attributes:
      bound: builds the scene with a given step size [s].
      solver: solver of the steps.
      horizon: end time [s].
      frames: number of frames up to the end time; the setting is the number of steps of each, at least one.
    """

    bound: Callable[[float], Scene]
    solver: Solver
    horizon: float
    frames: int

    even: ClassVar[bool] = True

    @property
    def order(self) -> int:
        """The order of convergence of the integrator."""
        return self.bound(self.horizon / self.frames).integrator.order

    def follow(self, setting: float, *, limit: float = inf) -> Path:
        """Integrate the motion; raises Unsupported as the solver does."""
        cpu, parts = thread_time(), ceil(setting)
        scene = self.bound(self.horizon / (self.frames * parts))
        ready, seen, reached, iterations = prepare(scene, self.solver), [start(scene).now.positions], list[float](), 0
        began, steps = perf_counter(), self.frames * parts
        for step in simulate(scene, ready, Auto(TRIES), first_guess="motion", frames=steps):
            iterations += step.iterations
            if step.index % parts == 0:
                seen.append(step.positions)
                reached.append(perf_counter() - began)
            if thread_time() - cpu > limit:
                raise TooSlow
        h = scene.system.time_step
        shared, processor = shares(reached), thread_time() - cpu
        return Path(np.array(seen), steps, 0, 1, iterations, (h, h), reached[-1], shared, processor)
