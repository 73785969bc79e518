"""How fast two motions part that begin all but alike: it tells how far ahead a motion can be known.

What is `PERTURBATION` of the mesh's size at the start of every free coordinate, to either side, is followed beside the
motion itself, step by step by the same steps: by velocity Verlet where it knows the scene, else by the trapezoidal rule
(Newmark 1959), of which neither damps. While it is small it grows as an exact perturbation does, by the Lyapunov
exponents of the motion.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from harness.reference.trajectory import MARGIN
from harness.reference.trajectory import PERTURBATION as ROUND_OFF
from harness.scenes.bind import Scene
from harness.simulation.step import State, prepare, simulate, start
from solvers.integrators import Motion
from solvers.methods.explicit import VelocityVerlet
from solvers.methods.newton import Newton
from solvers.problem import Positions, Prepared, StopRule, Unsupported

PERTURBATION = 1e-9
"""Of the size: a thousand times what unsolved residuals leave, and it stays small while it grows a million times."""
LEAST = 1e-11
"""No relative error is asked below it: the sum of a thousand steps' round-off comes near."""
_SOLVED = StopRule(100, 1e-12)
_PARTS = 2
"""Steps of the trapezoidal rule in a frame."""


@dataclass(frozen=True, slots=True, eq=False)
class Growth:
    """times (k,) [s]; moved (k,) [m]: the displacement from the start, Frobenius norm over the free vertices; grown
    (k,): what a perturbation of 1e-12 of the size at the start has become, relative to that; scale: what moved is at
    the end a free coordinate, root mean square [m]."""

    times: NDArray[np.float64]
    moved: NDArray[np.float64]
    grown: NDArray[np.float64]
    scale: float

    def known(self, error: float) -> float:
        """Up to which time [s] a relative error can be told from what nobody can know, 0 for none."""
        fine = self.grown <= MARGIN * error
        return float(self.times[fine][-1]) if fine.any() and error >= LEAST else 0.0

    @property
    def least(self) -> float:
        """The least relative error that can be known at the end, round-off included."""
        return max(float(self.grown[-1]) / MARGIN, LEAST)


def growth(bound: Callable[[float, str], Scene], horizon: float, frames: int) -> Growth:
    """Of a motion up to a horizon [s], looked at after each of so many frames.

    bound: the scene with steps of a length [s] and an integrator by name. Raises Unsupported where neither method
    knows the scene, and Diverged's like where the motion is not finite.
    """
    scene, ready, stop, parts = _method(bound, horizon / frames)
    begun, free = start(scene), scene.system.free
    nudge = np.zeros_like(begun.now.positions)
    sides = np.random.default_rng(0).choice([-1.0, 1.0], (len(free), 3))
    nudge[free] = PERTURBATION * (scene.mesh.size or 1.0) * sides
    other = State(Motion(begun.now.positions + nudge, begun.now.velocity), None, 0)
    one, two = (_path(scene, ready, stop, state, parts, frames)[:, free] for state in (begun, other))
    moved = np.linalg.norm(one - begun.now.positions[free], axis=(1, 2))
    apart = np.linalg.norm(two - one, axis=(1, 2)) * (ROUND_OFF / PERTURBATION)
    grown = np.divide(apart, moved, out=np.full(frames, np.inf), where=moved > 0.0)
    times: NDArray[np.float64] = np.linspace(0.0, horizon, frames + 1)[1:]
    return Growth(times, moved, grown, float(moved[-1]) / max(1, 3 * len(free)) ** 0.5)


def _method(bound: Callable[[float, str], Scene], frame: float) -> tuple[Scene, Prepared, StopRule, int]:
    scene = bound(frame, "own")
    if not scene.forces and not scene.moving:
        try:
            return scene, prepare(scene, VelocityVerlet()), StopRule(1), 1
        except Unsupported:
            pass
    scene = bound(frame / _PARTS, "newmark")
    return scene, prepare(scene, Newton()), _SOLVED, _PARTS


def _path(scene: Scene, ready: Prepared, stop: StopRule, state: State, parts: int, frames: int) -> Positions:
    """Positions (frames, n, 3) [m] at the frames' ends."""
    run = simulate(scene, ready, stop, first_guess="motion", frames=frames * parts, state=replace(state))
    return np.array([step.positions for step in run if step.index % parts == 0])
