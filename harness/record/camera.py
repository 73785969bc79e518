"""Where the camera of a recording stands, and the scale of strain that it sees below the mesh.

With x to the right, y up and z towards the camera, a point is seen from (cx, cy, D) where

    |x - cx| <= a h (D - z),    -b h (D - z) <= y - cy <= h (D - z),    h = tan(55 degrees / 2),

a the view's width over its height, and b < 1 for what stays free below. All are linear in cx, cy and D: of the points
only four maxima count, and the nearest camera that sees all of them follows. Where that leaves room on two sides, h is
replaced by smaller shares of it until it does not, so that the points stand in the middle.
"""

from __future__ import annotations

import math

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from harness.record.shading import LEVELS, palette, percent

_DIRECTION = np.array([0.62, 0.38, 0.78]) / np.linalg.norm([0.62, 0.38, 0.78])
"""From where the camera looks: a little from above and from the side, y is up."""

_RIGHT = np.cross((0, 1, 0), _DIRECTION) / np.linalg.norm(np.cross((0, 1, 0), _DIRECTION))
_AXES = np.stack([_RIGHT, np.cross(_DIRECTION, _RIGHT), _DIRECTION])

_HALF_VIEW = math.tan(math.radians(55 / 2))
"""The viewer's angle of view is 55 degrees, from bottom to top."""

_BELOW = 0.72
"""b: the rest of the lower half is the scale's."""
_SCALE_AT, _SCALE_HEIGHT, _SCALE_WIDTH = -0.84, 0.035, 0.62
"""The scale's upper edge, its height, and half its width, in half views."""

_WORD = 0.085
"""How far above its place the viewer is given a word that is to stand there."""

_MARGIN = 1.04
_SHARES = np.linspace(0.2, 1.0, 5)
_NEAREST = 0.3
"""How near the camera comes to the nearest point, in the diagonal of the box."""


class Extent:
    """The box that the positions stay in, and what of them a camera must see.

    aspect: of the view, its width over its height; first: what is seen first, the positions at rest if left out
    or not finite.
    """

    def __init__(
        self, rest: NDArray[np.floating], aspect: float = 1.0, *, first: NDArray[np.floating] | None = None
    ) -> None:
        self._low, self._high, self._aspect = rest.min(axis=0), rest.max(axis=0), aspect
        self._limit = 10 * np.linalg.norm(self._high - self._low)
        side, room = np.outer(_SHARES, [aspect * _HALF_VIEW, _HALF_VIEW]).T
        zero, one = np.zeros(len(_SHARES)), np.ones(len(_SHARES))
        right, left = np.array([one, zero, side]), np.array([-one, zero, side])
        up, down = np.array([zero, one, room]), np.array([zero, -one, _BELOW * room])
        self._directions = np.hstack([right, left, up, down, [[0, 0], [0, 0], [1, -1]]]).T @ _AXES
        self._ends = np.full(len(self._directions), -np.inf)
        self._see(rest if first is None or not np.isfinite(first).all() else first)

    def add(self, p: NDArray[np.floating]) -> None:
        """Widen the box to positions (n, 3) [m], unless they have blown up beyond showing."""
        low, high = np.minimum(self._low, p.min(axis=0)), np.maximum(self._high, p.max(axis=0))
        if np.linalg.norm(high - low) <= self._limit:
            self._low, self._high = low, high
            self._see(p)

    def _see(self, p: NDArray[np.floating]) -> None:
        ends = [float((p @ direction).max()) for direction in self._directions]
        self._ends = np.maximum(self._ends, ends)

    def _camera(self) -> tuple[float, float, float]:
        """cx, cy and D."""
        right, left, up, down = self._ends[:-2].reshape(4, -1)
        near, side, room = self._ends[-2], 2 * self._aspect * _HALF_VIEW, (1 + _BELOW) * _HALF_VIEW
        distance = max((right[-1] + left[-1]) / side, (up[-1] + down[-1]) / room)
        least = _NEAREST * float(np.linalg.norm(self._high - self._low)) or 1.0  # of a single point
        distance = near + max(_MARGIN * (distance - near), least)
        reach = _SHARES * _HALF_VIEW * distance
        return (
            _middle(right - self._aspect * reach, self._aspect * reach - left),
            _middle(up - reach, _BELOW * reach - down),
            distance,
        )

    def eye(self) -> rrb.EyeControls3D:
        """An orbiting eye that just sees all of it, and has room below."""
        x, y, distance = self._camera()
        middle = (self._ends[-2] - self._ends[-1]) / 2
        eye, target = ((x, y, z) @ _AXES for z in (distance, middle))
        return rrb.EyeControls3D(kind=rrb.Eye3DKind.Orbital, position=eye, look_target=target, eye_up=(0, 1, 0))

    def scale(self, strain_range: float, ends: tuple[float, float] = (0.0, 0.0)) -> tuple[rr.Mesh3D, rr.Points3D]:
        """The strip of colours in the room below, facing the camera, and its numbers.

        ends: the smallest and the largest strain of a spring; where the strip does not reach one it ends in a tip, with
        that figure.
        """
        x, y, distance = self._camera()
        near = self._ends[-2]
        half = _HALF_VIEW * (distance - near)
        width = _SCALE_WIDTH * half * min(1.0, self._aspect)
        across = [x - width + 2 * width * k / (LEVELS - 1) for k in range(LEVELS)]
        top = y + _SCALE_AT * half
        low = top - _SCALE_HEIGHT * half
        edges = np.array([[at, height, near] for at in across for height in (low, top)]) @ _AXES
        first = 2 * np.arange(LEVELS - 1)[:, None, None]
        faces = (first + np.array([[0, 2, 1], [1, 2, 3]])).reshape(-1, 3)
        colours = np.repeat(palette()[:-1], 2, axis=0)
        words = [percent(strain_range * share) for share in (-1, -0.5, 0, 0.5, 1)]
        words[2] = "strain 0"
        marks = [[at, low, near] for at in across[:: (LEVELS - 1) // 4]]
        for k, way, end in ((0, -1, ends[0]), (len(across) - 1, 1, ends[1])):
            if way * end > strain_range:
                tip = [across[k] + way * 2 * (top - low), (low + top) / 2, near]
                edges = np.vstack([edges, tip @ _AXES])
                faces = np.vstack([faces, [2 * k, 2 * k + 1, len(edges) - 1]])
                colours = np.vstack([colours, colours[2 * k]])
                marks.append([tip[0], top + _WORD * half, near])
                words.append(f"to {percent(end, 2)}")
        strip = rr.Mesh3D(vertex_positions=edges, triangle_indices=faces, vertex_colors=colours)
        return strip, rr.Points3D(
            np.array(marks) @ _AXES,
            labels=words,
            show_labels=True,
            radii=rr.Radius.ui_points([1.0] * 5 + [0.1] * (len(words) - 5)),
            colors=(255, 255, 255),
        )


def _middle(low: NDArray[np.float64], high: NDArray[np.float64]) -> float:
    """The middle of the first of these intervals that is one."""
    first = int(np.argmax(low <= high))
    return float(low[first] + high[first]) / 2
