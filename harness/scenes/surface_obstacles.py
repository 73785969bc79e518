"""Obstacle surfaces as triangles: meshes, and triangulations of planes, spheres, capsules and boxes."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    Field,
    SerializerFunctionWrapHandler,
    TypeAdapter,
    ValidationInfo,
    field_validator,
    model_serializer,
    model_validator,
)
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.execution.npz_reader import read_npz_array
from springbench.harness.scenes.key_frames import KeyFrameMotion
from springbench.harness.scenes.mesh.body_mesh import BodyMesh
from springbench.harness.scenes.mesh.file_mesh import FileMesh
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.scenes.mesh.mesh_topology import build_capped_triangles
from springbench.harness.scenes.mesh.solid_meshes import BlockMesh
from springbench.harness.scenes.mesh.spring_network import MAX_COORDINATE
from springbench.harness.scenes.mesh.surface_meshes import BalloonMesh, SkirtMesh
from springbench.harness.scenes.primitive_obstacles import BoxObstacle, CapsuleObstacle, PlaneObstacle, SphereObstacle
from springbench.harness.schema.base_model import ConfigModel, Vector3

if TYPE_CHECKING:
    from springbench.solvers.model.step_problem import Positions

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]
SurfaceMesh = tuple[FloatArray, IndexArray]
"""Points (o, 3) [m] and triangles (f, 3)."""
PositiveScale = Annotated[float, Field(ge=1e-6, le=1e6)]
"""A factor or a rate from 1e-6 to 1e6."""


class TriangleSurface(ConfigModel):
    """An inline surface."""

    kind: Literal["triangles"] = "triangles"
    points: tuple[Vector3, ...] = Field(min_length=3)
    """Points [m]."""
    triangles: tuple[tuple[int, int, int], ...] = Field(min_length=1)
    """Three zero-based point indices each."""

    @field_validator("triangles")
    @classmethod
    def _check_triangle_indices(cls, triangles: tuple[tuple[int, int, int], ...], info: ValidationInfo) -> Any:
        n = len(info.data.get("points", ())) or np.inf  # invalid points are reported separately
        for k, corners in enumerate(triangles):
            if not all(0 <= i < n for i in corners) or len(set(corners)) < 3:
                raise ValueError(f"number {k} is {corners}; expected three different points from 0 to {n - 1}")
        return triangles


class RecordedFrames(ConfigModel):
    """Recorded positions of a mesh's points at a fixed frame rate, linearly interpolated.

    Before the first frame and after the last one the points are at rest.
    """

    positions: Path | tuple[tuple[Vector3, ...], ...]
    """An .npz with `positions` (frames, points, 3) [m], as `springbench run --positions` writes it; or inline."""
    frame_rate: PositiveScale = 60.0
    """Frames per second."""
    start_time: float = Field(default=0.0, ge=0.0, le=1e9)
    """Time of the first frame [s]."""

    @cached_property
    def frame_positions(self) -> FloatArray:
        """Positions of all frames (frames, points, 3) [m], read on first use; raise InputError on failure."""
        path = self.positions if isinstance(self.positions, Path) else None
        found = read_npz_array(path, "positions") if path else np.array(self.positions)
        if found.ndim != 3 or found.shape[2] != 3 or not found.size or not (np.abs(found) <= MAX_COORDINATE).all():
            expected = f"expected numbers up to {MAX_COORDINATE:g} m of shape (frames, points, 3)"
            problem = f"got positions {found.shape}; {expected}"
            raise InputError(InputMistake(problem, path) if path else f"frames: {problem}")
        return found

    def interpolate_positions(self, time: float) -> FloatArray:
        """Interpolate the positions at a time [s], (points, 3) [m]."""
        frame = min(max((time - self.start_time) * self.frame_rate, 0.0), len(self.frame_positions) - 1.0)
        k = min(int(frame), max(len(self.frame_positions) - 2, 0))
        one, part = self.frame_positions[k], frame - k
        return one if part == 0.0 else one + part * (self.frame_positions[k + 1] - one)


ObstacleMeshSource = Annotated[
    BalloonMesh | BlockMesh | BodyMesh | FileMesh | GridMesh | SkirtMesh | TriangleSurface,
    Field(discriminator="kind"),
]


class MeshObstacle(ConfigModel):
    """A mesh obstacle; its triangles are impenetrable from either side, closed or not."""

    kind: Literal["mesh"] = "mesh"
    mesh: ObstacleMeshSource
    """A mesh from a file, from a generator, or inline as `triangles`."""
    size: Annotated[int, Field(ge=2, le=10_000)] = 24
    """Mesh size, ignored for a mesh from a file."""
    scale: PositiveScale = 1.0
    """Factor of all coordinates of the mesh."""
    offset: Vector3 = (0.0, 0.0, 0.0)
    """Translation after scaling [m]."""
    motion: KeyFrameMotion | None = None
    """Key frames of the obstacle's motion."""
    frames: RecordedFrames | None = None
    """Frames with recorded positions of its points: the obstacle deforms, in addition to its key frames."""

    @field_validator("mesh")
    @classmethod
    def _resolve_mesh_path(cls, mesh: Any, info: ValidationInfo) -> Any:
        """Resolve file names relative to the config's folder."""
        return mesh.model_copy(update={"path": _resolve_path(mesh.path, info)}) if isinstance(mesh, FileMesh) else mesh

    @field_validator("frames")
    @classmethod
    def _resolve_frames_path(cls, frames: RecordedFrames | None, info: ValidationInfo) -> RecordedFrames | None:
        if frames is None or not isinstance(frames.positions, Path):
            return frames
        return frames.model_copy(update={"positions": _resolve_path(frames.positions, info)})

    @model_validator(mode="after")
    def _check_readable(self) -> MeshObstacle:
        """Read files during validation, because a mistake found during serialisation has no location."""
        if isinstance(self.mesh, FileMesh) or self.frames:
            try:
                self.build_surface()
            except InputError as error:
                raise ValueError("; ".join(map(str, error.mistakes))) from None
        return self

    @model_serializer(mode="wrap")
    def _dump_contents(self, dump: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Dump the contents of files, which define the obstacle and which a recording must contain."""
        contents: dict[str, Any] = dump(self)
        if self.frames is None:
            contents.pop("frames", None)  # absent if None values were excluded
        else:
            moved = self.scale * self.frames.frame_positions + np.array(self.offset)
            contents["frames"]["positions"] = moved.tolist()
        if isinstance(self.mesh, FileMesh) or self.frames:
            points, triangles = self.build_surface()
            contents |= {"scale": 1.0, "offset": (0.0, 0.0, 0.0)}
            contents["mesh"] = {"kind": "triangles", "points": points.tolist(), "triangles": triangles.tolist()}
        return contents

    def build_surface(self) -> SurfaceMesh:
        """Build its points and triangles; raise InputError on failure."""
        if isinstance(self.mesh, TriangleSurface):
            points, triangles = np.array(self.mesh.points), np.array(self.mesh.triangles, np.int64)
        else:
            mesh = self.mesh.build_mesh(self.size)
            points, triangles = mesh.rest_positions, mesh.triangles
        if not len(triangles):
            raise InputError("the mesh of the obstacle has no triangles; expected a surface")
        if self.frames:
            if len(points) != self.frames.frame_positions.shape[1]:
                counts = f"{self.frames.frame_positions.shape[1]:,} points for a mesh of {len(points):,}"
                path = self.frames.positions if isinstance(self.frames.positions, Path) else None
                raise InputError(InputMistake(f"got {counts}; expected as many", path, key="frames"))
            points = self.frames.frame_positions[0]
        return self.scale * points + np.array(self.offset), triangles

    def place_points(self, points: Positions, time: float) -> Positions:
        """Return the positions (o, 3) [m] of the surface points at a time.

        Args:
            points: positions (o, 3) [m] by `build_surface`; recorded frames replace them.
            time: time [s].
        """
        if self.frames:
            points = self.scale * self.frames.interpolate_positions(time) + np.array(self.offset)
        return points if self.motion is None else self.motion.transform_points(points, time)


def _resolve_path(name: Path, info: ValidationInfo) -> Path:
    """Resolve a path relative to the config's folder."""
    path = Path(cast(Mapping[str, Any], info.context or {}).get("folder", ".")) / name
    if not path.is_file():
        raise ValueError(f"there is no file {path}")
    return path


AnySurface = Annotated[
    PlaneObstacle | SphereObstacle | CapsuleObstacle | BoxObstacle | MeshObstacle, Field(discriminator="kind")
]


def parse_obstacles(text: str) -> tuple[AnySurface, ...]:
    """Parse the obstacles of a recording; raise ValueError on failure."""
    return TypeAdapter(tuple[AnySurface, ...]).validate_json(text)


def is_deforming(obstacle: AnySurface) -> bool:
    """Return whether an obstacle has recorded frames."""
    return isinstance(obstacle, MeshObstacle) and obstacle.frames is not None


def place_obstacle_points(obstacle: AnySurface, points: Positions, time: float) -> Positions:
    """Return the positions of declared surface points at a time.

    Args:
        obstacle: the obstacle.
        points: declared positions (o, 3) [m].
        time: [s].

    Returns:
        Positions (o, 3) [m].
    """
    if isinstance(obstacle, MeshObstacle):
        return obstacle.place_points(points, time)
    return points if obstacle.motion is None else obstacle.motion.transform_points(points, time)


def build_obstacle_surface(obstacle: AnySurface, max_sag: float, scene_points: Positions) -> SurfaceMesh:
    """Build the triangles of an obstacle in its declared pose.

    Args:
        obstacle: the obstacle.
        max_sag: largest inward deviation [m] of the triangles of spheres and capsules.
        scene_points: (q, 3) [m]; the two triangles of a plane extend beyond them.

    Raises:
        InputError: if the obstacle is invalid.
    """
    if isinstance(obstacle, MeshObstacle):
        return obstacle.build_surface()
    if isinstance(obstacle, SphereObstacle):
        mesh = BalloonMesh(radius=obstacle.radius).build_mesh(_count_subdivisions(obstacle.radius, max_sag))
        return mesh.rest_positions + np.array(obstacle.center), mesh.triangles
    if isinstance(obstacle, CapsuleObstacle):
        return _triangulate_capsule(obstacle, max_sag)
    if isinstance(obstacle, BoxObstacle):
        low, high = np.array(obstacle.low), np.array(obstacle.high)
        corners = np.array([[k >> 2 & 1, k >> 1 & 1, k & 1] for k in range(8)])
        return low + (high - low) * corners, _BOX_TRIANGLES
    return _triangulate_plane(obstacle, scene_points)


_BOX_FACES = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
_BOX_TRIANGLES = _BOX_FACES[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
_PLANE_EXTENT_FACTOR = 20.0
"""Half the side of a plane's two triangles, relative to the extent of the scene around it."""


def _count_subdivisions(radius: float, sag: float) -> int:
    """Return the subdivisions of an icosahedron's edges for a maximum sag.

    A triangle with sides of 1.3 radius/k lies at most (0.75 radius/k)^2/(2 radius) inside the sphere.
    """
    return int(np.clip(np.ceil((0.2813 * radius / sag) ** 0.5), 2, 60))


def _triangulate_capsule(one: CapsuleObstacle, sag: float) -> SurfaceMesh:
    """Triangulate a capsule as rings between two poles.

    The angular spacing is the same along and across the rings.
    """
    around = 2 * int(np.ceil(np.pi / 2 / np.arccos(max(0.5, 1.0 - 0.5 * sag / one.radius))))
    turn, half = np.linspace(0, 2 * np.pi, around, endpoint=False), np.linspace(0, np.pi, around // 2 + 1)
    half = np.insert(half, len(half) // 2, 0.5 * np.pi)  # the top end of the cylinder; the next ring is its bottom
    first, x, y, z = one.model_copy(update={"motion": None}).build_obstacle().frame(0.0)
    long = float(np.linalg.norm(np.subtract(*one.end_points)))
    high = one.radius * np.cos(half) + np.where(np.arange(len(half)) < len(half) / 2, long, 0.0)
    wide = np.outer(one.radius * np.sin(half[1:-1]), np.ones(around))
    rings = wide[:, :, None] * (np.cos(turn)[:, None] * x - np.sin(turn)[:, None] * z) + high[1:-1, None, None] * y
    points = first + np.concatenate([[high[0] * y], rings.reshape(-1, 3), [high[-1] * y]])
    index: IndexArray = np.arange(1, 1 + around * (len(half) - 2)).reshape(-1, around)
    return points, build_capped_triangles(np.column_stack([index, index[:, 0]]), 0, len(points) - 1)


def _triangulate_plane(one: PlaneObstacle, around: Positions) -> SurfaceMesh:
    frame = one.model_copy(update={"motion": None}).build_obstacle().frame(0.0)
    origin, x, normal, z = frame
    middle = around.mean(axis=0)
    height = float((middle - origin) @ normal)
    half = _PLANE_EXTENT_FACTOR * (float(np.ptp(around, axis=0).max()) + abs(height))
    corners = middle - height * normal + half * np.array([-x - z, z - x, x + z, x - z])
    return corners, np.array([[0, 1, 2], [0, 2, 3]])
