"""Motion that keeps to an error by a solver with steps of its own within frames (`own_steps` of its `about`): they
are chosen by their error, or have one length, the longest that is stable or shorter.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import ceil, inf
from time import perf_counter, thread_time
from typing import ClassVar, Protocol, runtime_checkable

import numpy as np

from harness.scenes.bind import Scene
from harness.simulation.controlled import Follower, Path, Stuck, TooSlow, shares
from harness.simulation.step import State, problem, start
from solvers.integrators import Motion
from solvers.problem import Positions, Solver, StepProblem, Unsupported


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

    @property
    def factorisations(self) -> int:
        """In a step that is tried, 0 of explicit methods."""
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
        return self._prepared(1.0)[1].order

    def follow(self, setting: float, *, limit: float = inf) -> Path:
        """See Follower. Raises Unsupported as the solver does, and for what changes in a frame where that would not be
        noticed by the errors of steps."""
        cpu = thread_time()
        scene, ready, pieces = self._prepared(setting)
        state, began = start(scene), perf_counter()
        reached = list[float]()
        seen, h, told = [state.now.positions], None, np.zeros((self.frames * pieces, 3))
        for k in range(len(told)):
            stated = problem(scene, state, "current")
            try:
                p, v, each = ready.step(stated, h)
            except RuntimeError as error:
                raise Stuck(f"frame {k // pieces + 1}, after {scene.time(k):.6g} s: {error}") from error
            told[k] = each[:3]
            h, state = float(told[k, 2]), State(Motion(p, v), None, k + 1)
            if (k + 1) % pieces == 0:
                seen.append(p)
                reached.append(perf_counter() - began)
            if thread_time() - cpu > limit:
                raise TooSlow
        accepted, rejected = (int(count) for count in told[:, :2].sum(axis=0))
        evaluations = (accepted + rejected) * ready.evaluations
        mean = scene.system.time_step * len(told) / accepted
        counts = accepted, rejected, (accepted + rejected) * ready.factorisations, evaluations
        return Path(np.array(seen), *counts, (mean, mean), reached[-1], shares(reached), thread_time() - cpu)

    def _prepared(self, setting: float) -> tuple[Scene, _Stepping, int]:
        """The scene, what steps it, and in how many pieces each frame is done."""
        if changes := _changes(self.scene):
            raise Unsupported(f"takes {' and '.join(changes)} as even within a frame, which is of order 1")
        ready = self.solver.prepare(self.scene.system)
        if not isinstance(ready, Controlled):
            raise Unsupported("the method chooses no steps by an error")
        return self.scene, ready.within(setting), 1


@dataclass(frozen=True, eq=False)
class OwnEven(Own):
    """By a solver whose steps have one length. bound: the scene at a length of steps [s].

    What changes within a frame is taken as even within so many pieces of each, which is of order 1."""

    bound: Callable[[float], Scene]

    even: ClassVar[bool] = True

    @cached_property
    def _order(self) -> int:
        return 1 if _changes(self.scene) else self._prepared(1.0)[1].order

    def _prepared(self, setting: float) -> tuple[Scene, _Stepping, int]:
        pieces = ceil(setting) if _changes(self.scene) else 1
        scene = self.bound(self.scene.system.time_step / pieces) if pieces > 1 else self.scene
        ready = self.solver.prepare(scene.system)
        if not isinstance(ready, Even):
            raise Unsupported("the number of its steps in a frame cannot be set")
        return scene, ready.refined(setting if pieces == 1 else 1.0), pieces


def _changes(scene: Scene) -> list[str]:
    """What solvers with steps of their own take as even within a frame, though it changes."""
    there = ("forces of place, speed and time", scene.forces), ("moving pins", scene.moving)
    return [what for what, some in there if some]
