"""Offset blocks: which pairs of nearby features are in contact in offset geometric contact (OGC).

A surface is thickened by a block at each of its features: a triangle's along its normal, an edge's and a vertex's where
no neighbouring feature is closer. A point x is in the block of

    vertex i    if (x - x_i) . (x_i - x_j) >= 0 for all its neighbours j
    edge ij     if (x - q) . (q - x_k) >= 0 for the third vertex k of all its triangles, q = foot of x_k on the line

and its closest point on an edge is not one of its ends. A candidate pair is in contact if its closest features are in
these blocks of each other: those of both vertices if a point is closest to a corner of a triangle, that of the edge if
it is closest to an edge, and that of each end that is closest in a pair of edges. Forces are then perpendicular to the
faces in contact. Source: Chen et al. 2025, "Offset geometric contact", ACM TOG 44(4); the conditions are those of
`ipctk.ogc`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.contact.geometry.distance import (
    compute_pair_distance,
    dot3,
    edge_edge_distance_vector,
    load_point,
    point_triangle_distance_vector,
    subtract3,
)
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_kernel
from springbench.solvers.model.system_matrix_assembly import compute_row_starts

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]


class SurfaceAdjacency(NamedTuple):
    """Neighbours of the vertices of surfaces.

    Attributes:
        edge_starts: first entry of each vertex in `neighbours` (n + 1,).
        neighbours: vertices that share an edge.
        triangle_starts: first entry of each vertex in `opposite_edges` (n + 1,).
        opposite_edges: the other two vertices of each triangle, (., 2).
    """

    edge_starts: IndexArray
    neighbours: IndexArray
    triangle_starts: IndexArray
    opposite_edges: IndexArray

    @classmethod
    def from_primitives(cls, edges: IndexArray, triangles: IndexArray, num_vertices: int) -> SurfaceAdjacency:
        """Build the adjacency of edges and triangles.

        Args:
            edges: vertex indices (m, 2).
            triangles: vertex indices (f, 3); those that repeat a vertex are edges, and ignored here.
            num_vertices: number of vertices n.
        """
        ends = np.concatenate([edges, edges[:, ::-1]])
        triangles = triangles[(np.diff(np.sort(triangles, axis=1), axis=1) > 0).all(axis=1)]
        corners = np.concatenate([np.roll(triangles, -k, axis=1) for k in range(3)])
        by_edge, by_triangle = (np.argsort(one[:, 0], kind="stable") for one in (ends, corners))
        return cls(
            compute_row_starts(ends[:, 0], num_vertices),
            np.ascontiguousarray(ends[by_edge, 1]),
            compute_row_starts(corners[:, 0], num_vertices),
            np.ascontiguousarray(corners[by_triangle, 1:]),
        )


@jit_inner
def _is_in_vertex_block(adjacency, x, i, p):
    """Return whether a point p is in the block of vertex i."""
    centre = load_point(x, i)
    away = subtract3(p, centre)
    for entry in range(adjacency.edge_starts[i], adjacency.edge_starts[i + 1]):
        if dot3(away, subtract3(centre, load_point(x, adjacency.neighbours[entry]))) < 0.0:
            return False
    return True


@jit_inner
def _is_in_edge_block(adjacency, x, i, j, p):
    """Return whether p is in the block of edge ij.

    The closest point to p must be in the interior of the edge.
    """
    begin = load_point(x, i)
    u = subtract3(load_point(x, j), begin)
    length = dot3(u, u)
    for entry in range(adjacency.triangle_starts[i], adjacency.triangle_starts[i + 1]):
        one, other = adjacency.opposite_edges[entry, 0], adjacency.opposite_edges[entry, 1]
        if one != j and other != j:
            continue
        third = load_point(x, other if one == j else one)
        t = dot3(subtract3(third, begin), u) / length if length > 0.0 else 0.0
        foot = begin[0] + t * u[0], begin[1] + t * u[1], begin[2] + t * u[2]
        if dot3(subtract3(p, foot), subtract3(foot, third)) < 0.0:
            return False
    return True


@jit_inner
def _is_point_triangle_contact(adjacency, x, v, c1, c2, c3):
    """Return whether vertex v[0] and a triangle's closest feature are in each other's blocks."""
    p = load_point(x, v[0])
    if c1 != 0.0 and c2 != 0.0 and c3 != 0.0:
        return True
    first, second = (v[1] if c1 != 0.0 else v[2] if c2 != 0.0 else v[3]), -1
    if c1 != 0.0 and c2 != 0.0:
        second = v[2]
    elif c3 != 0.0 and (c1 != 0.0 or c2 != 0.0):
        second = v[3]
    if second < 0 or second == first:
        return _is_in_vertex_block(adjacency, x, first, p) and _is_in_vertex_block(
            adjacency, x, v[0], load_point(x, first)
        )
    return _is_in_edge_block(adjacency, x, first, second, p)


@jit_inner
def _is_edge_edge_contact(adjacency, x, v, s, t):
    """Return whether the closest features of two edges v (4,) are in each other's blocks."""
    one_end = -1 if 0.0 < s < 1.0 else v[0] if s <= 0.0 else v[1]
    other_end = -1 if 0.0 < t < 1.0 else v[2] if t <= 0.0 else v[3]
    a, b, c, d = load_point(x, v[0]), load_point(x, v[1]), load_point(x, v[2]), load_point(x, v[3])
    p = a[0] + s * (b[0] - a[0]), a[1] + s * (b[1] - a[1]), a[2] + s * (b[2] - a[2])
    q = c[0] + t * (d[0] - c[0]), c[1] + t * (d[1] - c[1]), c[2] + t * (d[2] - c[2])
    return (one_end < 0 or _is_in_vertex_block(adjacency, x, one_end, q)) and (
        other_end < 0 or _is_in_vertex_block(adjacency, x, other_end, p)
    )


