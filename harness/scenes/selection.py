"""Which vertices of a mesh a key of a scene means: named parts, indices, places, boundary loops, numbers of a file."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Self, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    SerializerFunctionWrapHandler,
    model_serializer,
    model_validator,
)

from harness.base.errors import InputError, did_you_mean
from harness.base.model import Model, Vector
from harness.scenes.mesh.base import Mesh, distinct
from harness.scenes.mesh.boundary import Loop, loops

Indices = NDArray[np.int64]


class Box(Model):
    """An axis-parallel box, its faces included."""

    low: Vector
    """The corner with the smallest coordinates [m]."""
    high: Vector
    """The corner with the largest coordinates [m]."""


class Ball(Model):
    """A ball, its surface included."""

    center: Vector
    """Its middle [m]."""
    radius: PositiveFloat
    """Its radius [m]."""


class Attribute(Model):
    """A range of a number that a mesh's file tells of each vertex, its ends included."""

    name: str
    """As the file has it; one number of a vector is `name.0`, `name.1`, ..."""
    low: float | None = None
    """The smallest; any if left out."""
    high: float | None = None
    """The largest; any if left out."""


class Selection(Model):
    """Every vertex that any of the selectors names."""

    at: tuple[str, ...] = ()
    """Named parts of the mesh, such as corners, top or left, and groups of its file."""
    indices: tuple[NonNegativeInt, ...] = ()
    """Vertices, counted from zero."""
    box: Box | None = None
    """All vertices whose rest position lies in this box."""
    sphere: Ball | None = None
    """All vertices whose rest position lies in this ball."""
    nearest: tuple[Vector, ...] = ()
    """Of each of these points [m] the vertex whose rest position is nearest, the first of those alike."""
    loops: tuple[NonNegativeInt, ...] = ()
    """Boundary loops of the mesh's triangles, the longest is 0."""
    holes: tuple[NonNegativeInt, ...] = ()
    """Holes: boundary loops of connected surfaces but the longest of each, the longest hole is 0."""
    attribute: Attribute | None = None
    """All vertices of which the mesh's file tells a number in this range."""
    every: PositiveInt = 1
    """Of the vertices chosen so far (all of them where nothing else is chosen), every k-th, from the first."""

    @model_validator(mode="after")
    def _selects(self) -> Self:
        if not (self.names or self.every > 1):
            raise ValueError(
                "names no vertices; give at, indices, box, sphere, nearest, loops, holes, attribute or every"
            )
        return self

    @model_serializer(mode="wrap")
    def _as_given(self, dump: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Without the selectors that came later and are not used: runs are told apart by what is written here."""
        told: dict[str, Any] = dump(self)
        return {key: value for key, value in told.items() if value or key not in _LATER}

    @property
    def names(self) -> bool:
        """Whether any selector but `every` does."""
        given = self.at, self.indices, self.box, self.sphere, self.nearest, self.loops, self.holes, self.attribute
        return any(map(bool, given))

    def told(self) -> str:
        """The selectors that are used, in words."""
        given = self.model_dump(mode="json", include=set(Selection.model_fields), exclude_none=True)
        used = (f"{key} {_in_words(value)}" for key, value in given.items() if value and (key, value) != ("every", 1))
        return ", ".join(used)

    def chosen(self, mesh: Mesh, name: str) -> Indices:
        """The vertices (q,), sorted; raises InputError, which speaks of `name`, for what the mesh does not have."""
        n, rest = len(mesh.rest), mesh.rest
        for part in self.at:
            if part not in mesh.parts:
                raise InputError(f"{name}: at: came {part!r}; this mesh has {did_you_mean(part, mesh.parts)}")
        outside = [i for i in self.indices if i >= n]
        if outside:
            raise InputError(f"{name}: indices: came {outside[0]}; the mesh has the vertices 0 to {n - 1}")
        sets = [mesh.parts[part] for part in self.at] + [np.array(self.indices, np.int64)]
        if self.box:
            inside = (rest >= self.box.low) & (rest <= self.box.high)
            sets.append(np.flatnonzero(inside.all(axis=1)))
        if self.sphere:
            away = ((rest - self.sphere.center) ** 2).sum(axis=1)
            sets.append(np.flatnonzero(away <= self.sphere.radius**2))
        sets += [np.argmin(((rest - point) ** 2).sum(axis=1), keepdims=True) for point in self.nearest]
        if self.loops or self.holes:
            every = loops(mesh)
            sets += _numbered(every, self.loops, f"{name}: loops", "boundary loops")
            sets += _numbered([loop for loop in every if loop.hole], self.holes, f"{name}: holes", "holes")
        if self.attribute:
            sets.append(_between(mesh, self.attribute, f"{name}: attribute"))
        vertices = distinct(np.concatenate(sets), n)[:: self.every] if self.names else np.arange(0, n, self.every)
        if not len(vertices):
            raise InputError(f"{name}: no vertex of the mesh lies in the {self.told()}")
        return vertices


_LATER = {"sphere", "nearest", "loops", "holes", "attribute"}


def selections(effect: Any) -> Iterator[tuple[str, Selection]]:
    """Those that an effect has: itself, by no name, and its fields."""
    if isinstance(effect, Selection):
        yield "", effect
    for key, value in effect:
        if isinstance(value, Selection):
            yield key, value


def _in_words(value: Any) -> str:
    if isinstance(value, dict):
        return " ".join(f"{key} {_in_words(one)}" for key, one in cast(dict[str, Any], value).items())
    if isinstance(value, list):
        return "(" + ", ".join(_in_words(one) for one in cast(list[Any], value)) + ")"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _numbered(found: list[Loop], wanted: tuple[int, ...], name: str, what: str) -> list[Indices]:
    if missing := [k for k in wanted if k >= len(found)]:
        raise InputError(f"{name}: came {missing[0]}; the mesh has {len(found)} {what}, counted from 0")
    return [found[k].vertices for k in wanted]


def _between(mesh: Mesh, wanted: Attribute, name: str) -> Indices:
    if wanted.name not in mesh.attributes:
        known = did_you_mean(wanted.name, mesh.attributes) if mesh.attributes else "none; meshes from files may"
        raise InputError(f"{name}: came {wanted.name!r}; this mesh has {known}")
    values = mesh.attributes[wanted.name]
    low, high = (end if end is not None else sign * np.inf for end, sign in ((wanted.low, -1), (wanted.high, 1)))
    return np.flatnonzero((values >= low) & (values <= high))
