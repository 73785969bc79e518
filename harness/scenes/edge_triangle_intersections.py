"""Exact intersection tests of meshes, edges against triangles, independent of all solver code.

Two convex bodies are disjoint if an axis separates them. For an edge and a triangle the candidate axes are the normal,
the cross products of the edge with the sides, and in the plane the normals of the sides and of the edge. If one of them
shows a gap beyond round-off, the bodies are disjoint. The remaining pairs are decided by signs of determinants (Guigue
and Devillers 2003), in rational arithmetic where round-off could change one (Shewchuk 1997); contact without overlap
counts as an intersection. Pairs that share a vertex are excluded.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise, product
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]
Intersection = tuple[tuple[int, int], tuple[int, int, int]]

_ROUNDOFF = 64.0 * np.finfo(np.float64).eps
"""Round-off relative to the coordinates of the pair: a larger gap along a unit axis is significant."""

_DETERMINANT_ROUNDOFF = 16.0 * np.finfo(np.float64).eps
"""Round-off of a determinant relative to the sum of its products' magnitudes; Shewchuk proves 3.5."""

_SMALLEST_VOLUME = 1e-250
"""Volume [m^3] below which products may underflow."""

_PAIRS_PER_CHUNK = 200_000
"""Approximate number of pairs tested per chunk, for 64 triangles near each edge."""

_MAX_EXHAUSTIVE_PAIRS = 500_000
"""Number of pairs up to which all boxes are compared: that takes 10 ms at most, and the import of a tree 0.2 s."""


@dataclass(frozen=True, eq=False)
class IntersectionCheck:
    """Primitives that must not intersect.

    Attributes:
        edges_and_triangles: edges (m, 2) and triangles (f, 3) to test against each other, each pair once; vertices of
            the mesh, followed by those of `obstacle_positions`.
        obstacle_positions: returns the obstacle vertices (o, 3) [m] at a time [s].
    """

    edges_and_triangles: tuple[tuple[IndexArray, IndexArray], ...]
    obstacle_positions: Callable[[float], FloatArray] | None = None

    def find_intersections(self, p: FloatArray, time: float) -> list[Intersection]:
        """Return the edges that intersect triangles.

        Args:
            p: positions of the mesh (n, 3) [m].
            time: [s].
        """
        every = p if self.obstacle_positions is None else np.concatenate([p, self.obstacle_positions(time)])
        return [
            found
            for edges, triangles in self.edges_and_triangles
            for found in find_edge_triangle_intersections(every, edges, triangles)
        ]


def find_edge_triangle_intersections(p: FloatArray, edges: IndexArray, triangles: IndexArray) -> list[Intersection]:
    """Return the edges that intersect triangles, with those triangles, sorted.

    Args:
        p: positions (n, 3) [m].
        edges: (m, 2).
        triangles: (f, 3).
    """
    found: list[Intersection] = []
    if not (len(edges) and len(triangles)):
        return found
    if not np.isfinite(p).all():
        raise ValueError("positions should be finite to decide whether they intersect")
    for e, t in _overlapping_box_pairs(p, edges, triangles):
        is_open = ~_has_separating_axis(p, edges[e], triangles[t])
        e, t = e[is_open], t[is_open]
        for k, is_certain in enumerate(_intersects_certainly(p, edges[e], triangles[t]).tolist()):
            edge, corners = edges[e[k]].tolist(), triangles[t[k]].tolist()
            if is_certain or edge_intersects_triangle(
                [_to_fractions(p[i]) for i in edge], [_to_fractions(p[i]) for i in corners]
            ):
                found.append(((edge[0], edge[1]), (corners[0], corners[1], corners[2])))
    return sorted(found)


def _overlapping_box_pairs(
    p: FloatArray, edges: IndexArray, triangles: IndexArray
) -> Iterator[tuple[IndexArray, IndexArray]]:
    """Yield chunks of edge-triangle pairs, by index, with overlapping boxes and no common vertex."""
    a, b = p[edges], p[triangles]
    list_near = _list_near_boxes if len(edges) * len(triangles) <= _MAX_EXHAUSTIVE_PAIRS else _list_near_spheres
    low, high, below, above = a.min(axis=1), a.max(axis=1), b.min(axis=1), b.max(axis=1)
    for e, t in list_near(a, b):
        over = ((low[e] <= above[t]) & (below[t] <= high[e])).all(axis=1)
        over &= (edges[e][:, :, None] != triangles[t][:, None, :]).all(axis=(1, 2))
        yield e[over], t[over]


def _list_near_boxes(a: FloatArray, b: FloatArray) -> Iterator[tuple[IndexArray, IndexArray]]:
    """Yield the edges a (m, 2, 3) and triangles b (f, 3, 3) with overlapping boxes, by index."""
    near = np.ones((len(a), len(b)), bool)
    for x, y in zip(a.T, b.T, strict=True):  # coordinates
        near &= np.less_equal.outer(x.min(axis=0), y.max(axis=0))
        near &= np.greater_equal.outer(x.max(axis=0), y.min(axis=0))
    e, t = np.nonzero(near)
    yield e, t


