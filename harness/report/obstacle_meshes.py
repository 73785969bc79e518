# pyright: reportUnknownMemberType=false
# PyVista's filters and meshes are only partly typed.
"""Drawable meshes of obstacles, at their positions at a given time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pyvista as pv
from numpy.typing import NDArray
from springbench.harness.recording.recorder_interface import OBSTACLES_PROPERTY, RecordingReplay
from springbench.harness.report.drawable_frames import framed_vertex_mask

if TYPE_CHECKING:  # a recording without obstacles imports none of them
    from springbench.harness.scenes.primitive_obstacles import (
        BoxObstacle,
        CapsuleObstacle,
        PlaneObstacle,
        SphereObstacle,
    )
    from springbench.harness.scenes.surface_obstacles import AnySurface, MeshObstacle

_ZERO_ORIGIN = np.zeros(3)
_GROUND_NORMAL_Y = 0.999
"""Planes whose unit normal has a larger y component are the ground, which pictures show by the shadow on it."""


def build_obstacle_meshes(replay: RecordingReplay, frame: int) -> list[pv.PolyData]:
    """Build the meshes of a recording's obstacles at the time of a recorded frame.

    Args:
        replay: recording, whose properties describe the obstacles.
        frame: index of a recorded frame; -1 is the last.

    Returns:
        The meshes of the obstacles that can be drawn; empty if the recording has none.
    """
    if OBSTACLES_PROPERTY not in replay.properties:
        return []
    from springbench.harness.scenes.surface_obstacles import parse_obstacles

    time, seen = float(replay.times[frame]), replay.positions[frame]
    made = (
        build_obstacle_mesh(one, time, seen, replay.origin)
        for one in parse_obstacles(str(replay.properties[OBSTACLES_PROPERTY]))
    )
    return [one for one in made if one is not None]


def points_to_frame(replay: RecordingReplay, frames: Sequence[int]) -> NDArray[np.float32]:
    """Return all points (q, 3) [m] of mesh and obstacles to be framed.

    Vertices far from all others are omitted. If the others coincide in one point, the whole mesh at its start is
    included.

    Args:
        replay: recording of mesh and obstacles.
        frames: indices of the recorded frames that one camera shows.
    """
    near = framed_vertex_mask(replay, frames)
    points = np.concatenate(
        [p for k in frames for p in (replay.positions[k][near], *(s.points for s in build_obstacle_meshes(replay, k)))]
    )
    return points if near.all() or np.ptp(points, axis=0).any() else np.concatenate([points, replay.positions[0]])


def build_obstacle_mesh(
    obstacle: AnySurface, time: float, framed_points: NDArray[np.floating], origin: NDArray[np.float64] = _ZERO_ORIGIN
) -> pv.PolyData | None:
    """Build the mesh of an obstacle at a time.

    Args:
        obstacle: obstacle of the scene.
        time: time [s].
        framed_points: points (q, 3) [m] relative to `origin`; of a plane only the part below them is built.
        origin: point that `framed_points` and the returned points are relative to (3,) [m].

    Returns:
        The mesh, or None for level ground at rest.
    """
    made = _MESH_MAKERS[obstacle.kind](obstacle, framed_points + origin)
    if made is None:
        return None
    points = np.asarray(made.points, np.float64)
    if obstacle.kind == "mesh":
        points = obstacle.place_points(points, time)
    elif obstacle.motion is not None:
        points = obstacle.motion.transform_points(points, time)
    made.points = points - origin
    return made


def _translate_mesh(shape: pv.PolyData, offset: Sequence[float] | NDArray[np.float64]) -> pv.PolyData:
    """Translate a mesh in double precision, because VTK's sources create points in single precision."""
    shape.points = np.asarray(shape.points, np.float64) + offset
    return shape


def _make_sphere(one: SphereObstacle, seen: NDArray[np.floating]) -> pv.PolyData:
    return _translate_mesh(pv.Sphere(radius=one.radius, theta_resolution=48, phi_resolution=32), one.center)


def _make_capsule(one: CapsuleObstacle, seen: NDArray[np.floating]) -> pv.PolyData:
    first, last = (np.array(end) for end in one.end_points)
    a, b = np.zeros(3), last - first
    bar = pv.Line(a, b).tube(radius=one.radius, n_sides=32, capping=False)
    balls = [pv.Sphere(radius=one.radius, center=end, theta_resolution=32, phi_resolution=24) for end in (a, b)]
    return _translate_mesh(cast(pv.PolyData, bar.merge(balls).extract_surface(algorithm=None)), first)


def _make_box(one: BoxObstacle, seen: NDArray[np.floating]) -> pv.PolyData:
    x, y, z = np.subtract(one.high, one.low)
    return _translate_mesh(pv.Box(bounds=(0, x, 0, y, 0, z)), one.low)


def _make_plane(one: PlaneObstacle, seen: NDArray[np.floating]) -> pv.PolyData | None:
    normal = np.array(one.normal) / np.linalg.norm(one.normal)
    if normal[1] > _GROUND_NORMAL_Y and one.motion is None:
        return None
    away = seen - np.array(one.point)
    foot = seen - (away @ normal)[:, None] * normal
    side = 1.3 * float(np.linalg.norm(np.ptp(foot, axis=0)))
    middle = (foot.min(axis=0) + foot.max(axis=0)) / 2.0
    return _translate_mesh(pv.Plane(center=(0, 0, 0), direction=normal, i_size=side, j_size=side), middle)


def _make_surface(one: MeshObstacle, seen: NDArray[np.floating]) -> pv.PolyData:
    points, triangles = one.build_surface()
    return pv.PolyData.from_regular_faces(points, triangles)


_MESH_MAKERS: dict[str, Callable[[Any, NDArray[np.floating]], pv.PolyData | None]] = {
    "sphere": _make_sphere,
    "capsule": _make_capsule,
    "box": _make_box,
    "plane": _make_plane,
    "mesh": _make_surface,
}
