"""Camera placement of a recording, and the strain colour scale shown below the mesh.

With x to the right, y up and z towards the camera, a point is visible from (cx, cy, D) where
    |x - cx| <= a h (D - z),    -b h (D - z) <= y - cy <= h (D - z),    h = tan(55 degrees / 2).

Here a is the aspect ratio (width over height) of the view, and b < 1 leaves space below for the colour scale. All
conditions are linear in cx, cy and D, so only four maxima over the points matter. They determine the nearest camera
that sees all points. Where that leaves space on two sides, h is scaled down in steps until it no longer does, which
centres the points. Among several directions, one in which the mesh fills the view well over all frames is selected.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from harness.record.framing import framed_vertices, outside_words
from harness.record.shading import LEVELS, palette, percent

_AROUND, _UP = 38.5, 20.8
"""Default azimuth and elevation of the camera [degrees]: from the side and slightly from above; y is up."""
_OTHERS = [(around, up) for around in (40, 20, 60, 80, -20, -40, -60, -80) for up in (15, 30, 40)]
_BETTER = 1.15
"""Factor by which another direction must improve the filled fraction, over all frames, to replace the default."""
_AS_GOOD = 0.97
"""Fraction of the best filled fraction that counts as equally good; the first such direction is selected."""

_HALF_VIEW = math.tan(math.radians(55 / 2))
"""The viewer's vertical field of view is 55 degrees."""

_BELOW = 0.72
"""b: the remainder of the lower half is reserved for the colour scale."""
_SCALE_AT, _SCALE_HEIGHT, _SCALE_WIDTH = -0.84, 0.035, 0.62
"""The colour scale's upper edge, its height and half its width, in half views."""

_WORD = 0.085
"""Offset of a label above its intended position, which compensates for the viewer's placement, in half views."""

_MARGIN = 1.04
_SHARES = np.linspace(0.2, 1.0, 5)
_NEAREST = 0.3
"""Minimum distance of the camera to the nearest point, as a fraction of the diagonal of the bounding box."""


_SUPPORTS = 32
"""Number of axes along which extreme vertices are selected; of more than twice as many vertices only those are used.
For vertices that fill a ball, the others lie at most 2 % further out."""


_LEAST = 1e-3
"""Minimum filled fraction of a view, assigned to a mesh seen as a line or as a point."""


