"""Motion that keeps to an error by a solver that chooses its own steps within frames (`own_steps` of its `about`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf
from time import perf_counter
from typing import Protocol, runtime_checkable

import numpy as np

from harness.scenes.bind import Scene
from harness.simulation.controlled import Path, Stuck, TooSlow, shares
from harness.simulation.step import State, problem, start
from solvers.integrators import Motion
from solvers.problem import Positions, Solver, StepProblem, Unsupported


@runtime_checkable
class Controlled(Protocol):
    """A prepared solver that can choose its steps within a frame by their error."""

    @property
    def order(self) -> int:
        """Of the error."""
        ...

    @property
    def evaluations(self) -> int:
        """Of the forces, in a step."""
        ...

    def within(self, tolerance: float) -> Controlled:
        """The same with an error of each step [m]. Raises Unsupported where it chooses none."""
        ...

    def step(self, problem: StepProblem, h: float | None = None) -> tuple[Positions, Positions, Sequence[float]]:
        """Positions [m] and velocities [m/s] at the frame's end, and steps accepted, rejected and the last one's length
        [s]; h: the first one's."""
        ...


@dataclass(frozen=True, eq=False)
class Own:
    """By a solver that chooses its steps within frames. scene: its step is a frame, its integrator `own`."""

    scene: Scene
    solver: Solver
    frames: int

    @property
    def order(self) -> int:
        """See Follower."""
        return self._prepared(1.0).order

    def follow(self, tolerance: float, *, limit: float = inf) -> Path:
        """See Follower. Raises Unsupported as the solver does, and for what changes in a frame."""
        scene = self.scene
        ready, state = self._prepared(tolerance), start(scene)
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

    def _prepared(self, tolerance: float) -> Controlled:
        scene = self.scene
        changes = [
            what
            for what, there in (("forces of place, speed and time", scene.forces), ("moving pins", scene.moving))
            if there
        ]
        if changes:
            raise Unsupported(f"takes {' and '.join(changes)} as even within a frame, which is of order 1")
        ready = self.solver.prepare(scene.system)
        if not isinstance(ready, Controlled):
            raise Unsupported("the method chooses no steps by an error")
        return ready.within(tolerance)
