"""Pins: Dirichlet conditions at rest positions, which may move, by a penalty w/2 |p - q|^2 or exactly."""

from math import inf
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PositiveFloat

from harness.scenes.effects.base import Contribution, Pin
from harness.scenes.mesh.base import Mesh
from harness.scenes.motion import KeyedMotion
from harness.scenes.selection import Selection


class Pins(Selection):
    """Pins each selected vertex."""

    exact_to: ClassVar[float] = inf
    plain: ClassVar[bool] = True

    kind: Literal["pins"] = "pins"
    weight: PositiveFloat | Literal["exact"] = Field(default=1e10)
    """Penalty weight w [N/m], or `exact`: the degrees of freedom of the vertices are eliminated."""
    motion: KeyedMotion | None = None
    """Key frames of the motion of all pinned vertices."""

    def bind(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> Contribution:
        """Return the selected vertices at rest; raise InputError for parts and vertices that the mesh lacks."""
        vertices = self.chosen(mesh, self.kind)
        weight = inf if self.weight == "exact" else float(self.weight)
        return Contribution(pins=(Pin(vertices, mesh.rest[vertices], weight, self.motion),))