class Extent:
    """Positions of some frames, and the camera that frames them (see `harness.record.framing`).

    Args:
      rest: rest positions (n, 3) [m].
      aspect: width of the view over its height.
      first: positions shown first (n, 3) [m]; the rest positions if omitted or not finite.
    """

    def __init__(
        self, rest: NDArray[np.floating], aspect: float = 1.0, *, first: NDArray[np.floating] | None = None
    ) -> None:
        start = rest if first is None or not np.isfinite(first).all() else first
        self._aspect, self._start = aspect, start.astype(np.float64)
        self._rest = rest.astype(np.float64)
        self._low, self._high = self._rest.min(axis=0), self._rest.max(axis=0)
        self._limit = 10 * np.linalg.norm(self._high - self._low)
        self._moved = np.zeros(len(start))
        self._seen = [_outermost(self._start, np.arange(len(start)))]
        self._sight: _Sight | None = None

    def add(self, p: NDArray[np.floating]) -> None:
        """Include positions (n, 3) [m], unless they have diverged too far to be shown."""
        p = p.astype(np.float64)
        if not np.isfinite(p).all():
            return
        moved = np.maximum(self._moved, np.linalg.norm(p - self._start, axis=1))
        near = np.flatnonzero(framed_vertices(self._start, moved))
        low, high = np.minimum(self._low, p[near].min(axis=0)), np.maximum(self._high, p[near].max(axis=0))
        if np.linalg.norm(high - low) <= self._limit:
            self._low, self._high, self._moved = low, high, moved
            self._seen.append(_outermost(p, near))
            self._sight = None

    def outside(self) -> list[str]:
        """Return a description of how many vertices are not framed; empty where all are."""
        return outside_words(framed_vertices(self._start, self._moved))

    def _best(self) -> _Sight:
        """Return the camera view that fills the view well over all frames."""
        if self._sight is None:
            near = framed_vertices(self._start, self._moved)
            seen = [p[near[which]] for which, p in self._seen if near[which].any()]
            if not near.all() and len(np.unique(np.concatenate(seen), axis=0)) == 1:  # of a point nothing has a size
                seen.append(self._start)
            around = np.ptp(np.concatenate([self._rest[near], *seen]), axis=0)
            least = _NEAREST * float(np.linalg.norm(around)) or 1.0  # of a single point
            first, *others = (_Sight(angles, self._aspect, seen, least) for angles in ((_AROUND, _UP), *_OTHERS))
            best = max(sight.filled for sight in others)
            better = next(sight for sight in others if sight.filled >= _AS_GOOD * best)
            self._sight = better if best > _BETTER * first.filled else first
        return self._sight

    def eye(self) -> rrb.EyeControls3D:
        """Return an orbiting camera that just sees all framed points, with space below them."""
        sight = self._best()
        x, y, distance = sight.place
        eye, target = ((x, y, z) @ sight.axes for z in (distance, (sight.near + sight.far) / 2))
        return rrb.EyeControls3D(kind=rrb.Eye3DKind.Orbital, position=eye, look_target=target, eye_up=(0, 1, 0))

    def scale(self, strain_range: float, ends: tuple[float, float] = (0.0, 0.0)) -> tuple[rr.Mesh3D, rr.Points3D]:
        """Build the strip of colours below the mesh, facing the camera, and its numbers.

        Args:
          strain_range: strain at the ends of the colour scale.
          ends: smallest and largest strain of a spring. Where one is outside the scale, the strip ends in a
            tip labelled with that strain.
        """
        sight = self._best()
        (x, y, distance), near = sight.place, sight.near
        half = _HALF_VIEW * (distance - near)
        width = _SCALE_WIDTH * half * min(1.0, self._aspect)
        across = [x - width + 2 * width * k / (LEVELS - 1) for k in range(LEVELS)]
        top = y + _SCALE_AT * half
        low = top - _SCALE_HEIGHT * half
        edges = np.array([[at, height, near] for at in across for height in (low, top)]) @ sight.axes
        first = 2 * np.arange(LEVELS - 1)[:, None, None]
        faces = (first + np.array([[0, 2, 1], [1, 2, 3]])).reshape(-1, 3)
        colours = np.repeat(palette()[:-1], 2, axis=0)
        words = [percent(strain_range * share) for share in (-1, -0.5, 0, 0.5, 1)]
        words[2] = "strain 0"
        marks = [[at, low, near] for at in across[:: (LEVELS - 1) // 4]]
        for k, way, end in ((0, -1, ends[0]), (len(across) - 1, 1, ends[1])):
            if way * end > strain_range:
                tip = [across[k] + way * 2 * (top - low), (low + top) / 2, near]
                edges = np.vstack([edges, tip @ sight.axes])
                faces = np.vstack([faces, [2 * k, 2 * k + 1, len(edges) - 1]])
                colours = np.vstack([colours, colours[2 * k]])
                marks.append([tip[0], top + _WORD * half, near])
                words.append(f"to {percent(end, 2)}")
        strip = rr.Mesh3D(vertex_positions=edges, triangle_indices=faces, vertex_colors=colours)
        return strip, rr.Points3D(
            np.array(marks) @ sight.axes,
            labels=words,
            show_labels=True,
            radii=rr.Radius.ui_points([1.0] * 5 + [0.1] * (len(words) - 5)),
            colors=(255, 255, 255),
        )


class _Sight:
    """The points of some frames, seen from one direction.

    Attributes:
      axes: unit vectors (3, 3) to the right, up and towards the camera.
      place: cx, cy and D [m].
      near: largest coordinate of the points towards the camera [m].
      far: smallest coordinate of the points towards the camera [m].
      filled: fraction of the view that the points of a frame span, as the geometric mean over the frames.
    """

    def __init__(
        self, angles: tuple[float, float], aspect: float, frames: Sequence[NDArray[np.floating]], least: float
    ) -> None:
        around, up = np.radians(angles)
        towards = np.array([np.sin(around) * np.cos(up), np.sin(up), np.cos(around) * np.cos(up)])
        right = np.cross((0, 1, 0), towards) / np.linalg.norm(np.cross((0, 1, 0), towards))
        self.axes = np.stack([right, np.cross(towards, right), towards])
        seen = [p @ self.axes.T for p in frames]
        points = np.concatenate(seen)
        self.near, self.far = float(points[:, 2].max()), float(points[:, 2].min())
        self.place = self._placed(points, aspect, least)
        self.filled = float(np.exp(np.mean(np.log([max(self._part(p, aspect), _LEAST) for p in seen]))))

    def _placed(self, points: NDArray[np.floating], aspect: float, least: float) -> tuple[float, float, float]:
        x, y, z = points.T[:, None]
        side, room = _SHARES[:, None] * aspect * _HALF_VIEW, _SHARES[:, None] * _HALF_VIEW
        right, left, up, down = (
            end.max(axis=1) for end in (x + side * z, side * z - x, y + room * z, _BELOW * room * z - y)
        )
        across, upright = 2 * aspect * _HALF_VIEW, (1 + _BELOW) * _HALF_VIEW
        distance = max((right[-1] + left[-1]) / across, (up[-1] + down[-1]) / upright)
        distance = self.near + max(_MARGIN * (distance - self.near), least)
        reach = _SHARES * _HALF_VIEW * distance
        return (
            _middle(right - aspect * reach, aspect * reach - left),
            _middle(up - reach, _BELOW * reach - down),
            float(distance),
        )

    def _part(self, p: NDArray[np.floating], aspect: float) -> float:
        x, y, distance = self.place
        at: NDArray[np.float64] = (p[:, :2] - (x, y)) / (_HALF_VIEW * (distance - p[:, 2:])) / (aspect, 1)
        across, upright = at.max(axis=0) - at.min(axis=0)
        return float(across * upright) / 4


def _outermost(p: NDArray[np.float64], of: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Return the vertices that are extreme along axes spread over all directions, and their positions."""
    if len(of) <= 2 * _SUPPORTS:
        return of, p[of]
    turn = np.arange(_SUPPORTS)
    up = (turn + 0.5) / _SUPPORTS  # of half a ball, in a spiral by the golden angle
    out, around = np.sqrt(1 - up**2), turn * np.pi * (3 - np.sqrt(5))
    along = p[of] @ np.stack([out * np.cos(around), up, out * np.sin(around)])
    which = of[np.unique([along.argmax(axis=0), along.argmin(axis=0)])]
    return which, p[which]


def _middle(low: NDArray[np.float64], high: NDArray[np.float64]) -> float:
    """Return the midpoint of the first non-empty interval."""
    first = int(np.argmax(low <= high))
    return float(low[first] + high[first]) / 2
