"""A stack of parallel sheets."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.harness.scenes.mesh.mesh_topology import IndexArray, PointArray, assemble_mesh


class StackMesh(GridMesh):
    """Unconnected layers of a grid, from the lowest to the highest.

    Each layer is numbered like a grid, with `size` vertices along its width. Springs: those of all layers, by family.
    Parts: those of a grid in all layers, and lowest, highest. Mass is proportional to area. Dimension 2.
    """

    kind: Literal["stack"] = "stack"  # pyright: ignore[reportIncompatibleVariableOverride]
    num_layers: Annotated[int, Field(ge=1, le=10_000)] = 2
    """Number of layers."""
    layer_spacing: Annotated[float, Field(ge=0.0, le=1e6)] = 0.01
    """Distance between layers [m], along +y for horizontal layers, along +z for hanging ones."""
    layer_angle: Annotated[float, Field(ge=-360.0, le=360.0)] = 0.0
    """Rotation of each layer in its plane relative to the one below [degrees]."""

    SIZE_MEANING: ClassVar[str] = "vertices along the width of each layer"

    def count_vertices(self, size: int) -> int:
        """Return the number of vertices of a mesh of this size."""
        return self.num_layers * super().count_vertices(size)

    def generate_mesh(self, size: int) -> Mesh:
        """Generate the mesh of a valid size."""
        one = super().generate_mesh(size)
        n, middle = len(one.rest_positions), one.rest_positions.mean(axis=0)
        normal = np.array([0.0, 1.0, 0.0] if self.plane == "horizontal" else [0.0, 0.0, 1.0])
        first = n * np.arange(self.num_layers)[:, None, None]
        arm, layers = one.rest_positions - middle, list[PointArray]()
        for k in range(self.num_layers):
            angle = np.deg2rad(k * self.layer_angle)
            turned = np.cos(angle) * arm + np.sin(angle) * np.cross(normal, arm) if self.layer_angle else arm
            layers.append(middle + turned + k * self.layer_spacing * normal)

        def in_all(rows: IndexArray) -> IndexArray:
            return (rows + first).reshape(-1, rows.shape[1])

        parts = {name: (part + first[:, 0]).ravel() for name, part in one.parts.items()}
        return assemble_mesh(
            rest_positions=np.concatenate(layers),
            springs={family: in_all(one.springs[rows]) for family, rows in one.spring_families.items()},
            triangles=in_all(one.triangles),
            vertex_weights=np.tile(one.mass_fractions, self.num_layers),
            dimension=2,
            spacing=one.spacing,
            resolution=size,
            parts={**parts, "lowest": np.arange(n), "highest": np.arange(n) + n * (self.num_layers - 1)},
        )
