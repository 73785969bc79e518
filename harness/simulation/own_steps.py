"""Time stepping to an error tolerance by a solver with substeps within frames (`own_steps` in its metadata).

The substeps are adaptive, or have a fixed size: the largest stable one or a smaller one.
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
    """A prepared solver with substeps."""

    @property
    def order(self) -> int:
        """The order of convergence of the error."""
        ...

    @property
    def evaluations(self) -> int:
        """The number of force evaluations in a step."""
        ...

    @property
    def factorisations(self) -> int:
        """The number of factorisations in a tried step, 0 for explicit methods."""
        ...

    def step(self, problem: StepProblem, h: float | None = None) -> tuple[Positions, Positions, Sequence[float]]:
        """Integrate one frame.

        Args:
          problem: step problem of the frame.
          h: first step size [s].

        Returns: positions [m] and velocities [m/s] at the frame's end, and the number of accepted steps, the number of
          rejected steps and the last step size [s].
        """
        ...


@runtime_checkable
class Controlled(_Stepping, Protocol):
    """A solver with adaptive steps within a frame."""

    def within(self, tolerance: float) -> Controlled:
        """Return the solver with an error tolerance [m] of each step.

        Raises:
          Unsupported: the method has no error estimate.
        """
        ...


@runtime_checkable
class Even(_Stepping, Protocol):
    """A solver with fixed steps within a frame, of the largest stable size."""

    def refined(self, times: float) -> Even:
        """Return the solver with the number of steps multiplied by a factor."""
        ...


@dataclass(frozen=True, eq=False)
class Own(Follower):
    """Stepping by a solver with adaptive substeps within frames.

    The step of the scene is a frame, and its integrator is `own`.
    """

    scene: Scene
    solver: Solver
    frames: int

    @property
    def order(self) -> int:
        """The order of convergence of the solver."""
        return self._order

    @cached_property
    def _order(self) -> int:
        return self._prepared(1.0)[1].order

    def follow(self, setting: float, *, limit: float = inf) -> Path:
        """Integrate the motion.

        Raises Unsupported as the solver does, and for quantities that change within a frame where the error estimate
        would not detect it.
        """
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
        """Return the scene, the prepared solver and the number of pieces of each frame."""
        if changes := _changes(self.scene):
            raise Unsupported(f"takes {' and '.join(changes)} as even within a frame, which is of order 1")
        ready = self.solver.prepare(self.scene.system)
        if not isinstance(ready, Controlled):
            raise Unsupported("the method chooses no steps by an error")
        return self.scene, ready.within(setting), 1


@dataclass(frozen=True, eq=False)
class OwnEven(Own):
    """Stepping by a solver with a fixed substep size.

    Quantities that change within a frame are taken as constant within each of a number of pieces, which is of order 1.
    `bound` builds the scene with a given step size [s].
    """

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
    """List the quantities that substepping solvers take as constant within a frame although they change."""
    there = ("forces of place, speed and time", scene.forces), ("moving pins", scene.moving)
    return [what for what, some in there if some]