def _list_near_spheres(a: FloatArray, b: FloatArray) -> Iterator[tuple[IndexArray, IndexArray]]:
    """Yield chunks of edges a (m, 2, 3) and triangles b (f, 3, 3) whose bounding spheres overlap, by index."""
    from scipy.spatial import cKDTree  # slow to import

    middle, centre = a.mean(axis=1), b.mean(axis=1)
    half = np.linalg.norm(a - middle[:, None], axis=2).max(axis=1)
    wide = np.linalg.norm(b - centre[:, None], axis=2).max(axis=1)
    tree: Any = cKDTree(centre)
    reach = (half + float(wide.max())) * (1.0 + 1e-9) + _ROUNDOFF * max(float(np.abs(a).max()), float(np.abs(b).max()))
    step = max(1, _PAIRS_PER_CHUNK // 64)
    for first in range(0, len(a), step):
        part = slice(first, first + step)
        lists: list[list[int]] = tree.query_ball_point(middle[part], reach[part]).tolist()
        e = np.repeat(np.arange(first, first + len(lists)), [len(x) for x in lists])
        yield e, np.array([one for found in lists for one in found], np.int64)


def _has_separating_axis(p: FloatArray, edges: IndexArray, triangles: IndexArray) -> NDArray[np.bool_]:
    """Return which pairs (k, 2) and (k, 3) have a separating axis, beyond round-off."""
    if not len(edges):
        return np.empty(0, bool)
    origin = p[triangles[:, 0]]
    a, b = p[edges] - origin[:, None], p[triangles] - origin[:, None]
    along = a[:, 1] - a[:, 0]
    sides = np.stack([b[:, 1] - b[:, 0], b[:, 2] - b[:, 1], b[:, 0] - b[:, 2]])
    normal = np.cross(sides[0], sides[1])
    axes = [normal, np.cross(along, normal), *np.cross(along, sides), *np.cross(normal, sides)]
    size = np.abs(p[edges]).max(axis=(1, 2)) + np.abs(p[triangles]).max(axis=(1, 2))
    apart = np.zeros(len(edges), bool)
    for axis in axes:
        length = np.linalg.norm(axis, axis=1)
        unit = axis / np.where(length > 0.0, length, 1.0)[:, None]
        one, two = np.einsum("kij,kj->ki", a, unit), np.einsum("kij,kj->ki", b, unit)
        gap = np.maximum(one.min(axis=1) - two.max(axis=1), two.min(axis=1) - one.max(axis=1))
        apart |= gap > _ROUNDOFF * size
    return apart


def _intersects_certainly(p: FloatArray, edges: IndexArray, triangles: IndexArray) -> NDArray[np.bool_]:
    """Return which pairs (k, 2) and (k, 3) intersect in the interior of both, regardless of round-off."""
    a, b = p[edges[:, 0]], p[edges[:, 1]]
    u, v, w = (p[triangles[:, k]] for k in range(3))
    sides = _certain_sign(u, v, w, a) * _certain_sign(u, v, w, b)
    turns = [_certain_sign(a, b, one, two) for one, two in ((u, v), (v, w), (w, u))]
    return (sides < 0.0) & (np.abs(sum(turns)) == 3.0)


def _certain_sign(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> FloatArray:
    """Return the signs (k,) of the volumes of tetrahedra with corners (k, 3).

    A sign is 0 where round-off could change it.
    """
    u, v, w = b - a, c - a, d - a
    volume = np.einsum("ij,ij->i", u, np.cross(v, w))
    products = np.abs(v[:, [1, 2, 0]] * w[:, [2, 0, 1]]) + np.abs(v[:, [2, 0, 1]] * w[:, [1, 2, 0]])
    bound = _DETERMINANT_ROUNDOFF * np.einsum("ij,ij->i", np.abs(u), products) + _SMALLEST_VOLUME
    return np.where(np.abs(volume) > bound, np.sign(volume), 0.0)


ExactPoint = tuple[Fraction, Fraction, Fraction]


def _to_fractions(x: FloatArray) -> ExactPoint:
    return Fraction(float(x[0])), Fraction(float(x[1])), Fraction(float(x[2]))


def edge_intersects_triangle(edge: list[ExactPoint], triangle: list[ExactPoint]) -> bool:
    """Return whether an edge and a triangle intersect, in rational arithmetic.

    Args:
        edge: end points, two.
        triangle: corners, three; they may lie on a line.
    """
    a, b = edge
    u, v, w = triangle
    above, below = _signed_volume(u, v, w, a), _signed_volume(u, v, w, b)
    if above * below > 0:
        return False
    if above != 0 or below != 0:
        turns = [_signed_volume(a, b, one, two) for one, two in ((u, v), (v, w), (w, u))]
        return min(turns) >= 0 or max(turns) <= 0
    # Coplanar points, or a degenerate triangle: they intersect if their projections along each axis overlap.
    return all(
        _convex_polygons_overlap(_project_along_axis(edge, k), _project_along_axis(triangle, k)) for k in range(3)
    )


def _signed_volume(a: ExactPoint, b: ExactPoint, c: ExactPoint, d: ExactPoint) -> Fraction:
    (u0, u1, u2), (v0, v1, v2), (w0, w1, w2) = (tuple(x - y for x, y in zip(q, a, strict=True)) for q in (b, c, d))
    return u0 * (v1 * w2 - v2 * w1) - u1 * (v0 * w2 - v2 * w0) + u2 * (v0 * w1 - v1 * w0)


ExactPoint2D = tuple[Fraction, Fraction]


def _project_along_axis(points: list[ExactPoint], axis: int) -> list[ExactPoint2D]:
    return [(q[axis - 1], q[axis - 2]) for q in points]


def _convex_polygons_overlap(edge: list[ExactPoint2D], triangle: list[ExactPoint2D]) -> bool:
    """Return whether convex polygons in the plane overlap: no line along a side separates them."""
    sides = [*pairwise([*triangle, triangle[0]]), (edge[0], edge[1])]
    for (a, b), swap in product(sides, (False, True)):
        n = (b[0] - a[0], b[1] - a[1]) if swap else (a[1] - b[1], b[0] - a[0])
        one, two = ([n[0] * q[0] + n[1] * q[1] for q in figure] for figure in (edge, triangle))
        if any(n) and (max(one) < min(two) or max(two) < min(one)):
            return False
    return True
