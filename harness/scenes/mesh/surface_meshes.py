"""Closed and wrapped surfaces: a skirt (truncated cone) and a balloon (geodesic sphere)."""

from __future__ import annotations

import math
from typing import ClassVar, Literal, cast

import numpy as np
from springbench.harness.scenes.mesh.mesh import SHEAR, STRETCH, Mesh
from springbench.harness.scenes.mesh.mesh_generator import LengthMetres, MeshGenerator, count_cells
from springbench.harness.scenes.mesh.mesh_topology import (
    IndexArray,
    PointArray,
    assemble_mesh,
    build_lattice_triangles,
    build_offset_pairs,
    list_polygon_sides,
    lump_areas,
    sort_unique_pairs,
)


class SkirtMesh(MeshGenerator):
    """A truncated cone that hangs from y = 0, `size` vertices around.

    Vertices are numbered ring by ring from the waist. Rings run counter-clockwise as viewed from above. Springs: along
    rings, down (STRETCH), then the diagonals down forwards and down backwards (SHEAR). Triangles face outwards. Cells
    are near-square at half height. Parts: top (the waist), bottom (the hem). Mass is proportional to area. Dimension 2.
    """

    kind: Literal["skirt"] = "skirt"
    top_radius: LengthMetres = 0.15
    """Radius of the waist [m]."""
    bottom_radius: LengthMetres = 0.5
    """Radius of the hem [m]."""
    height: LengthMetres = 0.6
    """Height from the waist down to the hem [m]."""

    MIN_SIZE: ClassVar[int] = 3
    SIZE_MEANING: ClassVar[str] = "vertices around"
    SPRINGS_PER_VERTEX: ClassVar[int] = 4

    def count_vertices(self, size: int) -> int:
        """Return the number of vertices of a mesh of this size."""
        return size * (self._measure_cells(size)[0] + 1)

    def _measure_cells(self, size: int) -> tuple[int, float]:
        """Return the number of cells from waist to hem, and their typical side [m]."""
        slant = math.hypot(self.height, self.bottom_radius - self.top_radius)
        around = math.pi * (self.top_radius + self.bottom_radius) / size
        rows = count_cells(slant, around)
        return rows, math.sqrt(around * slant / rows)

    def generate_mesh(self, size: int) -> Mesh:
        """Generate the mesh of a valid size."""
        rows, spacing = self._measure_cells(size)
        index = np.arange((rows + 1) * size).reshape(rows + 1, size)
        closed = np.column_stack([index, index[:, 0]])
        down = np.linspace(0, 1, rows + 1)[:, None]
        angle = np.linspace(0, 2 * np.pi, size, endpoint=False)
        radius = self.top_radius + (self.bottom_radius - self.top_radius) * down
        x, y, z = np.broadcast_arrays(radius * np.cos(angle), -self.height * down, -radius * np.sin(angle))
        rest = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)
        triangles = build_lattice_triangles(closed)
        return assemble_mesh(
            rest_positions=rest,
            springs={
                STRETCH: np.concatenate([build_offset_pairs(closed, (0, 1)), build_offset_pairs(index, (1, 0))]),
                SHEAR: build_offset_pairs(closed, (1, 1), (1, -1)),
            },
            triangles=triangles,
            vertex_weights=lump_areas(rest, triangles),
            dimension=2,
            spacing=spacing,
            resolution=size,
            parts={"top": index[0], "bottom": index[-1]},
        )


