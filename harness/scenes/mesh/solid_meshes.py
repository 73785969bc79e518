"""Solid bodies: a truss tower and a soft block."""

from __future__ import annotations

import math
from functools import reduce
from typing import ClassVar, Literal

import numpy as np
from springbench.harness.scenes.mesh.mesh import SHEAR, STRETCH, Mesh
from springbench.harness.scenes.mesh.mesh_generator import LengthMetres, MeshGenerator, count_cells
from springbench.harness.scenes.mesh.mesh_topology import (
    PointArray,
    assemble_mesh,
    build_lattice_triangles,
    build_offset_pairs,
    find_box_parts,
    lump_lengths,
)


class TowerMesh(MeshGenerator):
    """A truss tower of square, tapering cross-section on the ground y = 0, `size` storeys high.

    Vertices are numbered ring by ring from the base, four per ring, counter-clockwise as viewed from above.
    Members: rings, then legs (STRETCH); both diagonals of each face, then one diagonal across each ring
    (SHEAR). Members are bars, hence dimension 1 (stiffness EA / length). No triangles: wind passes through a
    truss. Parts: base, top. Mass is proportional to length.
    """

    kind: Literal["tower"] = "tower"
    height: LengthMetres = 3.0
    """Height from the base to the top [m]."""
    base_width: LengthMetres = 1.0
    """Side length of the base [m]."""
    top_width: LengthMetres = 0.4
    """Side length of the top [m]."""

    MIN_SIZE: ClassVar[int] = 1
    SIZE_MEANING: ClassVar[str] = "storeys"
    SPRINGS_PER_VERTEX: ClassVar[int] = 4

    def count_vertices(self, size: int) -> int:
        """Return the number of vertices of a mesh of this size."""
        return 4 * (size + 1)

    def generate_mesh(self, size: int) -> Mesh:
        """Generate the mesh of a valid size."""
        index = np.arange(4 * (size + 1)).reshape(size + 1, 4)
        closed = np.column_stack([index, index[:, 0]])
        up = np.linspace(0, 1, size + 1)[:, None]
        half = (self.base_width + (self.top_width - self.base_width) * up) / 2
        x, y, z = np.broadcast_arrays(half * [1, 1, -1, -1], self.height * up, half * [1, -1, -1, 1])
        rest = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)
        springs = {
            STRETCH: np.concatenate([build_offset_pairs(closed, (0, 1)), build_offset_pairs(index, (1, 0))]),
            SHEAR: np.concatenate([build_offset_pairs(closed, (1, 1), (1, -1)), index[:, [0, 2]]]),
        }
        members = np.concatenate([*springs.values()])
        return assemble_mesh(
            rest_positions=rest,
            springs=springs,
            vertex_weights=lump_lengths(rest, members),
            dimension=1,
            spacing=float(np.linalg.norm(rest[members[:, 0]] - rest[members[:, 1]], axis=1).mean()),
            resolution=size,
            parts={"base": index[0], "top": index[-1]},
        )


_FACE_OFFSETS = ((1, 1, 0), (1, -1, 0), (1, 0, 1), (1, 0, -1), (0, 1, 1), (0, 1, -1))
_DIAGONAL_OFFSETS: dict[str, tuple[tuple[int, int, int], ...]] = {
    "one": _FACE_OFFSETS[::2],
    "all": (*_FACE_OFFSETS, (1, 1, 1), (1, 1, -1), (1, -1, 1), (1, -1, -1)),
}


class BlockMesh(MeshGenerator):
    """A soft block on the ground y = 0, `size` vertices along its longest side.

    Cells are near-cubic. Vertices are numbered with z fastest and x slowest. Springs: along x, y, z (STRETCH); the
    diagonals of the faces in x-y, x-z and y-z, then the four diagonals through each cell (SHEAR). Triangles: the
    surface, facing outwards. Parts: left, right, bottom, top, back, front, corners. Mass is proportional to the volume
    of the cells. Dimension 3.
    """

    kind: Literal["block"] = "block"
    length: LengthMetres = 1.0
    """Extent along x [m]."""
    height: LengthMetres = 0.5
    """Extent along y [m]."""
    depth: LengthMetres = 0.5
    """Extent along z [m]."""
    diagonals: Literal["one", "all"] = "all"
    """Diagonal springs: one per face, which is just enough for rigidity, or all on faces and through cells."""

    SIZE_MEANING: ClassVar[str] = "vertices along its longest side"
    SPRINGS_PER_VERTEX: ClassVar[int] = 12

    def count_vertices(self, size: int) -> int:
        """Return the number of vertices of a mesh of this size."""
        return math.prod(self._lattice_shape(size))

    def _side_lengths(self) -> tuple[float, float, float]:
        return self.length, self.height, self.depth

    def _lattice_shape(self, size: int) -> tuple[int, int, int]:
        """Return the number of vertices along x, y and z."""
        spacing = max(self._side_lengths()) / (size - 1)
        x, y, z = (count_cells(side, spacing) + 1 for side in self._side_lengths())
        return x, y, z

    def generate_mesh(self, size: int) -> Mesh:
        """Generate the mesh of a valid size."""
        shape = self._lattice_shape(size)
        index = np.arange(math.prod(shape)).reshape(shape)
        along = [np.linspace(0, 1, n) for n in shape]
        x, y, z = (side * axis for side, axis in zip(self._side_lengths(), along, strict=True))
        grid = np.meshgrid(x - self.length / 2, y, z - self.depth / 2, indexing="ij")
        rest = np.stack([axis.ravel() for axis in grid], axis=1)
        surface = (index[0].T, index[-1], index[:, 0], index[:, -1].T, index[:, :, 0].T, index[:, :, -1])
        return assemble_mesh(
            rest_positions=rest,
            springs={
                STRETCH: build_offset_pairs(index, (1, 0, 0), (0, 1, 0), (0, 0, 1)),
                SHEAR: build_offset_pairs(index, *_DIAGONAL_OFFSETS[self.diagonals]),
            },
            triangles=np.concatenate([build_lattice_triangles(side) for side in surface]),
            vertex_weights=reduce(np.multiply.outer, map(_lumped_lengths, shape)).ravel(),
            dimension=3,
            spacing=math.prod(side / (n - 1) for side, n in zip(self._side_lengths(), shape, strict=True)) ** (1 / 3),
            resolution=size,
            parts={**find_box_parts(rest), "corners": index[:: 1 - shape[0], :: 1 - shape[1], :: 1 - shape[2]]},
        )


def _lumped_lengths(n: int) -> PointArray:
    """Return the length (n,) that each vertex on a line represents, relative to a cell.

    The product over the axes is the volume that a vertex represents.
    """
    return np.where((np.arange(n) == 0) | (np.arange(n) == n - 1), 0.5, 1.0)
