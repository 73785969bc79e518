"""Rectangular sheets: a cloth on a square grid (Liu et al. 2013's curtain) and an open net of ropes."""

from __future__ import annotations

import math
from typing import ClassVar, Literal

import numpy as np
from springbench.harness.scenes.mesh.mesh import BEND, SHEAR, STRETCH, Mesh
from springbench.harness.scenes.mesh.mesh_generator import LengthMetres, MeshGenerator, count_cells
from springbench.harness.scenes.mesh.mesh_topology import (
    IndexArray,
    PointArray,
    assemble_mesh,
    build_lattice_triangles,
    build_offset_pairs,
    lump_areas,
    lump_lengths,
)

_DIAGONAL_OFFSETS: dict[str, tuple[tuple[int, int], ...]] = {"none": (), "one": ((1, 1),), "both": ((1, 1), (1, -1))}


class _SheetMesh(MeshGenerator):
    """A rectangle, centred on the vertical axis x = z = 0; row 0 is its top."""

    width: LengthMetres = 1.0
    """Width along x [m]."""
    height: LengthMetres = 1.0
    """Height from the top row to the bottom row [m]."""
    plane: Literal["horizontal", "vertical"] = "horizontal"
    """Horizontal at y = 0 with the top towards -z, or hanging from y = 0 in the plane z = 0."""

    def _place_vertices(self, across: PointArray, down: PointArray) -> PointArray:
        """Compute positions (n, 3) [m] from fractions of the width and of the height, (n,) each."""
        x, zero = self.width * (across - 0.5), np.zeros_like(across)
        if self.plane == "vertical":
            return np.stack([x, -self.height * down, zero], axis=1)
        return np.stack([x, zero, self.height * (down - 0.5)], axis=1)


def _name_sides(top: IndexArray, bottom: IndexArray, left: IndexArray, right: IndexArray) -> dict[str, IndexArray]:
    """Name the sides of a sheet, each in order along it, and their unions."""
    return {
        "top": top,
        "bottom": bottom,
        "left": left,
        "right": right,
        "boundary": np.concatenate([top, bottom, left, right]),
        "top_corners": top[[0, -1]],
        "corners": np.concatenate([top[[0, -1]], bottom[[0, -1]]]),
    }


class GridMesh(_SheetMesh):
    """A cloth of near-square cells, `size` vertices along its width.

    Vertices are numbered row by row from the top. Springs: along rows, along columns (STRETCH); the diagonals down to
    the right, then down to the left (SHEAR); from a vertex to the next but one along rows, then along columns (BEND).
    81 x 81 vertices with one diagonal and skip-one springs have the 32,158 springs of the curtain of Liu et al. 2013.
    Parts: top, bottom, left, right, boundary, corners, top_corners. Mass is proportional to area. Dimension 2.
    """

    kind: Literal["grid"] = "grid"
    diagonals: Literal["none", "one", "both"] = "both"
    """Diagonal springs per cell, against shear."""
    bend_springs: bool = False
    """Springs from a vertex to the next but one, against bending."""

    SIZE_MEANING: ClassVar[str] = "vertices along its width"
    SPRINGS_PER_VERTEX: ClassVar[int] = 4

    def count_vertices(self, size: int) -> int:
        """Return the number of vertices of a mesh of this size."""
        return size * self._count_rows(size)

    def _count_rows(self, size: int) -> int:
        return count_cells(self.height, self.width / (size - 1)) + 1

    def generate_mesh(self, size: int) -> Mesh:
        """Generate the mesh of a valid size."""
        rows = self._count_rows(size)
        index = np.arange(rows * size).reshape(rows, size)
        down, across = np.meshgrid(np.linspace(0, 1, rows), np.linspace(0, 1, size), indexing="ij")
        rest = self._place_vertices(across.ravel(), down.ravel())
        triangles = build_lattice_triangles(index)
        return assemble_mesh(
            rest_positions=rest,
            springs={
                STRETCH: build_offset_pairs(index, (0, 1), (1, 0)),
                SHEAR: build_offset_pairs(index, *_DIAGONAL_OFFSETS[self.diagonals]),
                BEND: build_offset_pairs(index, *(((0, 2), (2, 0)) if self.bend_springs else ())),
            },
            triangles=triangles,
            vertex_weights=lump_areas(rest, triangles),
            dimension=2,
            spacing=math.sqrt(self.width / (size - 1) * self.height / (rows - 1)),
            resolution=size,
            parts=_name_sides(index[0], index[-1], index[:, 0], index[:, -1]),
        )


class NetMesh(_SheetMesh):
    """A net of ropes: diagonal square meshes, and a rope along the boundary.

    The meshes stand on a corner. The net has no triangles. `size` knots along its top. Rows of `size` knots alternate
    with rows of `size - 1` knots half a mesh lower; knots are numbered row by row. Springs, all STRETCH: from each knot
    of the short rows up left, up right, down left, down right (one direction after another), then along top, bottom,
    left, right. Parts: top, bottom, left, right, boundary, corners, top_corners. Mass is proportional to length.
    Dimension 2, so that a net with finer meshes has the same stretch: its ropes are thinner.
    """

    kind: Literal["net"] = "net"

    SIZE_MEANING: ClassVar[str] = "knots along its top"
    SPRINGS_PER_VERTEX: ClassVar[int] = 2

    def count_vertices(self, size: int) -> int:
        """Return the number of vertices of a mesh of this size."""
        meshes = self._count_mesh_rows(size)
        return size * (meshes + 1) + (size - 1) * meshes

    def _count_mesh_rows(self, size: int) -> int:
        """Return the number of mesh rows from top to bottom."""
        return count_cells(self.height, self.width / (size - 1))

    def generate_mesh(self, size: int) -> Mesh:
        """Generate the mesh of a valid size."""
        meshes, period = self._count_mesh_rows(size), 2 * size - 1
        full = period * np.arange(meshes + 1)[:, None] + np.arange(size)
        short = period * np.arange(meshes)[:, None] + np.arange(size, period)
        rest = np.empty((self.count_vertices(size), 3))
        for knots, shift in ((full, 0.0), (short, 0.5)):
            down, across = np.indices(knots.shape) + shift
            rest[knots.ravel()] = self._place_vertices(across.ravel() / (size - 1), down.ravel() / meshes)
        ends = (full[:-1, :-1], full[:-1, 1:], full[1:, :-1], full[1:, 1:])
        ropes = np.concatenate([np.stack([short.ravel(), end.ravel()], axis=1) for end in ends])
        around = [full[0], full[-1], full[:, 0], full[:, -1]]
        pairs = np.concatenate([ropes, *(build_offset_pairs(side, (1,)) for side in around)])
        return assemble_mesh(
            rest_positions=rest,
            springs={STRETCH: pairs},
            vertex_weights=lump_lengths(rest, pairs),
            dimension=2,
            spacing=0.5 * math.hypot(self.width / (size - 1), self.height / meshes),
            resolution=size,
            parts=_name_sides(*around),
        )