class BalloonMesh(MeshGenerator):
    """A geodesic sphere around the origin: an icosahedron whose edges are divided into `size` parts.

    10 size^2 + 2 vertices: the icosahedron's corners from top to bottom, then those on its edges, then those
    in its faces. Springs, all STRETCH: the sides of the triangles in lexicographic order. Triangles face
    outwards. Parts: pole_top, pole_bottom (one vertex each). Mass is proportional to area. Dimension 2.
    """

    kind: Literal["balloon"] = "balloon"
    radius: LengthMetres = 0.5
    """Radius [m]."""

    MIN_SIZE: ClassVar[int] = 1
    SIZE_MEANING: ClassVar[str] = "springs along an edge of the icosahedron"
    SPRINGS_PER_VERTEX: ClassVar[int] = 3

    def count_vertices(self, size: int) -> int:
        """Return the number of vertices of a mesh of this size."""
        return 10 * size**2 + 2

    def generate_mesh(self, size: int) -> Mesh:
        """Generate the mesh of a valid size."""
        corners, faces = _build_icosahedron()
        index, weights, cells_of_face = _divide_faces(faces, size)
        rest = np.empty((self.count_vertices(size), 3))
        rest[index] = np.einsum("tc,fcx->ftx", weights / size, corners[faces])
        rest *= self.radius / np.linalg.norm(rest, axis=1, keepdims=True)
        triangles = index[:, cells_of_face].reshape(-1, 3)
        pairs = sort_unique_pairs(list_polygon_sides(triangles))
        return assemble_mesh(
            rest_positions=rest,
            springs={STRETCH: pairs},
            triangles=triangles,
            vertex_weights=lump_areas(rest, triangles),
            dimension=2,
            spacing=float(np.linalg.norm(rest[pairs[:, 0]] - rest[pairs[:, 1]], axis=1).mean()),
            resolution=size,
            parts={"pole_top": [0], "pole_bottom": [len(corners) - 1]},
        )


def _build_icosahedron() -> tuple[PointArray, IndexArray]:
    """Build corners (12, 3) on the unit sphere: pole, two rings, pole; and faces (20, 3), outwards."""
    k = np.arange(5)
    angle = 2 * np.pi / 5 * np.concatenate([k, k + 0.5])
    y = np.repeat([1.0, -1.0], 5) / math.sqrt(5)
    rings = np.stack([2 / math.sqrt(5) * np.cos(angle), y, -2 / math.sqrt(5) * np.sin(angle)], axis=1)
    corners = np.concatenate([[[0, 1, 0]], rings, [[0, -1, 0]]])
    upper, next_upper, lower, next_lower = 1 + k, 1 + (k + 1) % 5, 6 + k, 6 + (k + 1) % 5
    top, bottom = np.zeros_like(k), np.full_like(k, 11)
    groups = (
        (top, upper, next_upper),
        (upper, lower, next_upper),
        (next_upper, lower, next_lower),
        (bottom, next_lower, lower),
    )
    return corners, np.concatenate([np.stack(group, axis=1) for group in groups])


def _divide_faces(faces: IndexArray, size: int) -> tuple[IndexArray, IndexArray, IndexArray]:
    """Subdivide the faces of an icosahedron into points and triangles.

    The points of a face are in the order of (i, j), i + j <= size, with i towards corner 1 and j towards corner 2.

    Returns:
        The vertices of the points (20, t), their weights of the face's corners (t, 3), which sum to `size`, and
        the triangles of a face (size^2, 3), indices into its t points. Faces share the vertices on their edges.
    """
    i, j = np.nonzero(np.tri(size + 1, dtype=bool)[::-1])
    weights = np.stack([size - i - j, i, j], axis=1)
    edges = sort_unique_pairs(list_polygon_sides(faces))
    edge_of = np.zeros((12, 12), np.int64)
    edge_of[edges[:, 0], edges[:, 1]] = edge_of[edges[:, 1], edges[:, 0]] = np.arange(len(edges))

    inside = np.flatnonzero(np.all(weights > 0, axis=1))
    index = np.empty((len(faces), len(weights)), np.int64)
    first = 12 + len(edges) * (size - 1)
    index[:, inside] = first + np.arange(len(faces) * len(inside)).reshape(len(faces), -1)
    for corner in range(3):
        p, q = (corner + 1) % 3, (corner + 2) % 3
        index[:, weights[:, corner] == size] = faces[:, [corner]]
        on_edge = np.flatnonzero((weights[:, corner] == 0) & (weights[:, p] > 0) & (weights[:, q] > 0))
        start, end = faces[:, [p]], faces[:, [q]]
        along = cast(IndexArray, np.where(start < end, weights[on_edge, q], weights[on_edge, p]))
        index[:, on_edge] = 12 + edge_of[start, end] * (size - 1) + along - 1

    point = np.zeros((size + 1, size + 1), np.int64)
    point[i, j] = np.arange(len(i))
    i, j = i[i + j < size], j[i + j < size]
    pointing_up = np.stack([point[i, j], point[i + 1, j], point[i, j + 1]], axis=1)
    i, j = i[i + j < size - 1], j[i + j < size - 1]
    pointing_down = np.stack([point[i + 1, j], point[i + 1, j + 1], point[i, j + 1]], axis=1)
    return index, weights, np.concatenate([pointing_up, pointing_down])
