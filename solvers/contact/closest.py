"""The closest points of a point and a triangle, and of two edges: inner kernels.

    z = sum_i c_i x_i        from the closest point of one to that of the other, over four vertices x_0 .. x_3

A point x_0 and a triangle x_1 x_2 x_3 have c_0 = 1; edges x_0 x_1 and x_2 x_3 have c = (1 - s, s, t - 1, -t). |z|^2 is
a convex parabola of the places on both: where its minimum lies inside, that is it; else the minimum lies on the border,
which is points and edges (Ericson 2005, Real-Time Collision Detection, chapter 5). A place that is free moves c along
one of `WAYS`; -1 stands for none.
"""

from __future__ import annotations

import numpy as np

from solvers.compiling import inner

WAYS = np.array([[0.0, 1.0, -1.0, 0.0], [0.0, 1.0, 0.0, -1.0], [0.0, 0.0, 1.0, -1.0], [-1.0, 1.0, 0.0, 0.0]])
"""How c changes with a place: along x_2 x_1, x_3 x_1, x_3 x_2, and x_0 x_1."""

_FLAT = 1e-16
"""Of |u|^2 |v|^2: a smaller |u x v|^2 is that of parallel edges, or of a triangle without area."""


@inner
def along(p, i, j, k):
    """Where on the edge from j to k the point i is nearest: from 0 to 1, and the squared distance."""
    u0, u1, u2 = p[k, 0] - p[j, 0], p[k, 1] - p[j, 1], p[k, 2] - p[j, 2]
    w0, w1, w2 = p[i, 0] - p[j, 0], p[i, 1] - p[j, 1], p[i, 2] - p[j, 2]
    length = u0 * u0 + u1 * u1 + u2 * u2
    t = u0 * w0 + u1 * w1 + u2 * w2
    t = 0.0 if t <= 0.0 else 1.0 if t >= length else t / length
    d0, d1, d2 = w0 - t * u0, w1 - t * u1, w2 - t * u2
    return t, d0 * d0 + d1 * d1 + d2 * d2


@inner
def _product(n0, n1, n2, a0, a1, a2, b0, b1, b2):
    """n (a x b)."""
    return n0 * (a1 * b2 - a2 * b1) + n1 * (a2 * b0 - a0 * b2) + n2 * (a0 * b1 - a1 * b0)


@inner
def point_triangle(p, i, a, b, c):
    """c_1, c_2, c_3, and the ways that are free, two or fewer."""
    u0, u1, u2 = p[b, 0] - p[a, 0], p[b, 1] - p[a, 1], p[b, 2] - p[a, 2]
    v0, v1, v2 = p[c, 0] - p[a, 0], p[c, 1] - p[a, 1], p[c, 2] - p[a, 2]
    w0, w1, w2 = p[i, 0] - p[a, 0], p[i, 1] - p[a, 1], p[i, 2] - p[a, 2]
    uu, vv = u0 * u0 + u1 * u1 + u2 * u2, v0 * v0 + v1 * v1 + v2 * v2
    n0, n1, n2 = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
    area = n0 * n0 + n1 * n1 + n2 * n2
    if area > _FLAT * uu * vv:
        # By products of vectors, for those of scalars cancel where a triangle is a needle.
        s = _product(n0, n1, n2, w0, w1, w2, v0, v1, v2) / area
        t = _product(n0, n1, n2, u0, u1, u2, w0, w1, w2) / area
        if s > 0.0 and t > 0.0 and s + t < 1.0:
            return s + t - 1.0, -s, -t, 0, 1
    t, least = along(p, i, a, b)
    c1, c2, c3, way = t - 1.0, -t, 0.0, 0
    more, far = along(p, i, a, c)
    if far < least:
        t, least, c1, c2, c3, way = more, far, more - 1.0, 0.0, -more, 1
    more, far = along(p, i, b, c)
    if far < least:
        t, least, c1, c2, c3, way = more, far, 0.0, more - 1.0, -more, 2
    return c1, c2, c3, way if 0.0 < t < 1.0 else -1, -1


@inner
def edge_edge(p, a, b, c, d):
    """s, t, and the ways that are free, two or fewer."""
    u0, u1, u2 = p[b, 0] - p[a, 0], p[b, 1] - p[a, 1], p[b, 2] - p[a, 2]
    v0, v1, v2 = p[d, 0] - p[c, 0], p[d, 1] - p[c, 1], p[d, 2] - p[c, 2]
    w0, w1, w2 = p[a, 0] - p[c, 0], p[a, 1] - p[c, 1], p[a, 2] - p[c, 2]
    uu, vv = u0 * u0 + u1 * u1 + u2 * u2, v0 * v0 + v1 * v1 + v2 * v2
    n0, n1, n2 = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
    area = n0 * n0 + n1 * n1 + n2 * n2
    if area > _FLAT * uu * vv:
        s = _product(n0, n1, n2, v0, v1, v2, w0, w1, w2) / area
        t = _product(n0, n1, n2, u0, u1, u2, w0, w1, w2) / area
        if 0.0 < s < 1.0 and 0.0 < t < 1.0:
            return s, t, 3, 2
    t, least = along(p, a, c, d)
    s, way = 0.0, 2 if 0.0 < t < 1.0 else -1
    more, far = along(p, b, c, d)
    if far < least:
        s, t, least, way = 1.0, more, far, 2 if 0.0 < more < 1.0 else -1
    more, far = along(p, c, a, b)
    if far < least:
        s, t, least, way = more, 0.0, far, 3 if 0.0 < more < 1.0 else -1
    more, far = along(p, d, a, b)
    if far < least:
        s, t, least, way = more, 1.0, far, 3 if 0.0 < more < 1.0 else -1
    return s, t, way, -1


@inner
def closest(p, x, edges):
    """c_0 .. c_3 of four vertices x (4,), and the free ways; edges: whether they are two edges."""
    if edges:
        s, t, first, second = edge_edge(p, x[0], x[1], x[2], x[3])
        return 1.0 - s, s, t - 1.0, -t, first, second
    c1, c2, c3, first, second = point_triangle(p, x[0], x[1], x[2], x[3])
    return 1.0, c1, c2, c3, first, second


@inner
def between(p, x, c1, c2, c3):
    """z (3) of four vertices x (4,), from differences: all c add up to zero."""
    o, i, j, k = x[0], x[1], x[2], x[3]
    o0, o1, o2 = p[o, 0], p[o, 1], p[o, 2]
    return (
        c1 * (p[i, 0] - o0) + c2 * (p[j, 0] - o0) + c3 * (p[k, 0] - o0),
        c1 * (p[i, 1] - o1) + c2 * (p[j, 1] - o1) + c3 * (p[k, 1] - o1),
        c1 * (p[i, 2] - o2) + c2 * (p[j, 2] - o2) + c3 * (p[k, 2] - o2),
    )


@inner
def distance(p, x, edges):
    """|z| of four vertices x (4,)."""
    _, c1, c2, c3, _, _ = closest(p, x, edges)
    z0, z1, z2 = between(p, x, c1, c2, c3)
    return np.sqrt(z0 * z0 + z1 * z1 + z2 * z2)
