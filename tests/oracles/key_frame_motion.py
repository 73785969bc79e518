"""Reference implementation of key-frame motion, with the axis k and the angle a of a rotation.

    q(t) = about + R (q - about) + offset,   R v = v cos a + k x v sin a + k (k.v)(1 - cos a)

Interpolation between keys is linear, or by monotone cubics (Fritsch and Carlson 1980, with the slopes of Fritsch and
Butland 1984).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, cast

import numpy as np

from tests.oracles.complex_step import EPS, ExtendedArray, to_extended

_PI = 4 * np.arctan(np.longdouble(1))


class RigidPlacement(NamedTuple):
    """A rigid motion at one time.

    Attributes:
      rotation: R (3, 3).
      axis_point: a point on its axis (3,) [m].
      offset: translation (3,) [m].
    """

    rotation: ExtendedArray
    axis_point: ExtendedArray
    offset: ExtendedArray

    def transform(self, q: ExtendedArray) -> ExtendedArray:
        """Transform points declared at q (m, 3) [m] to their present positions."""
        return self.axis_point + (q - self.axis_point) @ self.rotation.T + self.offset

    def inverse_transform(self, x: ExtendedArray) -> ExtendedArray:
        """Transform points at x (m, 3) [m] to their declared positions."""
        return self.axis_point + (x - self.offset - self.axis_point) @ self.rotation


_IDENTITY = RigidPlacement(to_extended(np.eye(3)), to_extended(np.zeros(3)), to_extended(np.zeros(3)))


def place_at(motion: Any, time: float) -> RigidPlacement:
    """Evaluate a motion (None: none) at a time [s]."""
    if motion is None:
        return _IDENTITY
    times = to_extended([key.time for key in motion.key_frames])
    values = to_extended([(*key.offset, key.angle) for key in motion.key_frames])
    *offset, turn = _interpolate_keys(
        times, values, min(max(to_extended(time), times[0]), times[-1]), motion.interpolation
    )
    k, angle = to_extended(motion.axis), np.remainder(turn, 360) * _PI / 180
    k = k / np.sqrt(k @ k)
    cos, sin = np.cos(angle), np.sin(angle)
    columns = [e * cos + np.cross(k, e) * sin + k * (k @ e) * (1 - cos) for e in np.eye(3)]
    return RigidPlacement(np.stack(columns, axis=1), to_extended(motion.pivot), to_extended(offset))


def velocity_at(motion: Any, q: ExtendedArray, time: float) -> ExtendedArray:
    """Return the velocity (3,) [m/s] of a point; right-sided at a key.

    Args:
      motion: key frames, None for none.
      q: declared point (3,) [m].
      time: time [s].
    """
    times = to_extended([key.time for key in motion.key_frames]) if motion else to_extended([0])
    if len(times) == 1 or not times[0] <= time < times[-1]:
        return to_extended([0, 0, 0])
    values, t = to_extended([(*key.offset, key.angle) for key in motion.key_frames]), to_extended(time)
    k = min(int(np.searchsorted(times, t, side="right")) - 1, len(times) - 2)
    h = times[k + 1] - times[k]
    steep = (values[k + 1] - values[k]) / h
    if motion.interpolation == "smooth":
        s = (t - times[k]) / h
        a, b = (np.array([_cubic_slope(times, column, j) for column in values.T]) for j in (k, k + 1))
        steep = 6 * s * (1 - s) * steep + a * (1 - s) * (1 - 3 * s) + b * s * (3 * s - 2)
    axis = to_extended(motion.axis)
    arm = place_at(motion, time).rotation @ (q - to_extended(motion.pivot))
    return steep[:3] + steep[3] * _PI / 180 * np.cross(axis / np.sqrt(axis @ axis), arm)


def bound_roundoff(motion: Any, size: float, time: float) -> float:
    """Bound the round-off [m] of moved points.

    Args:
      motion: key frames, None for none.
      size: distance [m] from zero within which the points are.
      time: time [s].
    """
    if motion is None:
        return EPS * size
    keys: list[Any] = list(motion.key_frames)
    times, turns = [float(key.time) for key in keys], [float(key.angle) for key in keys]
    values = np.array([(*key.offset, np.deg2rad(key.angle)) for key in motion.key_frames])
    arm = size + float(np.abs(motion.pivot).max())
    steep = np.abs(np.diff(values, axis=0) / np.diff(times)[:, None]).max(axis=0, initial=0.0)
    far = arm + float(np.abs(values[:, :3]).max()) + arm * math.radians(max(map(abs, turns)))
    return EPS * (far + max(time, *times) * (steep[:3].max() + arm * steep[3]))


def _interpolate_keys(times: ExtendedArray, values: ExtendedArray, t: Any, how: str) -> ExtendedArray:
    """Interpolate offset [m] and rotation angle [degrees] at t, (4,)."""
    if len(times) == 1:
        return values[0]
    k = min(int(cast(int, np.searchsorted(times, t, side="right"))) - 1, len(times) - 2)
    h = times[k + 1] - times[k]
    s = (t - times[k]) / h
    if how == "linear":
        return values[k] + s * (values[k + 1] - values[k])
    a, b = (np.array([_cubic_slope(times, column, j) for column in values.T]) * h for j in (k, k + 1))
    ease = s * s * (3 - 2 * s)
    return values[k] * (1 - ease) + values[k + 1] * ease + a * s * (1 - s) ** 2 - b * s * s * (1 - s)


def _cubic_slope(times: ExtendedArray, y: ExtendedArray, j: int) -> Any:
    """Return the cubics' slope at key j: a weighted harmonic mean, zero at an extremum."""
    h, last = np.diff(times), len(times) - 1
    rise = np.diff(y) / h
    if last == 1:
        return rise[0]
    if 0 < j < last:
        if rise[j - 1] * rise[j] <= 0:
            return np.longdouble(0)
        one, two = 2 * h[j] + h[j - 1], h[j] + 2 * h[j - 1]
        return (one + two) / (one / rise[j - 1] + two / rise[j])
    near, far = (0, 1) if j == 0 else (last - 1, last - 2)
    end = ((2 * h[near] + h[far]) * rise[near] - h[near] * rise[far]) / (h[near] + h[far])
    if np.sign(end) != np.sign(rise[near]):
        return np.longdouble(0)
    if np.sign(rise[near]) != np.sign(rise[far]) and abs(end) > 3 * abs(rise[near]):
        return 3 * rise[near]
    return end
