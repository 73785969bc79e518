"""A star: a hub, and springs from it to vertices on a circle around it."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
from springbench.harness.scenes.mesh.mesh import STRETCH, Mesh
from springbench.harness.scenes.mesh.mesh_generator import LengthMetres, MeshGenerator
from springbench.harness.scenes.mesh.mesh_topology import assemble_mesh, lump_lengths


class StarMesh(MeshGenerator):
    """A hub at the origin with springs to `size` vertices on a horizontal circle.

    The hub is vertex 0. Parts: hub, rim. Mass is proportional to length, so the hub has half of it. Dimension 1.
    """

    kind: Literal["star"] = "star"
    radius: LengthMetres = 1.0
    """Radius of the circle [m]."""

    SIZE_MEANING: ClassVar[str] = "vertices around the hub"
    SPRINGS_PER_VERTEX: ClassVar[int] = 1

    def count_vertices(self, size: int) -> int:
        """Return the number of vertices of a mesh of this size."""
        return size + 1

    def generate_mesh(self, size: int) -> Mesh:
        """Generate the mesh of a valid size."""
        angle = 2.0 * np.pi * np.arange(size) / size
        circle = self.radius * np.stack([np.cos(angle), np.zeros(size), np.sin(angle)], axis=1)
        rest = np.concatenate([np.zeros((1, 3)), circle])
        rim = np.arange(1, size + 1)
        pairs = np.stack([np.zeros(size, np.int64), rim], axis=1)
        return assemble_mesh(
            rest_positions=rest,
            springs={STRETCH: pairs},
            vertex_weights=lump_lengths(rest, pairs),
            dimension=1,
            spacing=self.radius,
            resolution=size,
            parts={"hub": [0], "rim": rim},
        )
