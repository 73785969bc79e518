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

from harness.base.errors import InputError, Mistake
from harness.base.model import Model, Vector
from harness.base.npz import read_numbers
from harness.scenes.mesh.body import Body
from harness.scenes.mesh.cells import MAX_COORDINATE
from harness.scenes.mesh.files import File
from harness.scenes.mesh.generator import Metres
from harness.scenes.mesh.grid import Grid
from harness.scenes.mesh.solids import Block
from harness.scenes.mesh.surfaces import Balloon, Skirt
from harness.scenes.mesh.topology import closed_by_points
from harness.scenes.motion import KeyedMotion
from harness.scenes.obstacles import Box, Capsule, Plane, Sphere

if TYPE_CHECKING:
    from solvers.problem import Positions

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Shape = tuple[Array, Indices]
"""Points (o, 3) [m] and triangles (f, 3)."""


class Triangles(Model):
    """An inline surface."""

    kind: Literal["triangles"] = "triangles"
    points: tuple[Vector, ...] = Field(min_length=3)
    """Points [m]."""
    triangles: tuple[tuple[int, int, int], ...] = Field(min_length=1)
    """Three zero-based point indices each."""

    @field_validator("triangles")
    @classmethod
    def _of_points(cls, triangles: tuple[tuple[int, int, int], ...], info: ValidationInfo) -> Any:
        n = len(info.data.get("points", ())) or np.inf  # refused points are told of by themselves
        for k, corners in enumerate(triangles):
            if not all(0 <= i < n for i in corners) or len(set(corners)) < 3:
                raise ValueError(f"number {k} is {corners}; wanted three different points from 0 to {n - 1}")
        return triangles


class Frames(Model):
    """Recorded positions of a mesh's points at a fixed frame rate, linearly interpolated.

    Before the first frame and after the last one the points are at rest.
    """

    positions: Path | tuple[tuple[Vector, ...], ...]
    """An .npz with `positions` (frames, points, 3) [m], as `springbench run --positions` writes it; or inline."""
    rate: Metres = 60.0
    """Frames per second."""
    begin: float = Field(default=0.0, ge=0.0, le=1e9)
    """Time of the first frame [s]."""

    @cached_property
    def stored(self) -> Array:
        """Read the positions (frames, points, 3) [m]; raise InputError on failure."""
        path = self.positions if isinstance(self.positions, Path) else None
        found = read_numbers(path, "positions") if path else np.array(self.positions)
        if found.ndim != 3 or found.shape[2] != 3 or not found.size or not (np.abs(found) <= MAX_COORDINATE).all():
            wanted = f"wanted numbers up to {MAX_COORDINATE:g} m of shape (frames, points, 3)"
            problem = f"came positions {found.shape}; {wanted}"
            raise InputError(Mistake(problem, path) if path else f"frames: {problem}")
        return found

    def at(self, time: float) -> Array:
        """Interpolate the positions at a time [s], (points, 3) [m]."""
        frame = min(max((time - self.begin) * self.rate, 0.0), len(self.stored) - 1.0)
        k = min(int(frame), max(len(self.stored) - 2, 0))
        one, part = self.stored[k], frame - k
        return one if part == 0.0 else one + part * (self.stored[k + 1] - one)


AnyShape = Annotated[
    Balloon | Block | Body | File | Grid | Skirt | Triangles,
    Field(discriminator="kind"),
]


