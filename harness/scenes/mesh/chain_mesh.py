"""A chain of vertices on a straight line, and a rope that also resists bending.

Springs connect neighbouring vertices.
"""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import AfterValidator
from springbench.harness.scenes.mesh.mesh import BEND, STRETCH, Mesh
from springbench.harness.scenes.mesh.mesh_generator import LengthMetres, MeshGenerator
from springbench.harness.scenes.mesh.mesh_topology import (
    NO_PAIRS,
    IndexArray,
    assemble_mesh,
    build_offset_pairs,
    lump_lengths,
)


def _require_nonzero(direction: tuple[float, float, float]) -> tuple[float, float, float]:
    if not any(direction):
        raise ValueError("a direction needs a component that is not zero")
    return direction


class ChainMesh(MeshGenerator):
    """A chain of `size` vertices from the origin along `direction`.

    Vertices and springs are numbered along the line. Parts: first, last, ends. Mass is proportional to length.
    Dimension 1: every spring is a piece of the same rope.
    """

    kind: Literal["chain"] = "chain"
    length: LengthMetres = 1.0
    """Length from the first vertex to the last [m]."""
    direction: Annotated[tuple[float, float, float], AfterValidator(_require_nonzero)] = (1.0, 0.0, 0.0)
    """Direction of the chain, of any length but zero."""

    SIZE_MEANING: ClassVar[str] = "vertices along the chain"
    SPRINGS_PER_VERTEX: ClassVar[int] = 1

    def count_vertices(self, size: int) -> int:
        """Return the number of vertices of a mesh of this size."""
        return size

    def generate_mesh(self, size: int) -> Mesh:
        """Generate the mesh of a valid size."""
        direction = np.array(self.direction) / np.max(np.abs(self.direction))
        direction /= np.linalg.norm(direction)
        rest = np.linspace(0.0, self.length, size)[:, None] * direction
        pairs = build_offset_pairs(np.arange(size), (1,))
        return assemble_mesh(
            rest_positions=rest,
            springs={STRETCH: pairs, BEND: self._bend_pairs(size)},
            vertex_weights=lump_lengths(rest, pairs),
            dimension=1,
            spacing=self.length / (size - 1),
            resolution=size,
            parts={"first": [0], "last": [size - 1], "ends": [0, size - 1]},
        )

    def _bend_pairs(self, size: int) -> IndexArray:
        """Return the pairs of the springs against bending (k, 2)."""
        return NO_PAIRS


class RopeMesh(ChainMesh):
    """A chain with additional springs from each vertex to the next but one (BEND), against bending."""

    kind: Literal["rope"] = "rope"  # pyright: ignore[reportIncompatibleVariableOverride]

    SPRINGS_PER_VERTEX: ClassVar[int] = 2

    def _bend_pairs(self, size: int) -> IndexArray:
        return build_offset_pairs(np.arange(size), (2,))
