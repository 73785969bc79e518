"""Vertex selection: named parts, indices, regions, boundary loops, attributes of a file."""

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
from springbench.harness.errors import InputError, format_allowed_names
from springbench.harness.scenes.mesh.boundary_loops import BoundaryLoop, find_boundary_loops
from springbench.harness.scenes.mesh.mesh import Mesh, sort_unique_vertices
from springbench.harness.schema.base_model import ConfigModel, Vector3

IndexArray = NDArray[np.int64]


class BoxRegion(ConfigModel):
    """An axis-parallel box, its faces included."""

    low: Vector3
    """Corner with the smallest coordinates [m]."""
    high: Vector3
    """Corner with the largest coordinates [m]."""


class BallRegion(ConfigModel):
    """A ball, its surface included."""

    center: Vector3
    """Centre [m]."""
    radius: PositiveFloat
    """Radius [m]."""


class AttributeRange(ConfigModel):
    """A range, ends included, of a vertex attribute from the mesh's file."""

    name: str
    """Name in the file; a component of a vector is `name.0`, `name.1`, ..."""
    low: float | None = None
    """Smallest value; unbounded by default."""
    high: float | None = None
    """Largest value; unbounded by default."""


class VertexSelection(ConfigModel):
    """All vertices that at least one of the selectors names."""

    parts: tuple[str, ...] = ()
    """Named parts of the mesh, such as corners, top or left, and groups of its file."""
    indices: tuple[NonNegativeInt, ...] = ()
    """Zero-based vertex indices."""
    box: BoxRegion | None = None
    """All vertices with rest positions in this box."""
    sphere: BallRegion | None = None
    """All vertices with rest positions in this ball."""
    nearest_to: tuple[Vector3, ...] = ()
    """For each of these points [m] the vertex with the nearest rest position; the lowest index decides ties."""
    boundary_loops: tuple[NonNegativeInt, ...] = ()
    """Boundary loops of the mesh's triangles; the longest is 0."""
    holes: tuple[NonNegativeInt, ...] = ()
    """Holes: boundary loops except the longest of each connected surface; the longest hole is 0."""
    attribute: AttributeRange | None = None
    """All vertices with an attribute in this range."""
    stride: PositiveInt = 1
    """Every k-th of the vertices selected so far, from the first; of all vertices if there is no other selector."""

    @model_validator(mode="after")
    def _check_selectors(self) -> Self:
        if not (self.has_selectors or self.stride > 1):
            raise ValueError(
                "names no vertices; give parts, indices, box, sphere, nearest_to, boundary_loops, holes, attribute or "
                "stride"
            )
        return self

    @model_serializer(mode="wrap")
    def _dump_used_selectors(self, dump: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Dump the selectors without unused optional ones.

        New selectors therefore do not change the ids of existing runs.
        """
        contents: dict[str, Any] = dump(self)
        return {key: value for key, value in contents.items() if value or key not in _OPTIONAL_SELECTORS}

    @property
    def has_selectors(self) -> bool:
        """Whether any selector except the stride is used."""
        given = (
            self.parts,
            self.indices,
            self.box,
            self.sphere,
            self.nearest_to,
            self.boundary_loops,
            self.holes,
            self.attribute,
        )
        return any(map(bool, given))

    def describe_selection(self) -> str:
        """Describe the used selectors in words."""
        given = self.model_dump(mode="json", include=set(VertexSelection.model_fields), exclude_none=True)
        used = (
            f"{key} {_describe_value(value)}" for key, value in given.items() if value and (key, value) != ("stride", 1)
        )
        return ", ".join(used)

    def select_vertices(self, mesh: Mesh, name: str) -> IndexArray:
        """Return the selected vertices (q,), sorted.

        Args:
            mesh: the mesh.
            name: name of the selection in messages.

        Raises:
            InputError: for parts, vertices and attributes that the mesh lacks.
        """
        n, rest = len(mesh.rest_positions), mesh.rest_positions
        for part in self.parts:
            if part not in mesh.parts:
                raise InputError(f"{name}: parts: got {part!r}; this mesh has {format_allowed_names(part, mesh.parts)}")
        outside = [i for i in self.indices if i >= n]
        if outside:
            raise InputError(f"{name}: indices: got {outside[0]}; the mesh has the vertices 0 to {n - 1}")
        sets = [mesh.parts[part] for part in self.parts] + [np.array(self.indices, np.int64)]
        if self.box:
            inside = (rest >= self.box.low) & (rest <= self.box.high)
            sets.append(np.flatnonzero(inside.all(axis=1)))
        if self.sphere:
            away = ((rest - self.sphere.center) ** 2).sum(axis=1)
            sets.append(np.flatnonzero(away <= self.sphere.radius**2))
        sets += [np.argmin(((rest - point) ** 2).sum(axis=1), keepdims=True) for point in self.nearest_to]
        if self.boundary_loops or self.holes:
            every = find_boundary_loops(mesh)
            sets += _select_loops(every, self.boundary_loops, f"{name}: boundary_loops", "boundary loops")
            sets += _select_loops([loop for loop in every if loop.is_hole], self.holes, f"{name}: holes", "holes")
        if self.attribute:
            sets.append(_select_by_attribute(mesh, self.attribute, f"{name}: attribute"))
        vertices = (
            sort_unique_vertices(np.concatenate(sets), n)[:: self.stride]
            if self.has_selectors
            else np.arange(0, n, self.stride)
        )
        if not len(vertices):
            raise InputError(f"{name}: no vertex of the mesh lies in the {self.describe_selection()}")
        return vertices


_OPTIONAL_SELECTORS = {"sphere", "nearest_to", "boundary_loops", "holes", "attribute"}


def find_selections(effect: Any) -> Iterator[tuple[str, VertexSelection]]:
    """Yield the vertex selections of an effect, with their names.

    These are the effect itself if it is a selection, with the name "", and the fields that are selections.
    """
    if isinstance(effect, VertexSelection):
        yield "", effect
    for key, value in effect:
        if isinstance(value, VertexSelection):
            yield key, value


def _describe_value(value: Any) -> str:
    if isinstance(value, dict):
        return " ".join(f"{key} {_describe_value(one)}" for key, one in cast(dict[str, Any], value).items())
    if isinstance(value, list):
        return "(" + ", ".join(_describe_value(one) for one in cast(list[Any], value)) + ")"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _select_loops(found: list[BoundaryLoop], expected: tuple[int, ...], name: str, what: str) -> list[IndexArray]:
    if missing := [k for k in expected if k >= len(found)]:
        raise InputError(f"{name}: got {missing[0]}; the mesh has {len(found)} {what}, counted from 0")
    return [found[k].vertices for k in expected]


def _select_by_attribute(mesh: Mesh, expected: AttributeRange, name: str) -> IndexArray:
    if expected.name not in mesh.attributes:
        known = (
            format_allowed_names(expected.name, mesh.attributes) if mesh.attributes else "none; meshes from files may"
        )
        raise InputError(f"{name}: got {expected.name!r}; this mesh has {known}")
    values = mesh.attributes[expected.name]
    low, high = (end if end is not None else sign * np.inf for end, sign in ((expected.low, -1), (expected.high, 1)))
    return np.flatnonzero((values >= low) & (values <= high))