class Solid(Model):
    """A mesh obstacle; its triangles are impenetrable from either side, closed or not."""

    kind: Literal["mesh"] = "mesh"
    mesh: AnyShape
    """A mesh from a file, from a generator, or inline as `triangles`."""
    size: Annotated[int, Field(ge=2, le=10_000)] = 24
    """Mesh size, ignored for a mesh from a file."""
    scale: Metres = 1.0
    """Factor of all coordinates of the mesh."""
    offset: Vector = (0.0, 0.0, 0.0)
    """Translation after scaling [m]."""
    motion: KeyedMotion | None = None
    """Key frames of the obstacle's motion."""
    frames: Frames | None = None
    """Frames with recorded positions of its points: the obstacle deforms, in addition to its key frames."""

    @field_validator("mesh")
    @classmethod
    def _beside(cls, mesh: Any, info: ValidationInfo) -> Any:
        """Resolve file names relative to the config's folder."""
        return mesh.model_copy(update={"path": _beside(mesh.path, info)}) if isinstance(mesh, File) else mesh

    @field_validator("frames")
    @classmethod
    def _beside_too(cls, frames: Frames | None, info: ValidationInfo) -> Frames | None:
        if frames is None or not isinstance(frames.positions, Path):
            return frames
        return frames.model_copy(update={"positions": _beside(frames.positions, info)})

    @model_validator(mode="after")
    def _readable(self) -> Solid:
        """Read files during validation: a mistake found during serialisation has no location."""
        if isinstance(self.mesh, File) or self.frames:
            try:
                self.shape()
            except InputError as error:
                raise ValueError("; ".join(map(str, error.mistakes))) from None
        return self

    @model_serializer(mode="wrap")
    def _written_out(self, dump: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Dump the contents of files: they define the obstacle, and a recording must contain them."""
        told: dict[str, Any] = dump(self)
        if self.frames is None:
            told.pop("frames", None)  # which whoever leaves out what is None has done already
        else:
            moved = self.scale * self.frames.stored + np.array(self.offset)
            told["frames"]["positions"] = moved.tolist()
        if isinstance(self.mesh, File) or self.frames:
            points, triangles = self.shape()
            told |= {"scale": 1.0, "offset": (0.0, 0.0, 0.0)}
            told["mesh"] = {"kind": "triangles", "points": points.tolist(), "triangles": triangles.tolist()}
        return told

    def shape(self) -> Shape:
        """Build its points and triangles; raise InputError on failure."""
        if isinstance(self.mesh, Triangles):
            points, triangles = np.array(self.mesh.points), np.array(self.mesh.triangles, np.int64)
        else:
            mesh = self.mesh.build(self.size)
            points, triangles = mesh.rest, mesh.triangles
        if not len(triangles):
            raise InputError("the mesh has no triangles, so there is nothing to meet")
        if self.frames:
            if len(points) != self.frames.stored.shape[1]:
                came = f"{self.frames.stored.shape[1]:,} points for a mesh of {len(points):,}"
                path = self.frames.positions if isinstance(self.frames.positions, Path) else None
                raise InputError(Mistake(f"came {came}; wanted as many", path, key="frames"))
            points = self.frames.stored[0]
        return self.scale * points + np.array(self.offset), triangles

    def placed(self, points: Positions, time: float) -> Positions:
        """Return the positions (o, 3) [m] at a time [s] of the points of `shape`."""
        if self.frames:
            points = self.scale * self.frames.at(time) + np.array(self.offset)
        return points if self.motion is None else self.motion.moved(points, time)


def _beside(name: Path, info: ValidationInfo) -> Path:
    """Resolve a path relative to the config's folder."""
    path = Path(cast(Mapping[str, Any], info.context or {}).get("folder", ".")) / name
    if not path.is_file():
        raise ValueError(f"there is no file {path}")
    return path


AnySurface = Annotated[Plane | Sphere | Capsule | Box | Solid, Field(discriminator="kind")]


def from_json(text: str) -> tuple[AnySurface, ...]:
    """Parse the obstacles of a recording; raise ValueError on failure."""
    return TypeAdapter(tuple[AnySurface, ...]).validate_json(text)


def deforming(obstacle: AnySurface) -> bool:
    """Return whether an obstacle has recorded frames."""
    return isinstance(obstacle, Solid) and obstacle.frames is not None


def placed(obstacle: AnySurface, points: Positions, time: float) -> Positions:
    """Return the positions of declared surface points at a time.

    Args:
        obstacle: the obstacle.
        points: declared positions (o, 3) [m].
        time: [s].

    Returns:
        Positions (o, 3) [m].
    """
    if isinstance(obstacle, Solid):
        return obstacle.placed(points, time)
    return points if obstacle.motion is None else obstacle.motion.moved(points, time)


def shape(obstacle: AnySurface, sag: float, around: Positions) -> Shape:
    """Build the triangles of an obstacle in its declared pose.

    Args:
        obstacle: the obstacle.
        sag: largest inward deviation [m] of the triangles of spheres and capsules.
        around: (q, 3) [m]; the two triangles of a plane extend beyond them.

    Raises:
        InputError: if the obstacle is invalid.
    """
    if isinstance(obstacle, Solid):
        return obstacle.shape()
    if isinstance(obstacle, Sphere):
        mesh = Balloon(radius=obstacle.radius).build(_fine(obstacle.radius, sag))
        return mesh.rest + np.array(obstacle.center), mesh.triangles
    if isinstance(obstacle, Capsule):
        return _capsule(obstacle, sag)
    if isinstance(obstacle, Box):
        low, high = np.array(obstacle.low), np.array(obstacle.high)
        corners = np.array([[k >> 2 & 1, k >> 1 & 1, k & 1] for k in range(8)])
        return low + (high - low) * corners, _CUBE
    return _plane(obstacle, around)


_FACES = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
_CUBE = _FACES[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
_WIDE = 20.0
"""Half the side of a plane's two triangles, relative to the extent of the scene around it."""


def _fine(radius: float, sag: float) -> int:
    """Return the subdivisions of an icosahedron's edges for a maximum sag.

    A triangle with sides of 1.3 radius/k lies at most (0.75 radius/k)^2/(2 radius) inside the sphere.
    """
    return int(np.clip(np.ceil((0.2813 * radius / sag) ** 0.5), 2, 60))


def _capsule(one: Capsule, sag: float) -> Shape:
    """Triangulate a capsule by rings, spaced on the half circles like their corners, and two end points."""
    around = 2 * int(np.ceil(np.pi / 2 / np.arccos(max(0.5, 1.0 - 0.5 * sag / one.radius))))
    turn, half = np.linspace(0, 2 * np.pi, around, endpoint=False), np.linspace(0, np.pi, around // 2 + 1)
    half = np.insert(half, len(half) // 2, 0.5 * np.pi)
    first, x, y, z = one.model_copy(update={"motion": None}).obstacle().frame(0.0)
    long = float(np.linalg.norm(np.subtract(*one.ends)))
    high = one.radius * np.cos(half) + np.where(np.arange(len(half)) < len(half) / 2, long, 0.0)
    wide = np.outer(one.radius * np.sin(half[1:-1]), np.ones(around))
    rings = wide[:, :, None] * (np.cos(turn)[:, None] * x - np.sin(turn)[:, None] * z) + high[1:-1, None, None] * y
    points = first + np.concatenate([[high[0] * y], rings.reshape(-1, 3), [high[-1] * y]])
    index: Indices = np.arange(1, 1 + around * (len(half) - 2)).reshape(-1, around)
    return points, closed_by_points(np.column_stack([index, index[:, 0]]), 0, len(points) - 1)


def _plane(one: Plane, around: Positions) -> Shape:
    frame = one.model_copy(update={"motion": None}).obstacle().frame(0.0)
    origin, x, normal, z = frame
    middle = around.mean(axis=0)
    height = float((middle - origin) @ normal)
    half = _WIDE * (float(np.ptp(around, axis=0).max()) + abs(height))
    corners = middle - height * normal + half * np.array([-x - z, z - x, x + z, x - z])
    return corners, np.array([[0, 1, 2], [0, 2, 3]])
