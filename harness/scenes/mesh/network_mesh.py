"""An inline spring network: vertices, springs and masses listed in the scene."""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, NonNegativeFloat, NonNegativeInt, ValidationInfo, field_validator
from springbench.harness.scenes.mesh.mesh import BEND, SHEAR, STRETCH, Mesh
from springbench.harness.scenes.mesh.mesh_topology import NO_TRIANGLES
from springbench.harness.scenes.mesh.spring_network import MAX_COORDINATE
from springbench.harness.schema.base_model import ConfigModel

CoordinateValue = Annotated[float, Field(ge=-MAX_COORDINATE, le=MAX_COORDINATE)]
VertexPairs = tuple[tuple[NonNegativeInt, NonNegativeInt], ...]


class NetworkMesh(ConfigModel):
    """Vertices, and springs between pairs of them; multiple springs per pair are allowed. Dimension 1."""

    kind: Literal["network"] = "network"
    positions: tuple[tuple[CoordinateValue, CoordinateValue, CoordinateValue], ...] = Field(min_length=1)
    """Rest position of each vertex [m]."""
    springs: VertexPairs = ()
    """Springs along the lines (stretch), as pairs of zero-based vertices."""
    shear: VertexPairs = ()
    """Springs across cells."""
    bend: VertexPairs = ()
    """Springs from a vertex to the next but one."""
    mass: tuple[NonNegativeFloat, ...] | None = None
    """Mass of each vertex [kg]; by default equal shares of the scene's mass."""

    @field_validator("springs", "shear", "bend")
    @classmethod
    def _check_pairs(cls, pairs: VertexPairs, info: ValidationInfo) -> VertexPairs:
        n = len(info.data.get("positions", ())) or np.inf  # invalid positions are reported separately
        for k, (i, j) in enumerate(pairs):
            if i == j:
                raise ValueError(f"spring {k} joins the vertex {i} to itself; remove it or name another vertex")
            if max(i, j) >= n:
                raise ValueError(f"spring {k} names the vertex {max(i, j)}; the vertices are 0 to {n - 1}")
        return pairs

    @field_validator("mass")
    @classmethod
    def _check_mass_count(cls, mass: tuple[float, ...] | None, info: ValidationInfo) -> tuple[float, ...] | None:
        n = len(info.data.get("positions", ()))
        if mass is not None and n and len(mass) != n:
            raise ValueError(f"has {len(mass)} masses for {n} vertices; give each vertex one")
        if mass is not None and not any(mass):
            raise ValueError("is zero at every vertex; give some vertex a mass")
        return mass

    def build_mesh(self, size: int = 0) -> Mesh:
        """Build the network, ignoring the size."""
        rest = np.array(self.positions, float)
        mass = None if self.mass is None else np.array(self.mass, float)
        families = {STRETCH: self.springs, SHEAR: self.shear, BEND: self.bend}
        springs = np.concatenate([np.array(pairs, np.int64).reshape(-1, 2) for pairs in families.values()])
        ends: list[int] = np.cumsum([0, *map(len, families.values())]).tolist()
        i, j = springs.T
        lengths = np.linalg.norm(rest[i] - rest[j], axis=1)
        return Mesh(
            rest_positions=rest,
            springs=springs,
            spring_families={name: np.arange(a, b) for name, (a, b) in zip(families, pairwise(ends), strict=True)},
            triangles=NO_TRIANGLES,
            mass_fractions=np.full(len(rest), 1.0 / len(rest)) if mass is None else mass / mass.sum(),
            dimension=1,
            spacing=float(np.median(lengths[lengths > 0.0])) if lengths.any() else 1.0,
            mass=mass,
        )
