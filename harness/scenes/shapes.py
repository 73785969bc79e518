"""Obstacles as surfaces of triangles: meshes, and what of planes, spheres, capsules and boxes can be met by edges."""

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
    """A surface written out."""

    kind: Literal["triangles"] = "triangles"
    points: tuple[Vector, ...] = Field(min_length=3)
    """[m]"""
    triangles: tuple[tuple[int, int, int], ...] = Field(min_length=1)
    """Three points each, counted from zero."""

    @field_validator("triangles")
    @classmethod
    def _of_points(cls, triangles: tuple[tuple[int, int, int], ...], info: ValidationInfo) -> Any:
        n = len(info.data.get("points", ())) or np.inf  # refused points are told of by themselves
        for k, corners in enumerate(triangles):
            if not all(0 <= i < n for i in corners) or len(set(corners)) < 3:
                raise ValueError(f"number {k} is {corners}; wanted three different points from 0 to {n - 1}")
        return triangles


class Frames(Model):
    """Where the points of a mesh are in frames of equal length, in between on straight ways; before the first frame and
    after the last one they rest."""

    positions: Path | tuple[tuple[Vector, ...], ...]
    """An .npz with `positions` (frames, points, 3) [m], as `springbench run --positions` writes it; or written out."""
    rate: Metres = 60.0
    """Frames a second."""
    begin: float = Field(default=0.0, ge=0.0, le=1e9)
    """When the first frame is [s]."""

    @cached_property
    def stored(self) -> Array:
        """(frames, points, 3) [m]; raises InputError."""
        path = self.positions if isinstance(self.positions, Path) else None
        found = read_numbers(path, "positions") if path else np.array(self.positions)
        if found.ndim != 3 or found.shape[2] != 3 or not found.size or not (np.abs(found) <= MAX_COORDINATE).all():
            wanted = f"wanted numbers up to {MAX_COORDINATE:g} m of shape (frames, points, 3)"
            problem = f"came positions {found.shape}; {wanted}"
            raise InputError(Mistake(problem, path) if path else f"frames: {problem}")
        return found

    def at(self, time: float) -> Array:
        """Where the points are at a time [s], (points, 3) [m]."""
        frame = min(max((time - self.begin) * self.rate, 0.0), len(self.stored) - 1.0)
        k = min(int(frame), max(len(self.stored) - 2, 0))
        one, part = self.stored[k], frame - k
        return one if part == 0.0 else one + part * (self.stored[k + 1] - one)


AnyShape = Annotated[
    Balloon | Block | Body | File | Grid | Skirt | Triangles,
    Field(discriminator="kind"),
]


class Solid(Model):
    """A mesh; its triangles are what nothing passes through, from either side, closed or not."""

    kind: Literal["mesh"] = "mesh"
    mesh: AnyShape
    """A mesh from a file, or from a generator, or written out as `triangles`."""
    size: Annotated[int, Field(ge=2, le=10_000)] = 24
    """The mesh's size, which means nothing to one from a file."""
    scale: Metres = 1.0
    """All coordinates of the mesh are multiplied by this,"""
    offset: Vector = (0.0, 0.0, 0.0)
    """then shifted by this [m]."""
    motion: KeyedMotion | None = None
    """Key frames that take the obstacle along."""
    frames: Frames | None = None
    """Frames in which its points are elsewhere: it deforms, and goes along its key frames besides."""

    @field_validator("mesh")
    @classmethod
    def _beside(cls, mesh: Any, info: ValidationInfo) -> Any:
        """Names of files are relative to the config's folder."""
        return mesh.model_copy(update={"path": _beside(mesh.path, info)}) if isinstance(mesh, File) else mesh

    @field_validator("frames")
    @classmethod
    def _beside_too(cls, frames: Frames | None, info: ValidationInfo) -> Frames | None:
        if frames is None or not isinstance(frames.positions, Path):
            return frames
        return frames.model_copy(update={"positions": _beside(frames.positions, info)})

    @model_validator(mode="after")
    def _readable(self) -> Solid:
        """Files are read here already: a mistake that is found while a model is written out has no place."""
        if isinstance(self.mesh, File) or self.frames:
            try:
                self.shape()
            except InputError as error:
                raise ValueError("; ".join(map(str, error.mistakes))) from None
        return self

    @model_serializer(mode="wrap")
    def _written_out(self, dump: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """A file counts by what it holds; what a recording declares has to be there when it is read."""
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
        """Its points and triangles; raises InputError."""
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
        """Where the points that `shape` tells are at a time [s], (o, 3) [m]."""
        if self.frames:
            points = self.scale * self.frames.at(time) + np.array(self.offset)
        return points if self.motion is None else self.motion.moved(points, time)


def _beside(name: Path, info: ValidationInfo) -> Path:
    """A file by the config's folder."""
    path = Path(cast(Mapping[str, Any], info.context or {}).get("folder", ".")) / name
    if not path.is_file():
        raise ValueError(f"there is no file {path}")
    return path


AnySurface = Annotated[Plane | Sphere | Capsule | Box | Solid, Field(discriminator="kind")]


def from_json(text: str) -> tuple[AnySurface, ...]:
    """The obstacles that a recording declares. Raises ValueError."""
    return TypeAdapter(tuple[AnySurface, ...]).validate_json(text)


def deforming(obstacle: AnySurface) -> bool:
    """Whether it goes along stored frames."""
    return isinstance(obstacle, Solid) and obstacle.frames is not None


def placed(obstacle: AnySurface, points: Positions, time: float) -> Positions:
    """Where points of its shape, as they were declared, are at a time [s], (o, 3) [m] both."""
    if isinstance(obstacle, Solid):
        return obstacle.placed(points, time)
    return points if obstacle.motion is None else obstacle.motion.moved(points, time)


def shape(obstacle: AnySurface, sag: float, around: Positions) -> Shape:
    """The triangles of an obstacle as it was declared; raises InputError.

    sag [m]: how far those of spheres and capsules lie inside at most; around (q, 3) [m]: what the two triangles of a
    plane have to be seen from.
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
"""Of what is around a plane: half the side of its two triangles."""


def _fine(radius: float, sag: float) -> int:
    """Into how many parts an icosahedron's edges are divided: a triangle with sides of 1.3 radius/k lies at most
    (0.75 radius/k)^2/(2 radius) inside the sphere."""
    return int(np.clip(np.ceil((0.2813 * radius / sag) ** 0.5), 2, 60))


def _capsule(one: Capsule, sag: float) -> Shape:
    """Rings around the axis, as far apart along half circles as their corners are, and a point at each end."""
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
