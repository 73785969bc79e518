"""Closest points of point-triangle and edge-edge pairs.

The functions are inlined kernels, for floats or 8-lane packets.

    z = sum_i c_i x_i        from the closest point of one to that of the other, over four vertices x_0 .. x_3

A point x_0 and a triangle x_1 x_2 x_3 have c_0 = 1; edges x_0 x_1 and x_2 x_3 have c = (1 - s, s, t - 1, -t). |z|^2 is
a convex quadratic function of the local coordinates. If its minimum lies inside, it gives the closest points; else they
lie on the boundary, which consists of points and edges (Ericson 2005, Real-Time Collision Detection, chapter 5). There
some c_i are exactly zero, and only there: the nonzero ones give the vertices that the closest points depend on.
"""

from __future__ import annotations

from solvers.compiling import inner
from solvers.vectors.eights import ratio, root, where

_FLAT = 1e-16
"""Threshold of |u x v|^2 / (|u|^2 |v|^2) below which edges count as parallel, or a triangle as degenerate."""


@inner
def at(p, i):
    """Return row i of p as three floats."""
    return p[i, 0], p[i, 1], p[i, 2]


@inner
def minus(a, b):
    """Return a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@inner
def dot(a, b):
    """Return the dot product of a and b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inner
def cross(a, b):
    """Return the cross product of a and b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inner
def _along(w, u):
    """Return the closest place of w on an edge u, in [0, 1], and the squared distance; both start at one end."""
    length, t = dot(u, u), dot(u, w)
    t = where(t <= 0.0, 0.0, where(t >= length, 1.0, ratio(t, length)))
    d = w[0] - t * u[0], w[1] - t * u[1], w[2] - t * u[2]
    return t, dot(d, d)


@inner
def point_triangle(x, a, b, c):
    """Return the coefficients c_1, c_2, c_3 of a point and a triangle."""
    u, v, w = minus(b, a), minus(c, a), minus(x, a)
    n = cross(u, v)
    area = dot(n, n)
    # Vector products instead of scalar ones: the latter cancel for needle-shaped triangles.
    s, t = ratio(dot(n, cross(w, v)), area), ratio(dot(n, cross(u, w)), area)
    inside = (area > _FLAT * dot(u, u) * dot(v, v)) & (s > 0.0) & (t > 0.0) & (s + t < 1.0)
    one, least = _along(w, u)
    c1, c2, c3 = one - 1.0, 0.0 - one, 0.0 * one
    more, far = _along(w, v)
    nearer, least = far < least, where(far < least, far, least)
    c1, c2, c3 = where(nearer, more - 1.0, c1), where(nearer, 0.0, c2), where(nearer, 0.0 - more, c3)
    more, far = _along(minus(x, b), minus(c, b))
    nearer = far < least
    c1, c2, c3 = where(nearer, 0.0, c1), where(nearer, more - 1.0, c2), where(nearer, 0.0 - more, c3)
    return where(inside, s + t - 1.0, c1), where(inside, 0.0 - s, c2), where(inside, 0.0 - t, c3)


@inner
def edge_edge(a, b, c, d):
    """Return s and t of the closest points of two edges, and |u x v|^2."""
    u, v, w = minus(b, a), minus(d, c), minus(a, c)
    n = cross(u, v)
    area = dot(n, n)
    s, t = ratio(dot(n, cross(v, w)), area), ratio(dot(n, cross(u, w)), area)
    flat = _FLAT * dot(u, u) * dot(v, v)
    inside = (area > flat) & (s > 0.0) & (s < 1.0) & (t > 0.0) & (t < 1.0)
    two, least = _along(w, v)
    one = 0.0 * two
    more, far = _along(minus(b, c), v)
    nearer, least = far < least, where(far < least, far, least)
    one, two = where(nearer, 1.0, one), where(nearer, more, two)
    more, far = _along(minus(c, a), u)
    nearer, least = far < least, where(far < least, far, least)
    one, two = where(nearer, more, one), where(nearer, 0.0, two)
    more, far = _along(minus(d, a), u)
    nearer = far < least
    one, two = where(nearer, more, one), where(nearer, 1.0, two)
    return where(inside, s, one), where(inside, t, two), area


@inner
def point_triangle_way(x, a, b, c):
    """Return c_0 .. c_3 and the distance vector z of a point and a triangle."""
    c1, c2, c3 = point_triangle(x, a, b, c)
    return 1.0 + 0.0 * c1, c1, c2, c3, _between(x, a, b, c, c1, c2, c3)


@inner
def edge_edge_way(a, b, c, d):
    """Return c_0 .. c_3 and the distance vector z of two edges, and |u x v|^2."""
    s, t, area = edge_edge(a, b, c, d)
    return 1.0 - s, s, t - 1.0, 0.0 - t, _between(a, b, c, d, s, t - 1.0, 0.0 - t), area


@inner
def _between(o, i, j, k, c1, c2, c3):
    """Return z of four vertices from differences, since all c add up to zero."""
    i, j, k = minus(i, o), minus(j, o), minus(k, o)
    return (
        c1 * i[0] + c2 * j[0] + c3 * k[0],
        c1 * i[1] + c2 * j[1] + c3 * k[1],
        c1 * i[2] + c2 * j[2] + c3 * k[2],
    )


@inner
def distance(p, x, edges):
    """Return the distance |z| of the pair with the vertices x (4,)."""
    a, b, c, d = at(p, x[0]), at(p, x[1]), at(p, x[2]), at(p, x[3])
    z = edge_edge_way(a, b, c, d)[4] if edges else point_triangle_way(a, b, c, d)[4]
    return root(dot(z, z))
