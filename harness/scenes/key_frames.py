"""Key-frame motion: rotation about an axis and translation, both interpolated in time.

    q(t) = pivot + R(axis, angle(t)) (q - pivot) + offset(t)

The interpolation between key frames is linear, or by the monotone cubics of Fritsch and Carlson (1980), which are
smooth and never overshoot a key frame. Before the first key frame and after the last one the points are at rest.
"""

from __future__ import annotations

from functools import cached_property
from itertools import pairwise
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator
from springbench.harness.schema.base_model import ConfigModel, Vector3
from springbench.solvers.model.step_problem import Positions


class KeyFrame(ConfigModel):
    """Pose of the points at one time."""

    time: float = Field(ge=0.0, le=1e9)
    """Simulated time [s]."""
    offset: Vector3 = (0.0, 0.0, 0.0)
    """Translation from the declared position [m]."""
    angle: float = Field(default=0.0, ge=-1e9, le=1e9)
    """Rotation angle about the axis [degrees]; more than 360 is more than one revolution."""


class KeyFrameMotion(ConfigModel):
    """A rigid motion along key frames."""

    key_frames: tuple[KeyFrame, ...] = Field(min_length=1, max_length=10_000)
    """Key frames with increasing times."""
    axis: Vector3 = (0.0, 1.0, 0.0)
    """Direction of the rotation axis, of any length but zero."""
    pivot: Vector3 = (0.0, 0.0, 0.0)
    """A point on the rotation axis [m]."""
    interpolation: Literal["linear", "smooth"] = "linear"
    """Interpolation between key frames: linear, or by cubics with zero velocity where the direction reverses."""

    @model_validator(mode="after")
    def _check_order(self) -> KeyFrameMotion:
        times = [key.time for key in self.key_frames]
        if any(b <= a for a, b in pairwise(times)):
            raise ValueError("the times of the keys should rise from key to key")
        if not any(self.axis):
            raise ValueError("the axis should have a direction; it is zero")
        return self

    @property
    def key_times(self) -> tuple[float, ...]:
        """Times of the key frames [s]."""
        return tuple(key.time for key in self.key_frames)

    def transform_points(self, points: Positions, time: float) -> Positions:
        """Return the positions (q, 3) [m] of declared points at a time.

        Args:
            points: declared positions (q, 3) [m], before any motion.
            time: simulated time [s].
        """
        *offset, turn = self._interpolate_pose(time)
        arm = points - self.pivot
        return points + offset + arm @ (_rotation_matrix(self.axis, np.deg2rad(turn)) - np.eye(3)).T

    def invert_points(self, points: Positions, time: float) -> Positions:
        """Return the declared positions (q, 3) [m] of points at a time.

        Args:
            points: positions (q, 3) [m] at that time.
            time: simulated time [s].
        """
        *offset, turn = self._interpolate_pose(time)
        arm = points - offset - self.pivot
        return points - offset + arm @ (_rotation_matrix(self.axis, np.deg2rad(turn)) - np.eye(3))

    def compute_velocity(self, points: Positions, time: float) -> Positions:
        """Return the velocity (q, 3) [m/s] of declared points at a time.

        At a key frame, the velocity is the limit from the right.

        Args:
            points: declared positions (q, 3) [m], before any motion.
            time: simulated time [s].
        """
        (*offset, rise), (*_, turn) = self._interpolate_rate(time), self._interpolate_pose(time)
        arm = (points - self.pivot) @ _rotation_matrix(self.axis, np.deg2rad(turn)).T
        axis = np.array(self.axis) / np.linalg.norm(self.axis)
        return offset + np.deg2rad(rise) * np.cross(axis, arm)

    @property
    def is_piecewise_linear(self) -> bool:
        """Whether points move along straight lines at constant velocity between key frames."""
        return self.interpolation == "linear" and len({key.angle for key in self.key_frames}) == 1

    def bound_speed(self, start_time: float, end_time: float, points: Positions, *, slack: float = 0.0) -> float:
        """Return an upper bound of the speed [m/s] between two times.

        There is no key frame between the two times.

        Args:
            start_time: [s].
            end_time: [s].
            points: declared positions (q, 3) [m].
            slack: the bound is valid for all points within this distance [m] of `points`.
        """
        times, values = self.key_table
        k = int(np.clip(np.searchsorted(times, start_time, side="right"), 1, max(1, len(times) - 1)))
        if len(times) == 1 or start_time >= times[-1] or end_time <= times[0]:
            return 0.0
        *offset, turn = np.abs(values[k] - values[k - 1]) / (times[k] - times[k - 1])
        arm = float(np.linalg.norm(points - self.pivot, axis=1).max(initial=0.0)) + slack
        return _MAX_SLOPE_RATIOS[self.interpolation] * (float(np.linalg.norm(offset)) + float(np.deg2rad(turn)) * arm)

    @cached_property
    def key_table(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Times [s] of the key frames, and their offsets [m] and angles [degrees] (k, 4)."""
        return np.array(self.key_times), np.array([(*key.offset, key.angle) for key in self.key_frames])

    def _interpolate_pose(self, time: float) -> NDArray[np.float64]:
        """Interpolate offset [m] and angle [degrees] at a time [s], (4,)."""
        times, values = self.key_table
        t = float(np.clip(time, times[0], times[-1]))
        return values[0] if len(times) == 1 else _INTERPOLATIONS[self.interpolation](times, values, t)

    def _interpolate_rate(self, time: float) -> NDArray[np.float64]:
        """Interpolate the rates of offset [m/s] and angle [degrees/s] at a time [s], (4,)."""
        times, values = self.key_table
        if not times[0] <= time < times[-1]:
            return np.zeros(4)
        if self.interpolation == "linear":
            k = int(np.searchsorted(times, time, side="right"))
            return (values[k] - values[k - 1]) / (times[k] - times[k - 1])
        from scipy.interpolate import PchipInterpolator

        return np.asarray(PchipInterpolator(times, values)(time, 1))


def _interpolate_linear(times: NDArray[np.float64], values: NDArray[np.float64], t: float) -> NDArray[np.float64]:
    return np.array([cast(float, np.interp(t, times, column)) for column in values.T])


def _interpolate_smooth(times: NDArray[np.float64], values: NDArray[np.float64], t: float) -> NDArray[np.float64]:
    from scipy.interpolate import PchipInterpolator  # takes a third of a second to import

    return np.asarray(PchipInterpolator(times, values)(t))


_MAX_SLOPE_RATIOS = {"linear": 1.0, "smooth": 3.0}
"""Bound of the slope between two key frames relative to that of the secant (Fritsch and Carlson's condition)."""

_INTERPOLATIONS: dict[str, Any] = {"linear": _interpolate_linear, "smooth": _interpolate_smooth}


def _rotation_matrix(axis: Vector3, angle: float) -> NDArray[np.float64]:
    """Compute the rotation matrix by Rodrigues' formula, (3, 3)."""
    x, y, z = np.array(axis) / np.linalg.norm(axis)
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K
