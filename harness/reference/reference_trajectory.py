"""Reference trajectory for time stepping: a high-order integration of the equations of motion.

The motion is integrated by Dormand and Prince's method of order 8 (Hairer, Norsett and Wanner, Solving Ordinary
Differential Equations I, section II.10) at rtol 1e-12, and checked by Adams methods of orders up to 12 (VODE; ibid.,
section III.1). Where a perturbation of 1e-12 at the start grows past the error to be measured
(`springbench.harness.reference.perturbation_growth`), there is no reference trajectory, and the request is rejected.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from springbench.harness.errors import RunFailed
from springbench.harness.reference.equations_of_motion import OdeField, OdeState
from springbench.harness.scenes.scene_builder import Scene
from springbench.solvers.model.step_problem import Positions

INTEGRATION_RTOL = 1e-12
CHECK_PERTURBATION = 1e-12
"""Perturbation of every coordinate, relative to the rest shape's size."""
REFERENCE_MARGIN = 0.1
"""Maximum error of the reference, relative to the error to be measured."""


class UnpredictableMotion(RunFailed):
    """The reference would be as uncertain as the error to be measured."""


def compute_position_error(p: Positions, reference: Positions, free_vertices: NDArray[np.int64]) -> float:
    """Return |p - reference|_F [m] over the free vertices, by which methods are compared.

    Args:
        p: positions (n, 3) [m].
        reference: positions of the reference (n, 3) [m].
        free_vertices: indices of the vertices that count.
    """
    return float(np.linalg.norm((p - reference)[free_vertices]))


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceTrajectory:
    """Reference motion at some times.

    Norms are Frobenius norms over the free vertices.

    Attributes:
        times: times (k,) [s].
        free_vertices: indices of the vertices that are not pinned.
        positions: positions (k, n, 3) [m].
        velocities: velocities (k, n, 3) [m/s].
        displacement: displacement from the start (k,) [m].
        disagreement: difference of the two methods (k,), relative to the displacement.
        growth: size of a perturbation of the start (k,), relative to the displacement; 0 where none was estimated.
    """

    times: NDArray[np.float64]
    free_vertices: NDArray[np.int64]
    positions: Positions
    velocities: Positions
    displacement: NDArray[np.float64]
    disagreement: NDArray[np.float64]
    growth: NDArray[np.float64]

    @property
    def reference_kind(self) -> str:
        """The kind of the reference."""
        return "integrated"

    def get_error_bound(self, k: int) -> float:
        """Return the bound on the reference's own error at times[k], relative to the displacement."""
        return float(max(self.disagreement[k], self.growth[k]))

    def measure_error(self, k: int, p: Positions) -> float:
        """Measure the error of positions at one of the times, relative to the displacement.

        Args:
            k: index of the time in `times`.
            p: positions (n, 3) [m] at that time; pinned vertices do not count.
        """
        return compute_position_error(p, self.positions[k], self.free_vertices) / float(self.displacement[k])

    def require_accuracy(self, error: float) -> None:
        """Raise UnpredictableMotion where a relative error could not be distinguished from the reference's own."""
        for k, t in enumerate(self.times):
            for found, what in ((self.growth[k], "a perturbation of 1e-12"), (self.disagreement[k], "round-off")):
                if not found <= REFERENCE_MARGIN * error:
                    raise UnpredictableMotion(
                        f"after {t:g} s {what} has grown to {found:.1e} of the displacement: an error of {error:.1e} "
                        "cannot be measured there; use a shorter horizon or a larger error"
                    )


ProgressFunction = Callable[[int, float], None]
"""Called at each evaluation of the forces with the current integration, 1 or 2, and the time reached [s]."""


class _ReportingField:
    """A field that reports progress; a restart at time 0 is the second integration."""

    def __init__(self, field: OdeField, report_progress: ProgressFunction) -> None:
        self._field, self._report_progress, self._motion, self._until = field, report_progress, 1, 0.0

    def __call__(self, t: float, y: OdeState) -> OdeState:
        if t == 0.0 < self._until:
            self._motion, self._until = self._motion + 1, 0.0
        self._until = max(self._until, t)
        self._report_progress(self._motion, t)
        return self._field(t, y)


def integrate_motion(
    scene: Scene, times: Sequence[float], report_progress: ProgressFunction | None = None
) -> ReferenceTrajectory:
    """Integrate the motion of a scene whose pins are exact.

    Args:
        scene: scene with exact pins.
        times: ascending times after the start [s].
        report_progress: called at each evaluation of the forces.

    Raises:
        NotIntegrable: the scene has no equations of motion.
    """
    alone = OdeField(scene)
    start, atol = alone.initial_state, INTEGRATION_RTOL * (scene.mesh.bounding_box_diagonal or 1.0)
    field = _ReportingField(alone, report_progress) if report_progress else alone
    path, other = _integrate_dop853(field, start, times, atol), _integrate_adams(field, start, times, atol)
    moved, unknown = _position_distance(path, start), np.full(len(path), np.inf)
    motions = [tuple(part.copy() for part in alone.unpack_state(t, y)) for t, y in zip(times, path, strict=True)]
    return ReferenceTrajectory(
        np.array(times, float),
        scene.system.free_vertices,
        np.array([p for p, _ in motions]),
        np.array([v for _, v in motions]),
        moved,
        np.divide(_position_distance(path, other), moved, out=unknown, where=moved > 0.0),
        growth=np.zeros(len(path)),
    )


def _position_distance(path: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute |p - q|_F [m] of the positions of states (k, 6 f)."""
    return np.linalg.norm((path - other)[:, : path.shape[1] // 2], axis=1)


def _integrate_dop853(
    field: Callable[[float, OdeState], OdeState], y: OdeState, times: Sequence[float], atol: float
) -> OdeState:
    """Integrate the states (k, 6 f); steps end at each time, without interpolation."""
    from scipy.integrate import solve_ivp  # takes a third of a second to import

    path, begin = list[OdeState](), 0.0
    for end in times:
        solved = solve_ivp(field, (begin, end), y, "DOP853", [end], rtol=INTEGRATION_RTOL, atol=atol)
        if not solved.success:
            raise UnpredictableMotion(f"the motion cannot be followed beyond {begin:g} s: {solved.message}")
        y, begin = solved.y[:, -1], end
        path.append(y)
    return np.array(path)


def _integrate_adams(
    field: Callable[[float, OdeState], OdeState], y: OdeState, times: Sequence[float], atol: float
) -> OdeState:
    """Integrate the states (k, 6 f) by Adams methods."""
    from scipy.integrate import ode

    solver = ode(field).set_integrator("vode", method="adams", rtol=INTEGRATION_RTOL, atol=atol, order=12, nsteps=10**8)
    solver.set_initial_value(y, 0.0)
    path = list[OdeState]()
    for end in times:
        path.append(np.array(solver.integrate(end)))
        if not solver.successful():
            raise UnpredictableMotion(f"Adams methods cannot follow the motion up to {end:g} s")
    return np.array(path)
