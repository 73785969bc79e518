"""Building blocks of meshes: pairs on lattices and polygons, triangles, lumped weights, parts.

Vertices are numbered through index arrays: `index[r, c]` is the vertex in row r and column c of a lattice.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray
from springbench.harness.scenes.mesh.mesh import BEND, SHEAR, STRETCH, Mesh, sort_unique_vertices

PointArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]

NO_PAIRS: IndexArray = np.empty((0, 2), np.int64)
NO_TRIANGLES: IndexArray = np.empty((0, 3), np.int64)


def build_offset_pairs(index: IndexArray, *offsets: tuple[int, ...]) -> IndexArray:
    """Build the pairs (v, v + offset) of a lattice, (k, 2).

    They are ordered by offset, then by v.

    Args:
        index: vertices of the lattice, of any dimension; pairs that leave it are omitted.
        *offsets: index offsets, each with one component for each dimension.
    """
    pairs = [NO_PAIRS]
    for offset in offsets:
        steps = list(zip(offset, index.shape, strict=True))
        first = index[tuple(slice(max(0, -o), n - max(0, o)) for o, n in steps)]
        second = index[tuple(slice(max(0, o), n - max(0, -o)) for o, n in steps)]
        pairs.append(np.stack([first.ravel(), second.ravel()], axis=1))
    return np.concatenate(pairs)


def build_lattice_triangles(index: IndexArray) -> IndexArray:
    """Build two triangles per cell of a lattice, (f, 3).

    Cells are split from [r, c] to [r+1, c+1]. Normals are the cross product of the directions of increasing r and c.
    """
    a, b, c, d = (x.ravel() for x in (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]))
    return np.stack([a, c, d, a, d, b], axis=1).reshape(-1, 3)


def build_capped_triangles(rings: IndexArray, first: int, last: int) -> IndexArray:
    """Build the triangles (f, 3) of a lattice of rings that two end points close.

    Args:
        rings: vertices (r, k) of r rings; the last column equals the first.
        first, last: end points next to the first ring and to the last one.
    """
    begin = np.column_stack([np.full(rings.shape[1] - 1, first), rings[0, :-1], rings[0, 1:]])
    end = np.column_stack([np.full(rings.shape[1] - 1, last), rings[-1, 1:], rings[-1, :-1]])
    return np.concatenate([begin, build_lattice_triangles(rings), end])


def sort_unique_pairs(pairs: IndexArray) -> IndexArray:
    """Sort unordered pairs, each once, the lower vertex first, in lexicographic order, (k, 2)."""
    if not len(pairs):
        return NO_PAIRS
    i, j = pairs.T
    base = int(pairs.max()) + 1
    # np.unique would hash the codes, which is ten times slower.
    codes: IndexArray = np.sort(np.minimum(i, j) * base + np.maximum(i, j))
    return np.stack(np.divmod(codes[np.diff(codes, prepend=-1) > 0], base), axis=1)


def list_polygon_sides(polygons: IndexArray) -> IndexArray:
    """Return the sides of polygons of k corners, (f, k), as pairs (f k, 2), with repetitions."""
    return np.stack([polygons, np.roll(polygons, -1, axis=1)], axis=2).reshape(-1, 2)


def list_polygon_corner_pairs(polygons: IndexArray) -> IndexArray:
    """Return all pairs of corners of polygons (f, k).

    Shape (f k (k-1)/2, 2), with repetitions.
    """
    i, j = np.triu_indices(polygons.shape[1], 1)
    return np.stack([polygons[:, i], polygons[:, j]], axis=2).reshape(-1, 2)


def split_into_fans(polygons: IndexArray) -> IndexArray:
    """Split polygons (f, k) into fans of triangles from their first corner.

    Shape (f (k-2), 3).
    """
    k = np.arange(1, polygons.shape[1] - 1, dtype=np.int64)
    first = np.repeat(polygons[:, :1], len(k), axis=1)
    return np.stack([first, polygons[:, k], polygons[:, k + 1]], axis=2).reshape(-1, 3)


def lump_to_vertices(cells: IndexArray, measure: PointArray, n: int) -> PointArray:
    """Distribute the measure of each cell equally to its corners.

    Args:
        cells: corners (f, k).
        measure: lengths, areas or volumes (f,) of the cells.
        n: number of vertices.

    Returns:
        Weights (n,) of the vertices, in the unit of the measure; 0 at vertices without a cell.
    """
    corners = cells.shape[1]
    weights = np.bincount(cells.ravel(), np.repeat(measure / corners, corners), minlength=n)
    return weights.astype(np.float64, copy=False)


def lump_lengths(rest: PointArray, pairs: IndexArray) -> PointArray:
    """Lump half the length of each spring to its vertices, (n,) [m].

    Args:
        rest: rest positions (n, 3) [m].
        pairs: springs (m, 2).
    """
    return lump_to_vertices(pairs, np.linalg.norm(rest[pairs[:, 0]] - rest[pairs[:, 1]], axis=1), len(rest))


def lump_areas(rest: PointArray, triangles: IndexArray) -> PointArray:
    """Lump a third of the area of each triangle to its vertices, (n,) [m^2].

    This is barycentric lumping.

    Args:
        rest: rest positions (n, 3) [m].
        triangles: vertex indices (f, 3).
    """
    a, b, c = (rest[triangles[:, k]] for k in range(3))
    return lump_to_vertices(triangles, np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2, len(rest))


def compute_area_normals(rest: PointArray, triangles: IndexArray) -> tuple[PointArray, PointArray]:
    """Compute the area normals (f, 3) of triangles, and their sums at vertices (n, 3) [m^2].

    The length of a normal is twice the area of its triangle.

    Args:
        rest: rest positions (n, 3) [m].
        triangles: vertex indices (f, 3).
    """
    a, b, c = (rest[triangles[:, k]] for k in range(3))
    of_triangles, of_vertices = np.cross(b - a, c - a), np.zeros_like(rest)
    for k in range(3):
        np.add.at(of_vertices, triangles[:, k], of_triangles)
    return of_triangles, of_vertices


def lump_volumes(rest: PointArray, tetrahedra: IndexArray) -> PointArray:
    """Lump a quarter of the volume of each tetrahedron to its vertices, (n,) [m^3].

    Args:
        rest: rest positions (n, 3) [m].
        tetrahedra: vertex indices (t, 4), in either orientation.
    """
    return lump_to_vertices(tetrahedra, np.abs(compute_signed_volumes(rest, tetrahedra)), len(rest))


def find_connected_parts(num_vertices: int, pairs: IndexArray) -> IndexArray:
    """Return the number of the connected part of each vertex, (n,).

    Parts are numbered in the order of their first vertices.

    Args:
        num_vertices: n; a vertex without a pair is a part.
        pairs: connected pairs of vertices (m, 2).
    """
    from scipy.sparse import coo_array  # imported only when parts are needed
    from scipy.sparse.csgraph import connected_components

    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(num_vertices, num_vertices))
    return np.asarray(connected_components(graph, directed=False)[1], np.int64)


def compute_signed_volumes(rest: PointArray, tetrahedra: IndexArray) -> PointArray:
    """Compute the signed volume of each tetrahedron, (t,) [m^3].

    Args:
        rest: rest positions (n, 3) [m].
        tetrahedra: vertex indices (t, 4); the volume is positive if corner 3 sees 0, 1, 2 counter-clockwise.
    """
    a, b, c, d = (rest[tetrahedra[:, k]] for k in range(4))
    return np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a) / 6


def find_box_parts(rest: PointArray) -> dict[str, IndexArray]:
    """Find the vertices on the sides of the bounding box.

    The tolerance is a millionth of its diagonal.
    """
    low, high = rest.min(axis=0), rest.max(axis=0)
    near = 1e-6 * np.linalg.norm(high - low)
    names = (("left", "right"), ("bottom", "top"), ("back", "front"))
    parts: dict[str, IndexArray] = {}
    for axis, (lower, upper) in enumerate(names):
        parts[lower] = np.flatnonzero(rest[:, axis] <= low[axis] + near)
        parts[upper] = np.flatnonzero(rest[:, axis] >= high[axis] - near)
    return parts


def assemble_mesh(
    *,
    rest_positions: PointArray,
    springs: Mapping[str, IndexArray],
    triangles: IndexArray = NO_TRIANGLES,
    vertex_weights: PointArray | None = None,
    dimension: int = 1,
    spacing: float | None = None,
    resolution: int = 0,
    parts: Mapping[str, ArrayLike] | None = None,
    vertex_areas: PointArray | None = None,
    spring_areas: PointArray | None = None,
    file_numbers: IndexArray | None = None,
    attributes: Mapping[str, PointArray] | None = None,
) -> Mesh:
    """Assemble a mesh from vertices and springs by family.

    Args:
        rest_positions: (n, 3) [m].
        springs: springs of each family, (k, 2) vertex indices.
        triangles: (f, 3) vertex indices; by default none.
        vertex_weights: (n,), proportional to the vertex masses; by default half the total length of adjacent springs.
        dimension: 1 chain and truss, 2 cloth, 3 solid.
        spacing: typical rest length [m]; by default the mean spring length.
        resolution: mesh size, usually vertices per side.
        parts: named sets of vertices.
        vertex_areas: (n,) [m^2] if they are not thirds of the triangles.
        spring_areas: (m,) [m^2], in the order of the springs; volumes [m^3] in solids.
        file_numbers: (n,), number of each vertex in the mesh's file.
        attributes: vertex attributes, each (n,).

    Returns:
        The mesh; its springs are those of STRETCH, then of SHEAR, then of BEND.

    Example:
        >>> import numpy as np
        >>> mesh = springbench.assemble_mesh(
        ...     rest_positions=np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [3.0, 0.0, 0.0]]),
        ...     springs={"stretch": np.array([[0, 1], [1, 2]])},
        ...     parts={"start": [0]},
        ... )

        >>> mesh.mass_fractions.tolist()
        [0.16666666666666666, 0.5, 0.3333333333333333]
    """
    blocks = [springs.get(family, NO_PAIRS) for family in (STRETCH, SHEAR, BEND)]
    pairs = np.concatenate(blocks)
    vertex_weights = lump_lengths(rest_positions, pairs) if vertex_weights is None else vertex_weights
    if spacing is None:
        spacing = float(np.linalg.norm(rest_positions[pairs[:, 0]] - rest_positions[pairs[:, 1]], axis=1).mean())
    ends: list[int] = np.cumsum([0, *map(len, blocks)]).tolist()
    return Mesh(
        rest_positions=np.ascontiguousarray(rest_positions, np.float64),
        springs=pairs,
        spring_families={f: np.arange(ends[k], ends[k + 1]) for k, f in enumerate((STRETCH, SHEAR, BEND))},
        triangles=triangles.copy(),
        mass_fractions=vertex_weights / vertex_weights.sum(),
        dimension=dimension,
        spacing=spacing,
        resolution=resolution,
        parts={
            name: sort_unique_vertices(np.asarray(part, np.int64), len(rest_positions))
            for name, part in (parts or {}).items()
        },
        vertex_areas=vertex_areas,
        spring_areas=spring_areas,
        file_numbers=file_numbers,
        attributes=dict(attributes or {}),
    )
