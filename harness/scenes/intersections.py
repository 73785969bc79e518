"""Exact intersection tests of meshes, edges against triangles, independent of all solver code.

Two convex bodies are disjoint if an axis separates them. For an edge and a triangle the candidate axes are the normal,
the cross products of the edge with the sides, and in the plane the normals of the sides and of the edge. If one of them
shows a gap beyond round-off, the bodies are disjoint. The remaining pairs are decided in rational arithmetic, by signs
of determinants (Guigue and Devillers 2003); contact without overlap counts as an intersection. Pairs that share a
vertex are excluded.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise, product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Crossing = tuple[tuple[int, int], tuple[int, int, int]]

_ROUND = 64.0 * np.finfo(np.float64).eps
"""Round-off relative to the coordinates of the pair: a larger gap along a unit axis is significant."""

_AT_ONCE = 200_000
"""Number of pairs tested per chunk."""


@dataclass(frozen=True, eq=False)
class Apart:
    """Primitives that must not intersect.

    Attributes:
        pairs: edges (m, 2) and triangles (f, 3) to test against each other, each pair once; vertices of
            the mesh, followed by those of `beside`.
        beside: returns the obstacle vertices (o, 3) [m] at a time [s].
    """

    pairs: tuple[tuple[Indices, Indices], ...]
    beside: Callable[[float], Array] | None = None

    def crossings(self, p: Array, time: float) -> list[Crossing]:
        """Return the edges that intersect triangles.

        Args:
            p: positions of the mesh (n, 3) [m].
            time: [s].
        """
        every = p if self.beside is None else np.concatenate([p, self.beside(time)])
        return [found for edges, triangles in self.pairs for found in crossings(every, edges, triangles)]


def crossings(p: Array, edges: Indices, triangles: Indices) -> list[Crossing]:
    """Return the edges that intersect triangles, with those triangles, sorted.

    Args:
        p: positions (n, 3) [m].
        edges: (m, 2).
        triangles: (f, 3).
    """
    found: list[Crossing] = []
    if not (len(edges) and len(triangles)):
        return found
    if not np.isfinite(p).all():
        raise ValueError("positions should be finite to tell whether they intersect")
    for e, t in _near(p, edges, triangles):
        open_ = np.flatnonzero(~_apart(p, edges[e], triangles[t]))
        for k in open_.tolist():
            edge, corners = edges[e[k]].tolist(), triangles[t[k]].tolist()
            if meets([_exact(p[i]) for i in edge], [_exact(p[i]) for i in corners]):
                found.append(((edge[0], edge[1]), (corners[0], corners[1], corners[2])))
    return sorted(found)


def _near(p: Array, edges: Indices, triangles: Indices) -> Iterator[tuple[Indices, Indices]]:
    """Yield chunks of edges and triangles, by index, that share no vertex and have overlapping boxes."""
    a, b = p[edges], p[triangles]
    middle, centre = a.mean(axis=1), b.mean(axis=1)
    half = np.linalg.norm(a - middle[:, None], axis=2).max(axis=1)
    wide = np.linalg.norm(b - centre[:, None], axis=2).max(axis=1)
    tree: Any = cKDTree(centre)
    reach = (half + float(wide.max())) * (1.0 + 1e-9) + _ROUND * float(np.abs(p).max())
    low, high, below, above = a.min(axis=1), a.max(axis=1), b.min(axis=1), b.max(axis=1)
    step = max(1, _AT_ONCE // 64)
    for first in range(0, len(edges), step):
        part = slice(first, first + step)
        lists: list[list[int]] = tree.query_ball_point(middle[part], reach[part]).tolist()
        e = np.repeat(np.arange(first, first + len(lists)), [len(x) for x in lists])
        t = np.array([one for found in lists for one in found], np.int64)
        over = ((low[e] <= above[t]) & (below[t] <= high[e])).all(axis=1)
        over &= (edges[e][:, :, None] != triangles[t][:, None, :]).all(axis=(1, 2))
        yield e[over], t[over]


def _apart(p: Array, edges: Indices, triangles: Indices) -> NDArray[np.bool_]:
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
        apart |= gap > _ROUND * size
    return apart


Point = tuple[Fraction, Fraction, Fraction]


def _exact(x: Array) -> Point:
    return Fraction(float(x[0])), Fraction(float(x[1])), Fraction(float(x[2]))


def meets(edge: list[Point], triangle: list[Point]) -> bool:
    """Return whether an edge (two points) and a triangle (three points) intersect, in rational arithmetic."""
    a, b = edge
    u, v, w = triangle
    above, below = _volume(u, v, w, a), _volume(u, v, w, b)
    if above * below > 0:
        return False
    if above != 0 or below != 0:
        turns = [_volume(a, b, one, two) for one, two in ((u, v), (v, w), (w, u))]
        return min(turns) >= 0 or max(turns) <= 0
    # Coplanar points, or a degenerate triangle: they intersect if their projections along each axis overlap.
    return all(_flat_meet(_seen(edge, k), _seen(triangle, k)) for k in range(3))


def _volume(a: Point, b: Point, c: Point, d: Point) -> Fraction:
    (u0, u1, u2), (v0, v1, v2), (w0, w1, w2) = (tuple(x - y for x, y in zip(q, a, strict=True)) for q in (b, c, d))
    return u0 * (v1 * w2 - v2 * w1) - u1 * (v0 * w2 - v2 * w0) + u2 * (v0 * w1 - v1 * w0)


Flat = tuple[Fraction, Fraction]


def _seen(points: list[Point], axis: int) -> list[Flat]:
    return [(q[axis - 1], q[axis - 2]) for q in points]


def _flat_meet(edge: list[Flat], triangle: list[Flat]) -> bool:
    """Return whether convex polygons in the plane overlap: no line along a side separates them."""
    sides = [*pairwise([*triangle, triangle[0]]), (edge[0], edge[1])]
    for (a, b), swap in product(sides, (False, True)):
        n = (b[0] - a[0], b[1] - a[1]) if swap else (a[1] - b[1], b[0] - a[0])
        one, two = ([n[0] * q[0] + n[1] * q[1] for q in figure] for figure in (edge, triangle))
        if any(n) and (max(one) < min(two) or max(two) < min(one)):
            return False
    return True
