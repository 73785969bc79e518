"""Motion along key frames: points are turned about an axis and shifted, both interpolated in time.

    q(t) = about + R(axis, turn(t)) (q - about) + offset(t)

linearly from key to key, or by the cubics of Fritsch and Carlson (1980), which have no corners and never overshoot a
key. Before the first key and after the last one the points rest.
"""

from __future__ import annotations

from functools import cached_property
from itertools import pairwise
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from harness.base.model import Model, Vector
from solvers.problem import Positions


class Key(Model):
    """Where the points are at one time."""

    time: float = Field(ge=0.0, le=1e9)
    """Simulated time [s]."""
    offset: Vector = (0.0, 0.0, 0.0)
    """Shift from where they were declared [m]."""
    turn: float = Field(default=0.0, ge=-1e9, le=1e9)
    """Turn about the axis [degrees]; more than 360 is more than once around."""


class KeyedMotion(Model):
    """A rigid motion along key frames."""

    keys: tuple[Key, ...] = Field(min_length=1, max_length=10_000)
    """The key frames, their times rising."""
    axis: Vector = (0.0, 1.0, 0.0)
    """The direction of the axis of turns, of any length but zero."""
    about: Vector = (0.0, 0.0, 0.0)
    """A point on that axis [m]."""
    between: Literal["linear", "smooth"] = "linear"
    """How the way leads from key to key: straight, or along cubics that stand still where it turns back."""

    @model_validator(mode="after")
    def _in_order(self) -> KeyedMotion:
        times = [key.time for key in self.keys]
        if any(b <= a for a, b in pairwise(times)):
            raise ValueError("the times of the keys should rise from key to key")
        if not any(self.axis):
            raise ValueError("the axis should have a direction; it is zero")
        return self

    @property
    def times(self) -> tuple[float, ...]:
        """The times of the keys [s]."""
        return tuple(key.time for key in self.keys)

    def moved(self, points: Positions, time: float) -> Positions:
        """Where points declared at (q, 3) [m] are at a time [s]."""
        *offset, turn = self._at(time)
        arm = points - self.about
        return points + offset + arm @ (_rotation(self.axis, np.deg2rad(turn)) - np.eye(3)).T

    def back(self, points: Positions, time: float) -> Positions:
        """Where points that are at (q, 3) [m] at a time [s] were declared."""
        *offset, turn = self._at(time)
        arm = points - offset - self.about
        return points - offset + arm @ (_rotation(self.axis, np.deg2rad(turn)) - np.eye(3))

    def velocity(self, points: Positions, time: float) -> Positions:
        """How fast points declared at (q, 3) [m] move at a time [s], and right after it at a key, (q, 3) [m/s]."""
        (*offset, rise), (*_, turn) = self._slope(time), self._at(time)
        arm = (points - self.about) @ _rotation(self.axis, np.deg2rad(turn)).T
        axis = np.array(self.axis) / np.linalg.norm(self.axis)
        return offset + np.deg2rad(rise) * np.cross(axis, arm)

    @property
    def straight(self) -> bool:
        """Whether points go along straight lines from key to key, each at one speed."""
        return self.between == "linear" and len({key.turn for key in self.keys}) == 1

    def speed(self, begin: float, end: float, points: Positions, *, slack: float = 0.0) -> float:
        """The largest speed [m/s], or more, of points (q, 3) [m], or of what is within `slack` [m] of where they are
        declared, between two times [s] that no key lies between."""
        times, values = self.table
        k = int(np.clip(np.searchsorted(times, begin, side="right"), 1, max(1, len(times) - 1)))
        if len(times) == 1 or begin >= times[-1] or end <= times[0]:
            return 0.0
        *offset, turn = np.abs(values[k] - values[k - 1]) / (times[k] - times[k - 1])
        arm = float(np.linalg.norm(points - self.about, axis=1).max(initial=0.0)) + slack
        return _STEEPEST[self.between] * (float(np.linalg.norm(offset)) + float(np.deg2rad(turn)) * arm)

    @cached_property
    def table(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The times [s] of the keys, and their offsets [m] and turns [degrees] (k, 4)."""
        return np.array(self.times), np.array([(*key.offset, key.turn) for key in self.keys])

    def _at(self, time: float) -> NDArray[np.float64]:
        """Offset [m] and turn [degrees] at a time [s], (4,)."""
        times, values = self.table
        t = float(np.clip(time, times[0], times[-1]))
        return values[0] if len(times) == 1 else _BETWEEN[self.between](times, values, t)

    def _slope(self, time: float) -> NDArray[np.float64]:
        """What offset [m/s] and turn [degrees/s] change by at a time [s], (4,)."""
        times, values = self.table
        if not times[0] <= time < times[-1]:
            return np.zeros(4)
        if self.between == "linear":
            k = int(np.searchsorted(times, time, side="right"))
            return (values[k] - values[k - 1]) / (times[k] - times[k - 1])
        from scipy.interpolate import PchipInterpolator

        return np.asarray(PchipInterpolator(times, values)(time, 1))


def _linear(times: NDArray[np.float64], values: NDArray[np.float64], t: float) -> NDArray[np.float64]:
    return np.array([cast(float, np.interp(t, times, column)) for column in values.T])


def _smooth(times: NDArray[np.float64], values: NDArray[np.float64], t: float) -> NDArray[np.float64]:
    from scipy.interpolate import PchipInterpolator  # a third of a second to import, for those who ask for it

    return np.asarray(PchipInterpolator(times, values)(t))


_STEEPEST = {"linear": 1.0, "smooth": 3.0}
"""The largest slope between two keys, in that of the straight line: Fritsch and Carlson's condition."""

_BETWEEN: dict[str, Any] = {"linear": _linear, "smooth": _smooth}


def _rotation(axis: Vector, angle: float) -> NDArray[np.float64]:
    """Rodrigues' formula, (3, 3)."""
    x, y, z = np.array(axis) / np.linalg.norm(axis)
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K
