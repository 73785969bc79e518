"""Motion that keeps to an error by a solver with steps of its own within frames (`own_steps` of its `about`): they
are chosen by their error, or have one length, the longest that is stable or shorter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import inf
from time import perf_counter
from typing import ClassVar, Protocol, runtime_checkable

import numpy as np

from harness.scenes.bind import Scene
from harness.simulation.controlled import Follower, Path, Stuck, TooSlow, shares
from harness.simulation.step import State, problem, start
from solvers.integrators import Motion
from solvers.problem import Positions, Prepared, Solver, StepProblem, Unsupported


class _Stepping(Protocol):
    """A prepared solver with steps of its own."""

    @property
    def order(self) -> int:
        """Of the error."""
        ...

    @property
    def evaluations(self) -> int:
        """Of the forces, in a step."""
        ...

    def step(self, problem: StepProblem, h: float | None = None) -> tuple[Positions, Positions, Sequence[float]]:
        """Positions [m] and velocities [m/s] at the frame's end, and steps accepted, rejected and the last one's length
        [s]; h: the first one's."""
        ...


@runtime_checkable
class Controlled(_Stepping, Protocol):
    """It can choose its steps within a frame by their error."""

    def within(self, tolerance: float) -> Controlled:
        """The same with an error of each step [m]. Raises Unsupported where it chooses none."""
        ...


@runtime_checkable
class Even(_Stepping, Protocol):
    """Its steps within a frame have one length, the longest that is stable."""

    def refined(self, times: float) -> Even:
        """The same with so many times the steps."""
        ...


@dataclass(frozen=True, eq=False)
class Own(Follower):
    """By a solver that chooses its steps within frames. scene: its step is a frame, its integrator `own`."""

    scene: Scene
    solver: Solver
    frames: int

    @property
    def order(self) -> int:
        """See Follower."""
        return self._order

    @cached_property
    def _order(self) -> int:
        return self._prepared(1.0).order

    def follow(self, setting: float, *, limit: float = inf) -> Path:
        """See Follower. Raises Unsupported as the solver does, and for what changes in a frame."""
        scene = self.scene
        ready, state = self._prepared(setting), start(scene)
        began = perf_counter()
        reached = list[float]()
        seen, h, told = [state.now.positions], None, np.zeros((self.frames, 3))
        for k in range(self.frames):
            stated = problem(scene, state, "current")
            try:
                p, v, each = ready.step(stated, h)
            except RuntimeError as error:
                raise Stuck(f"frame {k + 1}, after {scene.time(k):.6g} s: {error}") from error
            told[k] = each[:3]
            h, state = float(told[k, 2]), State(Motion(p, v), None, k + 1)
            seen.append(p)
            reached.append(perf_counter() - began)
            if perf_counter() - began > limit:
                raise TooSlow
        accepted, rejected = (int(count) for count in told[:, :2].sum(axis=0))
        evaluations = (accepted + rejected) * ready.evaluations
        mean = scene.system.time_step * self.frames / accepted
        counts = accepted, rejected, 0, evaluations
        return Path(np.array(seen), *counts, (mean, mean), reached[-1], shares(reached))

    def _prepared(self, setting: float) -> _Stepping:
        scene = self.scene
        changes = [
            what
            for what, there in (("forces of place, speed and time", scene.forces), ("moving pins", scene.moving))
            if there
        ]
        if changes:
            raise Unsupported(f"takes {' and '.join(changes)} as even within a frame, which is of order 1")
        return self._set(self.solver.prepare(scene.system), setting)

    def _set(self, ready: Prepared, setting: float) -> _Stepping:
        if not isinstance(ready, Controlled):
            raise Unsupported("the method chooses no steps by an error")
        return ready.within(setting)


@dataclass(frozen=True, eq=False)
class OwnEven(Own):
    """By a solver whose steps have one length."""

    even: ClassVar[bool] = True

    def _set(self, ready: Prepared, setting: float) -> _Stepping:
        if not isinstance(ready, Even):
            raise Unsupported("the number of its steps in a frame cannot be set")
        return ready.refined(setting)
