"""Which vertices of a mesh a key of a scene means: named parts, indices, a box, every k-th."""

from __future__ import annotations

from typing import Self

import numpy as np
from numpy.typing import NDArray
from pydantic import NonNegativeInt, PositiveInt, model_validator

from harness.base.errors import InputError, did_you_mean
from harness.base.model import Model, Vector
from harness.scenes.mesh.base import Mesh, distinct


class Box(Model):
    """An axis-parallel box, its faces included."""

    low: Vector
    """The corner with the smallest coordinates [m]."""
    high: Vector
    """The corner with the largest coordinates [m]."""


class Selection(Model):
    """Every vertex that any of the selectors names."""

    at: tuple[str, ...] = ()
    """Named parts of the mesh, such as corners, top or left."""
    indices: tuple[NonNegativeInt, ...] = ()
    """Vertices, counted from zero."""
    box: Box | None = None
    """All vertices whose rest position lies in this box."""
    every: PositiveInt = 1
    """Of the vertices chosen so far (all of them where nothing else is chosen), every k-th, from the first."""

    @model_validator(mode="after")
    def _selects(self) -> Self:
        if not (self.at or self.indices or self.box or self.every > 1):
            raise ValueError("names no vertices; give at, indices, box or every")
        return self

    def chosen(self, mesh: Mesh, name: str) -> NDArray[np.int64]:
        """The vertices (q,), sorted; raises InputError, which speaks of `name`, for what the mesh does not have."""
        n = len(mesh.rest)
        for part in self.at:
            if part not in mesh.parts:
                raise InputError(f"{name}: at: came {part!r}; this mesh has {did_you_mean(part, mesh.parts)}")
        outside = [i for i in self.indices if i >= n]
        if outside:
            raise InputError(f"{name}: indices: came {outside[0]}; the mesh has the vertices 0 to {n - 1}")
        sets = [mesh.parts[part] for part in self.at] + [np.array(self.indices, np.int64)]
        if self.box:
            inside = (mesh.rest >= self.box.low) & (mesh.rest <= self.box.high)
            sets.append(np.flatnonzero(inside.all(axis=1)))
        named = self.at or self.indices or self.box
        vertices = distinct(np.concatenate(sets), n)[:: self.every] if named else np.arange(0, n, self.every)
        if not len(vertices):
            raise InputError(f"{name}: no vertex of the mesh lies in the box from {self.box}")
        return vertices
