"""Closest points of point-triangle and edge-edge pairs.

The functions are inlined kernels, for floats or 8-lane packets.

    z = sum_i c_i x_i        from the closest point of the second to that of the first, over four vertices x_0 .. x_3

A point x_0 and a triangle x_1 x_2 x_3 have c_0 = 1; edges x_0 x_1 and x_2 x_3 have c = (1 - s, s, t - 1, -t). |z|^2 is
a convex quadratic function of the local coordinates. If its minimum lies inside, it gives the closest points; else they
lie on the boundary, which consists of points and edges (Ericson 2005, Real-Time Collision Detection, chapter 5). There
some c_i are exactly zero, and only there: the nonzero ones give the vertices that the closest points depend on.
"""

from __future__ import annotations

from springbench.solvers.jit.kernel_compilation import jit_inner
from springbench.solvers.simd.float64x8 import divide_packet, sqrt_packet, where

_PARALLEL_THRESHOLD = 1e-16
"""Threshold of |u x v|^2 / (|u|^2 |v|^2) below which edges count as parallel, or a triangle as degenerate."""


@jit_inner
def load_point(p, i):
    """Return row i of p as three floats.

    Args:
        p: points, (n, 3) or padded (n, 4).
        i: index of the row.
    """
    return p[i, 0], p[i, 1], p[i, 2]


@jit_inner
def subtract3(a, b):
    """Return a - b.

    Args:
        a, b: three floats or packets each.
    """
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@jit_inner
def dot3(a, b):
    """Return the dot product of a and b.

    Args:
        a, b: three floats or packets each.
    """
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@jit_inner
def cross3(a, b):
    """Return the cross product of a and b.

    Args:
        a, b: three floats or packets each.
    """
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@jit_inner
def _project_onto_edge(w, u):
    """Return the parameter of an edge's closest point to w, and the squared distance.

    The parameter is in [0, 1]. The vector w and the edge u start at the same point.
    """
    length, t = dot3(u, u), dot3(u, w)
    t = where(t <= 0.0, 0.0, where(t >= length, 1.0, divide_packet(t, length)))
    d = w[0] - t * u[0], w[1] - t * u[1], w[2] - t * u[2]
    return t, dot3(d, d)


@jit_inner
def point_triangle_closest_point(x, a, b, c):
    """Return the coefficients c_1, c_2, c_3 of a point and a triangle.

    Args:
        x: the point [m], three floats or packets.
        a, b, c: corners of the triangle [m], likewise.

    Returns:
        Negative barycentric coordinates of the closest point, which add up to -1.
    """
    u, v, w = subtract3(b, a), subtract3(c, a), subtract3(x, a)
    n = cross3(u, v)
    area = dot3(n, n)
    # Vector products instead of scalar ones: the latter cancel for needle-shaped triangles.
    s, t = divide_packet(dot3(n, cross3(w, v)), area), divide_packet(dot3(n, cross3(u, w)), area)
    inside = (area > _PARALLEL_THRESHOLD * dot3(u, u) * dot3(v, v)) & (s > 0.0) & (t > 0.0) & (s + t < 1.0)
    one, least = _project_onto_edge(w, u)
    c1, c2, c3 = one - 1.0, 0.0 - one, 0.0 * one
    more, far = _project_onto_edge(w, v)
    nearer, least = far < least, where(far < least, far, least)
    c1, c2, c3 = where(nearer, more - 1.0, c1), where(nearer, 0.0, c2), where(nearer, 0.0 - more, c3)
    more, far = _project_onto_edge(subtract3(x, b), subtract3(c, b))
    nearer = far < least
    c1, c2, c3 = where(nearer, 0.0, c1), where(nearer, more - 1.0, c2), where(nearer, 0.0 - more, c3)
    return where(inside, s + t - 1.0, c1), where(inside, 0.0 - s, c2), where(inside, 0.0 - t, c3)


@jit_inner
def edge_edge_closest_point(a, b, c, d):
    """Return the parameters of the closest points on two edges.

    Args:
        a, b: ends of one edge [m], three floats or packets each.
        c, d: ends of the other edge [m], likewise.

    Returns:
        s and t in [0, 1], from a to b and from c to d, and |u x v|^2 [m^4] of the edges u and v.
    """
    u, v, w = subtract3(b, a), subtract3(d, c), subtract3(a, c)
    n = cross3(u, v)
    area = dot3(n, n)
    s, t = divide_packet(dot3(n, cross3(v, w)), area), divide_packet(dot3(n, cross3(u, w)), area)
    flat = _PARALLEL_THRESHOLD * dot3(u, u) * dot3(v, v)
    inside = (area > flat) & (s > 0.0) & (s < 1.0) & (t > 0.0) & (t < 1.0)
    two, least = _project_onto_edge(w, v)
    one = 0.0 * two
    more, far = _project_onto_edge(subtract3(b, c), v)
    nearer, least = far < least, where(far < least, far, least)
    one, two = where(nearer, 1.0, one), where(nearer, more, two)
    more, far = _project_onto_edge(subtract3(c, a), u)
    nearer, least = far < least, where(far < least, far, least)
    one, two = where(nearer, more, one), where(nearer, 0.0, two)
    more, far = _project_onto_edge(subtract3(d, a), u)
    nearer = far < least
    one, two = where(nearer, more, one), where(nearer, 1.0, two)
    return where(inside, s, one), where(inside, t, two), area


@jit_inner
def point_triangle_distance_vector(x, a, b, c):
    """Return the distance vector z from a triangle to a point.

    Args:
        x: the point x_0 [m], three floats or packets.
        a, b, c: corners x_1, x_2, x_3 of the triangle [m], likewise.

    Returns:
        c_0, c_1, c_2, c_3 and z [m].
    """
    c1, c2, c3 = point_triangle_closest_point(x, a, b, c)
    return 1.0 + 0.0 * c1, c1, c2, c3, _combine_vertices(x, a, b, c, c1, c2, c3)


@jit_inner
def edge_edge_distance_vector(a, b, c, d):
    """Return the distance vector z from the second of two edges to the first.

    Args:
        a, b: ends x_0, x_1 of the first edge [m], three floats or packets each.
        c, d: ends x_2, x_3 of the second edge [m], likewise.

    Returns:
        c_0, c_1, c_2, c_3, z [m] and |u x v|^2 [m^4] of the edges u and v.
    """
    s, t, area = edge_edge_closest_point(a, b, c, d)
    return 1.0 - s, s, t - 1.0, 0.0 - t, _combine_vertices(a, b, c, d, s, t - 1.0, 0.0 - t), area


@jit_inner
def _combine_vertices(o, i, j, k, c1, c2, c3):
    """Return z of four vertices from differences, since all c add up to zero."""
    i, j, k = subtract3(i, o), subtract3(j, o), subtract3(k, o)
    return (
        c1 * i[0] + c2 * j[0] + c3 * k[0],
        c1 * i[1] + c2 * j[1] + c3 * k[1],
        c1 * i[2] + c2 * j[2] + c3 * k[2],
    )


@jit_inner
def compute_pair_distance(p, x, edges):
    """Return the distance |z| [m] of a pair.

    Args:
        p: positions [m], (n, 3) or padded (n, 4).
        x: vertices of the pair (4,).
        edges: True for an edge-edge pair, False for a point-triangle pair.
    """
    a, b, c, d = load_point(p, x[0]), load_point(p, x[1]), load_point(p, x[2]), load_point(p, x[3])
    z = edge_edge_distance_vector(a, b, c, d)[4] if edges else point_triangle_distance_vector(a, b, c, d)[4]
    return sqrt_packet(dot3(z, z))
