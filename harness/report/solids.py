# pyright: reportUnknownMemberType=false
# PyVista's filters and meshes are known in part.
"""Obstacles as meshes that can be drawn, where they are at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pyvista as pv
from numpy.typing import NDArray

from harness.record.base import Replay
from harness.record.obstacles import KEY

if TYPE_CHECKING:  # a recording without obstacles imports none of them
    from harness.scenes.obstacles import Box, Capsule, Plane, Sphere
    from harness.scenes.shapes import AnySurface, Solid

_LEVEL = 0.999
"""Planes whose normal is as upright as this are the ground, which pictures show by the shadow on it."""


def solids(replay: Replay, frame: int) -> list[pv.PolyData]:
    """The obstacles of a recording, where they are in a recorded frame."""
    if KEY not in replay.properties:
        return []
    from harness.scenes.shapes import from_json

    time, seen = float(replay.times[frame]), replay.positions[frame]
    made = (solid(one, time, seen) for one in from_json(str(replay.properties[KEY])))
    return [one for one in made if one is not None]


def seen(replay: Replay, frames: Iterable[int]) -> NDArray[np.float32]:
    """All points (q, 3) [m] of the mesh and of the obstacles in recorded frames: what a camera should see."""
    return np.concatenate([p for k in frames for p in (replay.positions[k], *(s.points for s in solids(replay, k)))])


def solid(obstacle: AnySurface, time: float, seen: NDArray[np.floating]) -> pv.PolyData | None:
    """The obstacle at a time [s]; of a plane the part below the points `seen` (q, 3) [m]; None for the level ground."""
    made = _MADE[obstacle.kind](obstacle, seen)
    if obstacle.kind == "mesh" and made is not None:
        made.points = obstacle.placed(np.asarray(made.points, np.float64), time)
    elif made is not None and obstacle.motion is not None:
        made.points = obstacle.motion.moved(np.asarray(made.points, np.float64), time)
    return made


def _sphere(one: Sphere, seen: NDArray[np.floating]) -> pv.PolyData:
    return pv.Sphere(radius=one.radius, center=one.center, theta_resolution=48, phi_resolution=32)


def _capsule(one: Capsule, seen: NDArray[np.floating]) -> pv.PolyData:
    a, b = (np.array(end) for end in one.ends)
    bar = pv.Line(a, b).tube(radius=one.radius, n_sides=32, capping=False)
    balls = [pv.Sphere(radius=one.radius, center=end, theta_resolution=32, phi_resolution=24) for end in one.ends]
    return cast(pv.PolyData, bar.merge(balls).extract_surface(algorithm=None))


def _box(one: Box, seen: NDArray[np.floating]) -> pv.PolyData:
    (a, b, c), (d, e, f) = one.low, one.high
    return pv.Box(bounds=(a, d, b, e, c, f))


def _plane(one: Plane, seen: NDArray[np.floating]) -> pv.PolyData | None:
    normal = np.array(one.normal) / np.linalg.norm(one.normal)
    if normal[1] > _LEVEL and one.motion is None:
        return None
    away = seen - np.array(one.point)
    foot = seen - (away @ normal)[:, None] * normal
    side = 1.3 * float(np.linalg.norm(np.ptp(foot, axis=0)))
    middle = (foot.min(axis=0) + foot.max(axis=0)) / 2.0
    return pv.Plane(center=middle, direction=normal, i_size=side, j_size=side)


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
