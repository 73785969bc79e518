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
from springbench.harness.recording.camera_framing import describe_outside, find_framed_vertices
from springbench.harness.recording.strain_scale import NUM_LEVELS, build_palette, format_percent

_DEFAULT_AZIMUTH, _DEFAULT_ELEVATION = 38.5, 20.8
"""Default azimuth and elevation of the camera [degrees]: from the side and slightly from above; y is up."""
_OTHER_ANGLES = [(around, up) for around in (40, 20, 60, 80, -20, -40, -60, -80) for up in (15, 30, 40)]
_MIN_IMPROVEMENT = 1.15
"""Factor by which another direction must improve the filled fraction to replace the default."""
_EQUAL_FRACTION = 0.97
"""Fraction of the best filled fraction that counts as equally good; the first such direction is selected."""

_TAN_HALF_FOV = math.tan(math.radians(55 / 2))
"""The viewer's vertical field of view is 55 degrees."""

_LOWER_MARGIN = 0.72
"""b: the remainder of the lower half is reserved for the colour scale."""
_SCALE_POSITION, _SCALE_HEIGHT, _SCALE_WIDTH = -0.84, 0.035, 0.62
"""The colour scale's upper edge, its height and half its width, in half views."""

_LABEL_HEIGHT = 0.085
"""Offset of a label above its intended position, which compensates for the viewer's placement, in half views."""

_VIEW_MARGIN = 1.04
_DEPTH_SHARES = np.linspace(0.2, 1.0, 5)
_MIN_DISTANCE_FRACTION = 0.3
"""Minimum distance of the camera to the nearest point, as a fraction of the diagonal of the bounding box."""


_NUM_SUPPORTS = 32
"""Number of axes along which extreme vertices are selected; of more than twice as many vertices only those are used.
For vertices that fill a ball, the others lie at most 2 % further out."""


_MIN_EXTENT = 1e-3
"""Minimum filled fraction of a view, assigned to a mesh seen as a line or as a point."""


