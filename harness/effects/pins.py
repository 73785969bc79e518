"""Pins: chosen vertices are held at their rest positions, which may move, by a penalty w/2 |p - q|^2 or exactly."""

from math import inf
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, NonNegativeInt, PositiveFloat, PositiveInt, model_validator

from harness.effects.base import Contribution, Pin
from harness.errors import InputError, did_you_mean
from harness.mesh.base import Mesh
from harness.model import Model, Vector
from harness.motion import Motion


class Box(Model):
    """An axis-parallel box, its faces included."""

    low: Vector
    """The corner with the smallest coordinates [m]."""
    high: Vector
    """The corner with the largest coordinates [m]."""


class Pins(Model):
    """Holds every vertex that any of its selectors names."""

    kind: Literal["pins"] = "pins"
    at: tuple[str, ...] = ()
    """Named parts of the mesh, such as corners, top or left."""
    indices: tuple[NonNegativeInt, ...] = ()
    """Vertices, counted from zero."""
    box: Box | None = None
    """All vertices whose rest position lies in this box."""
    every: PositiveInt = 1
    """Of the vertices chosen so far (all of them where nothing else is chosen), every k-th, from the first."""
    weight: PositiveFloat | Literal["exact"] = Field(default=1e10)
    """The penalty's weight w [N/m], or `exact`: the vertices are no unknowns any more."""
    motion: Motion | None = None
    """Key frames that take the pinned vertices along, all together."""

    @model_validator(mode="after")
    def _selects(self) -> "Pins":
        if not (self.at or self.indices or self.box or self.every > 1):
            raise ValueError("names no vertices; give at, indices, box or every")
        return self

    def bind(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> Contribution:
        """The chosen vertices at rest; raises InputError for parts and vertices that the mesh does not have."""
        vertices = self._chosen(mesh)
        if not len(vertices):
            raise InputError(f"pins: no vertex of the mesh lies in the box from {self.box}")
        weight = inf if self.weight == "exact" else float(self.weight)
        return Contribution(pins=(Pin(vertices, mesh.rest[vertices], weight, self.motion),))

    def _chosen(self, mesh: Mesh) -> NDArray[np.int64]:
        n = len(mesh.rest)
        for part in self.at:
            if part not in mesh.parts:
                raise InputError(f"pins: at: came {part!r}; this mesh has {did_you_mean(part, mesh.parts)}")
        outside = [i for i in self.indices if i >= n]
        if outside:
            raise InputError(f"pins: indices: came {outside[0]}; the mesh has the vertices 0 to {n - 1}")
        sets = [mesh.parts[part] for part in self.at] + [np.array(self.indices, np.int64)]
        if self.box:
            inside = (mesh.rest >= self.box.low) & (mesh.rest <= self.box.high)
            sets.append(np.flatnonzero(inside.all(axis=1)))
        selected = np.arange(n) if not (self.at or self.indices or self.box) else np.unique(np.concatenate(sets))
        return selected[:: self.every].astype(np.int64)
