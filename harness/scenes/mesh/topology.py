"""Building blocks of meshes: pairs on lattices and polygons, triangles, lumped weights, parts.

Vertices are numbered through index arrays: `index[r, c]` is the vertex in row r and column c of a lattice.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from harness.scenes.mesh.base import BEND, SHEAR, STRETCH, Mesh, distinct

Points = NDArray[np.float64]
Indices = NDArray[np.int64]

NO_PAIRS: Indices = np.empty((0, 2), np.int64)
NO_TRIANGLES: Indices = np.empty((0, 3), np.int64)


def offset_pairs(index: Indices, *offsets: tuple[int, ...]) -> Indices:
    """Build the pairs (v, v + offset) of a lattice, (k, 2).

    They are ordered by offset, then by v.
    """
    pairs = [NO_PAIRS]
    for offset in offsets:
        steps = list(zip(offset, index.shape, strict=True))
        first = index[tuple(slice(max(0, -o), n - max(0, o)) for o, n in steps)]
        second = index[tuple(slice(max(0, o), n - max(0, -o)) for o, n in steps)]
        pairs.append(np.stack([first.ravel(), second.ravel()], axis=1))
    return np.concatenate(pairs)


def lattice_triangles(index: Indices) -> Indices:
    """Build two triangles per cell of a lattice, (f, 3).

    Cells are split from [r, c] to [r+1, c+1]; the normals are rows x columns.
    """
    a, b, c, d = (x.ravel() for x in (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]))
    return np.stack([a, c, d, a, d, b], axis=1).reshape(-1, 3)


def closed_by_points(rings: Indices, first: int, last: int) -> Indices:
    """Build the triangles of a lattice of rings (r, k) with two end points.

    The last column of the rings equals the first.
    """
    begin = np.column_stack([np.full(rings.shape[1] - 1, first), rings[0, :-1], rings[0, 1:]])
    end = np.column_stack([np.full(rings.shape[1] - 1, last), rings[-1, 1:], rings[-1, :-1]])
    return np.concatenate([begin, lattice_triangles(rings), end])


def unique_pairs(pairs: Indices) -> Indices:
    """Sort unordered pairs, each once, the lower vertex first, in lexicographic order, (k, 2)."""
    if not len(pairs):
        return NO_PAIRS
    i, j = pairs.T
    base = int(pairs.max()) + 1
    codes: Indices = np.sort(np.minimum(i, j) * base + np.maximum(i, j))  # np.unique hashes them, ten times slower
    return np.stack(np.divmod(codes[np.diff(codes, prepend=-1) > 0], base), axis=1)


def sides(polygons: Indices) -> Indices:
    """Return the sides of polygons of k corners, (f, k), as pairs (f k, 2), with repetitions."""
    return np.stack([polygons, np.roll(polygons, -1, axis=1)], axis=2).reshape(-1, 2)


def corner_pairs(polygons: Indices) -> Indices:
    """Return all pairs of corners of polygons (f, k).

    Shape (f k (k-1)/2, 2), with repetitions.
    """
    i, j = np.triu_indices(polygons.shape[1], 1)
    return np.stack([polygons[:, i], polygons[:, j]], axis=2).reshape(-1, 2)


def fan(polygons: Indices) -> Indices:
    """Split polygons (f, k) into fans of triangles from their first corner.

    Shape (f (k-2), 3).
    """
    k = np.arange(1, polygons.shape[1] - 1, dtype=np.int64)
    first = np.repeat(polygons[:, :1], len(k), axis=1)
    return np.stack([first, polygons[:, k], polygons[:, k + 1]], axis=2).reshape(-1, 3)


def lump(cells: Indices, measure: Points, n: int) -> Points:
    """Distribute each cell's measure, (f,), equally to its corners, (f, k): vertex weights, (n,)."""
    corners = cells.shape[1]
    weights = np.bincount(cells.ravel(), np.repeat(measure / corners, corners), minlength=n)
    return weights.astype(np.float64, copy=False)


def by_length(rest: Points, pairs: Indices) -> Points:
    """Lump half the length of each spring to its vertices, (n,) [m]."""
    return lump(pairs, np.linalg.norm(rest[pairs[:, 0]] - rest[pairs[:, 1]], axis=1), len(rest))


def by_area(rest: Points, triangles: Indices) -> Points:
    """Lump a third of the area of each triangle to its vertices (barycentric lumping), (n,) [m^2]."""
    a, b, c = (rest[triangles[:, k]] for k in range(3))
    return lump(triangles, np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2, len(rest))


def by_volume(rest: Points, tetrahedra: Indices) -> Points:
    """Lump a quarter of the volume of each tetrahedron to its vertices, (n,) [m^3]."""
    return lump(tetrahedra, np.abs(signed_volumes(rest, tetrahedra)), len(rest))


def signed_volumes(rest: Points, tetrahedra: Indices) -> Points:
    """Compute the volume of each tetrahedron, (t,) [m^3], positive if corner 3 sees 0, 1, 2 counter-clockwise."""
    a, b, c, d = (rest[tetrahedra[:, k]] for k in range(4))
    return np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a) / 6


def box_parts(rest: Points) -> dict[str, Indices]:
    """Find the vertices on the sides of the bounding box, within a millionth of its diagonal."""
    low, high = rest.min(axis=0), rest.max(axis=0)
    near = 1e-6 * np.linalg.norm(high - low)
    names = (("left", "right"), ("bottom", "top"), ("back", "front"))
    parts: dict[str, Indices] = {}
    for axis, (lower, upper) in enumerate(names):
        parts[lower] = np.flatnonzero(rest[:, axis] <= low[axis] + near)
        parts[upper] = np.flatnonzero(rest[:, axis] >= high[axis] - near)
    return parts


def assemble(
    *,
    rest: Points,
    springs: Mapping[str, Indices],
    triangles: Indices = NO_TRIANGLES,
    weights: Points | None = None,
    dimension: int = 1,
    spacing: float | None = None,
    resolution: int = 0,
    parts: Mapping[str, ArrayLike] | None = None,
    areas: Points | None = None,
    first_vertex: int = 0,
    attributes: Mapping[str, Points] | None = None,
) -> Mesh:
    """Assemble a mesh from springs by family, (k, 2) each: first all STRETCH, then all SHEAR, then all BEND.

    Args:
        weights: proportional to the vertex masses; by default half the length of the springs of each.
        spacing: by default the mean spring length.

    The other arguments are attributes of `Mesh`.
    """
    blocks = [springs.get(family, NO_PAIRS) for family in (STRETCH, SHEAR, BEND)]
    pairs = np.concatenate(blocks)
    weights = by_length(rest, pairs) if weights is None else weights
    if spacing is None:
        spacing = float(np.linalg.norm(rest[pairs[:, 0]] - rest[pairs[:, 1]], axis=1).mean())
    ends: list[int] = np.cumsum([0, *map(len, blocks)]).tolist()
    return Mesh(
        rest=np.ascontiguousarray(rest, np.float64),
        springs=pairs,
        families={f: np.arange(ends[k], ends[k + 1]) for k, f in enumerate((STRETCH, SHEAR, BEND))},
        triangles=triangles.copy(),
        shares=weights / weights.sum(),
        dimension=dimension,
        spacing=spacing,
        resolution=resolution,
        parts={name: distinct(np.asarray(part, np.int64), len(rest)) for name, part in (parts or {}).items()},
        areas=areas,
        first_vertex=first_vertex,
        attributes=dict(attributes or {}),
    )