class ViewExtent:
    """Positions of some frames, and the camera that frames them (`springbench.harness.recording.camera_framing`).

    Args:
        rest: rest positions (n, 3) [m].
        aspect: width of the view over its height.
        initial_positions: positions shown first (n, 3) [m]; the rest positions if omitted or not finite.
    """

    def __init__(
        self, rest: NDArray[np.floating], aspect: float = 1.0, *, initial_positions: NDArray[np.floating] | None = None
    ) -> None:
        start = rest if initial_positions is None or not np.isfinite(initial_positions).all() else initial_positions
        self._aspect, self._start = aspect, start.astype(np.float64)
        self._rest = rest.astype(np.float64)
        self._low, self._high = self._rest.min(axis=0), self._rest.max(axis=0)
        self._limit = 10 * np.linalg.norm(self._high - self._low)
        self._moved = np.zeros(len(start))
        self._seen = [_select_support_points(self._start, np.arange(len(start)))]
        self._sight: _CameraView | None = None

    def add_positions(self, p: NDArray[np.floating]) -> None:
        """Include positions (n, 3) [m], unless they have diverged too far to be shown."""
        p = p.astype(np.float64)
        if not np.isfinite(p).all():
            return
        moved = np.maximum(self._moved, np.linalg.norm(p - self._start, axis=1))
        near = np.flatnonzero(find_framed_vertices(self._start, moved))
        low, high = np.minimum(self._low, p[near].min(axis=0)), np.maximum(self._high, p[near].max(axis=0))
        if np.linalg.norm(high - low) <= self._limit:
            self._low, self._high, self._moved = low, high, moved
            self._seen.append(_select_support_points(p, near))
            self._sight = None

    def describe_outside(self) -> list[str]:
        """Return a description of how many vertices are not framed; empty where all are."""
        return describe_outside(find_framed_vertices(self._start, self._moved))

    def _select_view(self) -> _CameraView:
        """Return the camera view that fills the view well over all frames."""
        if self._sight is None:
            near = find_framed_vertices(self._start, self._moved)
            seen = [p[near[which]] for which, p in self._seen if near[which].any()]
            if not near.all() and len(np.unique(np.concatenate(seen), axis=0)) == 1:  # a single point has no extent
                seen.append(self._start)
            around = np.ptp(np.concatenate([self._rest[near], *seen]), axis=0)
            least = _MIN_DISTANCE_FRACTION * float(np.linalg.norm(around)) or 1.0  # a single point has no diagonal
            first, *others = (
                _CameraView(angles, self._aspect, seen, least)
                for angles in ((_DEFAULT_AZIMUTH, _DEFAULT_ELEVATION), *_OTHER_ANGLES)
            )
            best = max(sight.filled for sight in others)
            better = next(sight for sight in others if sight.filled >= _EQUAL_FRACTION * best)
            self._sight = better if best > _MIN_IMPROVEMENT * first.filled else first
        return self._sight

    def build_eye_controls(self) -> rrb.EyeControls3D:
        """Return an orbiting camera that just sees all framed points, with space below them."""
        sight = self._select_view()
        x, y, distance = sight.place
        eye, target = ((x, y, z) @ sight.axes for z in (distance, (sight.near + sight.far) / 2))
        return rrb.EyeControls3D(kind=rrb.Eye3DKind.Orbital, position=eye, look_target=target, eye_up=(0, 1, 0))

    def build_colour_scale(
        self, strain_range: float, strain_limits: tuple[float, float] = (0.0, 0.0)
    ) -> tuple[rr.Mesh3D, rr.Points3D]:
        """Build the strip of colours below the mesh, facing the camera, and its numbers.

        Args:
            strain_range: strain at the ends of the colour scale.
            strain_limits: smallest and largest strain of a spring. Where one is outside the scale, the strip ends in a
                tip labelled with that strain.
        """
        sight = self._select_view()
        (x, y, distance), near = sight.place, sight.near
        half = _TAN_HALF_FOV * (distance - near)
        width = _SCALE_WIDTH * half * min(1.0, self._aspect)
        across = [x - width + 2 * width * k / (NUM_LEVELS - 1) for k in range(NUM_LEVELS)]
        top = y + _SCALE_POSITION * half
        low = top - _SCALE_HEIGHT * half
        edges = np.array([[at, height, near] for at in across for height in (low, top)]) @ sight.axes
        first = 2 * np.arange(NUM_LEVELS - 1)[:, None, None]
        faces = (first + np.array([[0, 2, 1], [1, 2, 3]])).reshape(-1, 3)
        colours = np.repeat(build_palette()[:-1], 2, axis=0)
        words = [format_percent(strain_range * share) for share in (-1, -0.5, 0, 0.5, 1)]
        words[2] = "strain 0"
        marks = [[at, low, near] for at in across[:: (NUM_LEVELS - 1) // 4]]
        for k, sign, end in ((0, -1, strain_limits[0]), (len(across) - 1, 1, strain_limits[1])):
            if sign * end > strain_range:
                tip = [across[k] + sign * 2 * (top - low), (low + top) / 2, near]
                edges = np.vstack([edges, tip @ sight.axes])
                faces = np.vstack([faces, [2 * k, 2 * k + 1, len(edges) - 1]])
                colours = np.vstack([colours, colours[2 * k]])
                marks.append([tip[0], top + _LABEL_HEIGHT * half, near])
                words.append(f"to {format_percent(end, 2)}")
        strip = rr.Mesh3D(vertex_positions=edges, triangle_indices=faces, vertex_colors=colours)
        return strip, rr.Points3D(
            np.array(marks) @ sight.axes,
            labels=words,
            show_labels=True,
            radii=rr.Radius.ui_points([1.0] * 5 + [0.1] * (len(words) - 5)),
            colors=(255, 255, 255),
        )


class _CameraView:
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
        self.place = self._compute_place(points, aspect, least)
        self.filled = float(np.exp(np.mean(np.log([max(self._filled_fraction(p, aspect), _MIN_EXTENT) for p in seen]))))

    def _compute_place(self, points: NDArray[np.floating], aspect: float, least: float) -> tuple[float, float, float]:
        x, y, z = points.T[:, None]
        side, room = _DEPTH_SHARES[:, None] * aspect * _TAN_HALF_FOV, _DEPTH_SHARES[:, None] * _TAN_HALF_FOV
        right, left, up, down = (
            end.max(axis=1) for end in (x + side * z, side * z - x, y + room * z, _LOWER_MARGIN * room * z - y)
        )
        across, upright = 2 * aspect * _TAN_HALF_FOV, (1 + _LOWER_MARGIN) * _TAN_HALF_FOV
        distance = max((right[-1] + left[-1]) / across, (up[-1] + down[-1]) / upright)
        distance = self.near + max(_VIEW_MARGIN * (distance - self.near), least)
        reach = _DEPTH_SHARES * _TAN_HALF_FOV * distance
        return (
            _find_interval_middle(right - aspect * reach, aspect * reach - left),
            _find_interval_middle(up - reach, _LOWER_MARGIN * reach - down),
            float(distance),
        )

    def _filled_fraction(self, p: NDArray[np.floating], aspect: float) -> float:
        x, y, distance = self.place
        at: NDArray[np.float64] = (p[:, :2] - (x, y)) / (_TAN_HALF_FOV * (distance - p[:, 2:])) / (aspect, 1)
        across, upright = at.max(axis=0) - at.min(axis=0)
        return float(across * upright) / 4


def _select_support_points(
    p: NDArray[np.float64], of: NDArray[np.intp]
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Return the vertices that are extreme along axes spread over all directions, and their positions."""
    if len(of) <= 2 * _NUM_SUPPORTS:
        return of, p[of]
    turn = np.arange(_NUM_SUPPORTS)
    up = (turn + 0.5) / _NUM_SUPPORTS  # directions over half a ball, in a spiral by the golden angle
    out, around = np.sqrt(1 - up**2), turn * np.pi * (3 - np.sqrt(5))
    along = p[of] @ np.stack([out * np.cos(around), up, out * np.sin(around)])
    which = of[np.unique([along.argmax(axis=0), along.argmin(axis=0)])]
    return which, p[which]


def _find_interval_middle(low: NDArray[np.float64], high: NDArray[np.float64]) -> float:
    """Return the midpoint of the first non-empty interval."""
    first = int(np.argmax(low <= high))
    return float(low[first] + high[first]) / 2