@jit_inner
def _is_contact(adjacency, x, v, edges):
    """Return whether the closest features of a pair v (4,) are in each other's blocks."""
    a, b, c, d = load_point(x, v[0]), load_point(x, v[1]), load_point(x, v[2]), load_point(x, v[3])
    if edges:
        _, s, _, minus_t, _, _ = edge_edge_distance_vector(a, b, c, d)
        return _is_edge_edge_contact(adjacency, x, v, s, 0.0 - minus_t)
    _, c1, c2, c3, _ = point_triangle_distance_vector(a, b, c, d)
    return _is_point_triangle_contact(adjacency, x, v, c1, c2, c3)


@jit_kernel
def find_offset_contacts(adjacency, candidates, x, reach, bound_fraction, gap, is_contact, clearance):
    """Find the pairs in contact, or that bounded displacements may bring into contact, and clearances.

    Args:
        adjacency: neighbours of all vertices.
        candidates: candidate pairs, whose `dhat` is the contact radius.
        x: positions (n, 4) [m]; column 3 is padding.
        reach: gap [m] beyond which pairs are ignored.
        bound_fraction: displacement bound of a vertex relative to its clearance.
        gap: output (k,), distance beyond the minimum distance of each pair [m].
        is_contact: output (k,).
        clearance: (n,) [m], lowered to the smallest gap of all pairs of a vertex.
    """
    for e in range(len(candidates.vertices)):
        v = candidates.vertices[e]
        d = compute_pair_distance(x, v, e >= candidates.num_point_triangle)
        gap[e] = d - candidates.distance_scale[e] * candidates.min_distance
        for k in range(4):
            clearance[v[k]] = min(clearance[v[k]], gap[e])
    for e in range(len(candidates.vertices)):
        v, edges = candidates.vertices[e], e >= candidates.num_point_triangle
        one, other = clearance[v[0]], max(clearance[v[2]], clearance[v[3]])
        if edges:
            one = max(one, clearance[v[1]])
        else:
            other = max(other, clearance[v[1]])
        farthest = candidates.distance_scale[e] * candidates.dhat + bound_fraction * (one + other)
        is_contact[e] = gap[e] < min(reach, farthest) and _is_contact(adjacency, x, v, edges)
