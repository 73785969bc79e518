"""Reference trajectory for time stepping: a high-order integration of the equations of motion.

Dormand and Prince's method of order 8 (Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I, section
II.10) at rtol 1e-12, checked by Adams methods of orders up to 12 (VODE; ibid., section III.1). Where a perturbation of
1e-12 at the start grows past the error to be measured (`harness.reference.growth`), there is no reference
trajectory, and the request is rejected.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import ode, solve_ivp

from harness.base.errors import RunFailed
from harness.reference.motion import Field, State
from harness.scenes.bind import Scene
from solvers.problem import Positions

RTOL = 1e-12
PERTURBATION = 1e-12
"""Perturbation of every coordinate, relative to the rest shape's size."""
MARGIN = 0.1
"""Maximum error of the reference, relative to the error to be measured."""


class Unpredictable(RunFailed):
    """The reference would be as uncertain as the error to be measured."""


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Reference motion at some times.

    Norms are Frobenius norms over the free vertices.

    Attributes:
      times: times (k,) [s].
      free: indices of the vertices that are not pinned.
      positions: positions (k, n, 3) [m].
      velocities: velocities (k, n, 3) [m/s].
      moved: displacement from the start (k,) [m].
      disagreement: difference of the two methods (k,), relative to the displacement.
      growth: size of a perturbation of the start (k,), relative to the displacement; 0 where none was estimated.
    """

    times: NDArray[np.float64]
    free: NDArray[np.int64]
    positions: Positions
    velocities: Positions
    moved: NDArray[np.float64]
    disagreement: NDArray[np.float64]
    growth: NDArray[np.float64]

    @property
    def truth(self) -> str:
        """The kind of the reference."""
        return "integrated"

    def error(self, k: int, p: Positions) -> float:
        """Measure the error of p (n, 3) [m] at times[k], relative to the displacement."""
        return float(np.linalg.norm((p - self.positions[k])[self.free])) / float(self.moved[k])

    def require(self, error: float) -> None:
        """Raise Unpredictable where a relative error could not be distinguished from the reference's own."""
        for k, t in enumerate(self.times):
            for found, what in ((self.growth[k], "a perturbation of 1e-12"), (self.disagreement[k], "round-off")):
                if not found <= MARGIN * error:
                    raise Unpredictable(
                        f"after {t:g} s {what} has grown to {found:.1e} of the displacement: an error of {error:.1e} "
                        "cannot be measured there; ask for a shorter horizon or a larger error"
                    )


Told = Callable[[int, float], None]
"""Called at each evaluation of the forces with the current integration, 1 or 2, and the time reached [s]."""


class _Telling:
    """A field that reports progress; a restart at time 0 is the second integration."""

    def __init__(self, field: Field, told: Told) -> None:
        self._field, self._told, self._motion, self._until = field, told, 1, 0.0

    def __call__(self, t: float, y: State) -> State:
        if t == 0.0 < self._until:
            self._motion, self._until = self._motion + 1, 0.0
        self._until = max(self._until, t)
        self._told(self._motion, t)
        return self._field(t, y)


def integrate(scene: Scene, times: Sequence[float], told: Told | None = None) -> Trajectory:
    """Integrate the motion of a scene whose pins are exact.

    Args:
      scene: scene with exact pins.
      times: ascending times after the start [s].
      told: called at each evaluation of the forces.

    Raises:
      Unintegrable: the scene has no equations of motion.
    """
    alone = Field(scene)
    start, atol = alone.start, RTOL * (scene.mesh.size or 1.0)
    field = _Telling(alone, told) if told else alone
    path, other = _dop853(field, start, times, atol), _adams(field, start, times, atol)
    moved, unknown = _apart(path, start), np.full(len(path), np.inf)
    motions = [tuple(part.copy() for part in alone.motion(t, y)) for t, y in zip(times, path, strict=True)]
    return Trajectory(
        np.array(times, float),
        scene.system.free,
        np.array([p for p, _ in motions]),
        np.array([v for _, v in motions]),
        moved,
        np.divide(_apart(path, other), moved, out=unknown, where=moved > 0.0),
        growth=np.zeros(len(path)),
    )


def _apart(path: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute |p - q|_F [m] of the positions of states (k, 6 f)."""
    return np.linalg.norm((path - other)[:, : path.shape[1] // 2], axis=1)


def _dop853(field: Callable[[float, State], State], y: State, times: Sequence[float], atol: float) -> State:
    """Integrate the states (k, 6 f); steps end at each time, without interpolation."""
    path, begin = list[State](), 0.0
    for end in times:
        solved = solve_ivp(field, (begin, end), y, "DOP853", [end], rtol=RTOL, atol=atol)
        if not solved.success:
            raise Unpredictable(f"the motion cannot be followed beyond {begin:g} s: {solved.message}")
        y, begin = solved.y[:, -1], end
        path.append(y)
    return np.array(path)


def _adams(field: Callable[[float, State], State], y: State, times: Sequence[float], atol: float) -> State:
    """Integrate the states (k, 6 f) by Adams methods."""
    solver = ode(field).set_integrator("vode", method="adams", rtol=RTOL, atol=atol, order=12, nsteps=10**8)
    solver.set_initial_value(y, 0.0)
    path = list[State]()
    for end in times:
        path.append(np.array(solver.integrate(end)))
        if not solver.successful():
            raise Unpredictable(f"Adams methods cannot follow the motion up to {end:g} s")
    return np.array(path)
