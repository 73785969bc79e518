# pyright: reportUnknownMemberType=false
# PyVista's filters and meshes are only partly typed.
"""Drawable meshes of obstacles, at their positions at a given time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pyvista as pv
from numpy.typing import NDArray

from harness.record.base import Replay
from harness.record.framing import framed_vertices
from harness.record.obstacles import KEY

if TYPE_CHECKING:  # a recording without obstacles imports none of them
    from harness.scenes.obstacles import Box, Capsule, Plane, Sphere
    from harness.scenes.shapes import AnySurface, Solid

_ZERO = np.zeros(3)
_LEVEL = 0.999
"""Planes whose unit normal has a larger y component are the ground, which pictures show by the shadow on it."""


def solids(replay: Replay, frame: int) -> list[pv.PolyData]:
    """Build the meshes of a recording's obstacles at the time of a recorded frame."""
    if KEY not in replay.properties:
        return []
    from harness.scenes.shapes import from_json

    time, seen = float(replay.times[frame]), replay.positions[frame]
    made = (solid(one, time, seen, replay.origin) for one in from_json(str(replay.properties[KEY])))
    return [one for one in made if one is not None]


def framed(replay: Replay, frames: Iterable[int]) -> NDArray[np.bool_]:
    """Return the mask (n,) of the vertices that a camera frames in these recorded frames."""
    start = replay.positions[0].astype(np.float64)
    moved = [np.linalg.norm(replay.positions[k] - start, axis=1) for k in frames]
    return framed_vertices(start, np.max(moved, axis=0))


def seen(replay: Replay, frames: Sequence[int]) -> NDArray[np.float32]:
    """Return all points (q, 3) [m] of mesh and obstacles to be framed.

    Vertices far from all others are omitted. If the others coincide in one point, the whole mesh at its start is
    included.
    """
    near = framed(replay, frames)
    points = np.concatenate(
        [p for k in frames for p in (replay.positions[k][near], *(s.points for s in solids(replay, k)))]
    )
    return points if near.all() or np.ptp(points, axis=0).any() else np.concatenate([points, replay.positions[0]])


def solid(
    obstacle: AnySurface, time: float, seen: NDArray[np.floating], origin: NDArray[np.float64] = _ZERO
) -> pv.PolyData | None:
    """Build the mesh of an obstacle at a time.

    Args:
        obstacle: shape of the scene.
        time: time [s].
        seen: points (q, 3) [m] relative to `origin`; of a plane only the part below them is built.
        origin: point that `seen` and the returned points are relative to (3,) [m].
    Returns: the mesh, or None for the level ground.
    """
    made = _MADE[obstacle.kind](obstacle, seen + origin)
    if made is None:
        return None
    points = np.asarray(made.points, np.float64)
    if obstacle.kind == "mesh":
        points = obstacle.placed(points, time)
    elif obstacle.motion is not None:
        points = obstacle.motion.moved(points, time)
    made.points = points - origin
    return made


def _shifted(shape: pv.PolyData, by: Sequence[float] | NDArray[np.float64]) -> pv.PolyData:
    """Translate a mesh in double precision, because VTK's sources create points in single precision."""
    shape.points = np.asarray(shape.points, np.float64) + by
    return shape


def _sphere(one: Sphere, seen: NDArray[np.floating]) -> pv.PolyData:
    return _shifted(pv.Sphere(radius=one.radius, theta_resolution=48, phi_resolution=32), one.center)


def _capsule(one: Capsule, seen: NDArray[np.floating]) -> pv.PolyData:
    first, last = (np.array(end) for end in one.ends)
    a, b = np.zeros(3), last - first
    bar = pv.Line(a, b).tube(radius=one.radius, n_sides=32, capping=False)
    balls = [pv.Sphere(radius=one.radius, center=end, theta_resolution=32, phi_resolution=24) for end in (a, b)]
    return _shifted(cast(pv.PolyData, bar.merge(balls).extract_surface(algorithm=None)), first)


def _box(one: Box, seen: NDArray[np.floating]) -> pv.PolyData:
    x, y, z = np.subtract(one.high, one.low)
    return _shifted(pv.Box(bounds=(0, x, 0, y, 0, z)), one.low)


def _plane(one: Plane, seen: NDArray[np.floating]) -> pv.PolyData | None:
    normal = np.array(one.normal) / np.linalg.norm(one.normal)
    if normal[1] > _LEVEL and one.motion is None:
        return None
    away = seen - np.array(one.point)
    foot = seen - (away @ normal)[:, None] * normal
    side = 1.3 * float(np.linalg.norm(np.ptp(foot, axis=0)))
    middle = (foot.min(axis=0) + foot.max(axis=0)) / 2.0
    return _shifted(pv.Plane(center=(0, 0, 0), direction=normal, i_size=side, j_size=side), middle)


def _mesh(one: Solid, seen: NDArray[np.floating]) -> pv.PolyData:
    points, triangles = one.shape()
    return pv.PolyData.from_regular_faces(points, triangles)


_MADE: dict[str, Callable[[Any, NDArray[np.floating]], pv.PolyData | None]] = {
    "sphere": _sphere,
    "capsule": _capsule,
    "box": _box,
    "plane": _plane,
    "mesh": _mesh,
}
