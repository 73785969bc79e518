"""Obstacle shapes in a recording: each shape once, and its pose in each frame.

Entities: `/scene/obstacles/<number>-<kind>`. Planes are infinite; only the part around the mesh is drawn.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

if TYPE_CHECKING:  # a scene without obstacles imports none of them
    from springbench.harness.scenes.key_frames import KeyFrameMotion
    from springbench.harness.scenes.primitive_obstacles import (
        BoxObstacle,
        CapsuleObstacle,
        PlaneObstacle,
        SphereObstacle,
    )
    from springbench.harness.scenes.surface_obstacles import AnySurface, MeshObstacle

Array = NDArray[np.float64]

_COLOUR = (0x9C, 0x97, 0x8D)
_PLANE_SIZE_FACTOR = 2.0
"""Half the side of the drawn part of a plane, relative to the mesh size plus its distance from the plane."""


class ObstacleRecorder:
    """Obstacles of an open recording.

    Args:
        stream: open recording.
        obstacles: declared obstacles.
        rest: rest positions of the mesh (n, 3) [m].
        origin: origin of the recorded positions (3,) [m].
    """

    def __init__(self, stream: rr.RecordingStream, obstacles: Sequence[AnySurface], rest: Array, origin: Array) -> None:
        self._stream, self._origin = stream, origin
        self._moving: list[tuple[str, KeyFrameMotion]] = []
        self._deforming: list[tuple[str, MeshObstacle]] = []
        for k, one in enumerate(obstacles):
            entity = f"/scene/obstacles/{k}-{one.kind}"
            if one.kind == "mesh" and one.frames:
                self._deforming.append((entity, one))
                continue
            stream.log(entity, _DRAW_SHAPE[one.kind](one, rest, origin), static=True)
            if one.motion:
                self._moving.append((entity, one.motion))

    def record_time(self, time: float) -> None:
        """Record the poses of moving obstacles at a time [s], on the current timelines."""
        for entity, motion in self._moving:
            base, *ends = motion.transform_points(self._origin + np.concatenate([np.zeros((1, 3)), np.eye(3)]), time)
            moved = rr.Transform3D(translation=base - self._origin, mat3x3=(np.array(ends) - base).T)
            self._stream.log(entity, moved)
        for entity, one in self._deforming:
            points, triangles = one.build_surface()
            self._stream.log(entity, _build_flat_mesh(one.place_points(points, time) - self._origin, triangles))


def _draw_sphere(one: SphereObstacle, rest: Array, origin: Array) -> rr.Ellipsoids3D:
    center = np.array(one.center) - origin
    return rr.Ellipsoids3D(centers=[center], radii=[one.radius], colors=[_COLOUR], fill_mode="solid")


def _draw_capsule(one: CapsuleObstacle, rest: Array, origin: Array) -> rr.Capsules3D:
    """Build a capsule.

    Rerun's capsule extends along z. It is rotated by 180 degrees about the bisector of z and the capsule's axis.
    """
    first, last = np.array(one.end_points)
    length = float(np.linalg.norm(last - first))
    half = (last - first) / length + [0.0, 0.0, 1.0]
    axis = half if np.linalg.norm(half) > 1e-9 else np.array([1.0, 0.0, 0.0])
    return rr.Capsules3D(
        lengths=[length],
        radii=[one.radius],
        translations=[first - origin],
        rotation_axis_angles=[rr.RotationAxisAngle(axis=axis, angle=rr.Angle(deg=180.0))],
        colors=[_COLOUR],
        fill_mode="solid",
    )


def _draw_box(one: BoxObstacle, rest: Array, origin: Array) -> rr.Boxes3D:
    sizes = np.subtract(one.high, one.low)
    return rr.Boxes3D(mins=[np.array(one.low) - origin], sizes=[sizes], colors=[_COLOUR], fill_mode="solid")


def _draw_plane(one: PlaneObstacle, rest: Array, origin: Array) -> rr.Mesh3D:
    """Build two triangles around the foot of the perpendicular from the mesh's centre."""
    foot, x, normal, z = one.model_copy(update={"motion": None}).build_obstacle().frame(0.0)
    middle = rest.mean(axis=0)
    height = float((middle - foot) @ normal)
    half = _PLANE_SIZE_FACTOR * (float(np.linalg.norm(np.ptp(rest, axis=0))) + abs(height))
    corners = middle - origin - height * normal + half * np.array([-x - z, z - x, x + z, x - z])
    faces = [[0, 1, 2], [0, 2, 3]]
    return rr.Mesh3D(
        vertex_positions=corners, triangle_indices=faces, vertex_normals=[normal] * 4, vertex_colors=[_COLOUR] * 4
    )


def _draw_mesh(one: MeshObstacle, rest: Array, origin: Array) -> rr.Mesh3D:
    """Build a mesh with separate vertices for each triangle, so that edges stay sharp."""
    points, triangles = one.build_surface()
    return _build_flat_mesh(points - origin, triangles)


def _build_flat_mesh(points: Array, triangles: NDArray[np.int64]) -> rr.Mesh3D:
    corners = points[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    return rr.Mesh3D(
        vertex_positions=corners.reshape(-1, 3),
        triangle_indices=np.arange(corners.size // 3).reshape(-1, 3),
        vertex_normals=np.repeat(normals, 3, axis=0),
        vertex_colors=[_COLOUR] * (corners.size // 3),
    )


_DRAW_SHAPE: dict[str, Callable[[Any, Array, Array], rr.AsComponents]] = {
    "sphere": _draw_sphere,
    "capsule": _draw_capsule,
    "box": _draw_box,
    "plane": _draw_plane,
    "mesh": _draw_mesh,
}
