"""Patches that lie as an affine image of their rest shape, seen along some plane: nothing in them can meet.

    x_i = x_P + F_P (X_i - X_P) + y_i,     F_P = f_1 t_1' + f_2 t_2'

X: the rest shape; t_1, t_2: the plane in which a patch P lies there; F_P: the least squares fit, y_i what it leaves.
Let a and b be points of primitives of two patches P and Q, and A and B where they are at rest. With e_1, e_2 of P's
plane, seen from which bending is of second order, and E = (e_1, e_2)'

    |a - b| >= |E (a - b)| >= l |A - B| - z,     l = least eigenvalue of the symmetric part of E F_P (t_1, t_2)
    z = |E (x_Q - x_P - F_P (X_Q - X_P))| + |E (F_Q - F_P)| rho_Q + |E y_i| + |E y_j|

at most, |A - B| less what it has out of the plane. On a straight way E stays, l is concave and z convex, so that what
holds at both ends holds between them. All of it is sums over vertices, which no rotation of a patch changes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import inner, kernel
from solvers.contact.closest import cross, dot, minus
from solvers.contact.contacts import padded
from solvers.vectors.eights import bits, loaded, ratio, root, rows, stored, where

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_THIN = 1e-12
"""Of the square of a patch's length: one that is not even so wide has no plane."""


class Rest(NamedTuple):
    """Patches at rest, in eights: vertices (m, k) of each, the first one repeated where there are fewer; weights
    (k, 3, m): by which a vertex goes into the mean, f_1 and f_2; plane (k, 2, m): where it lies along t_1 and t_2 [m];
    centre, t1, t2, normal (m, 4): X_P [m] and axes; size (m, 4): rho, and how far vertices lie out of the plane [m]."""

    vertices: Indices
    weights: Array
    plane: Array
    centre: Array
    t1: Array
    t2: Array
    normal: Array
    size: Array


class Lie(NamedTuple):
    """How patches lie at a position: centre x_P [m], f1, f2 and their normal (m, 4); rest (m, 4): the largest y_i along
    the plane, and across it [m]."""

    centre: Array
    f1: Array
    f2: Array
    normal: Array
    rest: Array


def rest(x: Array, members: Indices, many: int) -> Rest:
    """Patches at rest, x (n, 3) [m]; members: which have which vertices (k, 2)."""
    patch, vertex = np.unique(members, axis=0).T
    count = np.bincount(patch, minlength=many)
    slot = np.arange(len(patch)) - np.repeat(np.cumsum(count) - count, count)
    wide, eights = int(count.max()), 8 * (-(-many // 8))
    vertices, own = np.zeros((eights, wide), np.int64), np.zeros((eights, wide), bool)
    vertices[:many] = vertex[np.cumsum(count) - count][:, None]
    vertices[patch, slot], own[patch, slot] = vertex, True
    share = own / np.maximum(1, own.sum(axis=1, keepdims=True))
    centre = np.einsum("mk,mkx->mx", share, x[vertices])
    off = np.where(own[:, :, None], x[vertices] - centre[:, None], 0.0)
    axes, spread = np.linalg.eigh(np.einsum("mkx,mky->mxy", off, off))[::-1]
    t1, t2, normal = (np.ascontiguousarray(axes[:, :, k]) for k in (2, 1, 0))
    along = x[vertices] - centre[:, None]
    plane = np.stack([np.einsum("mkx,mx->mk", along, t) for t in (t1, t2)], axis=1)
    fit = [own * plane[:, k] / np.where(spread[:, 2 - k] > _THIN * spread[:, 2], spread[:, 2 - k], np.inf)[:, None]
           for k in (0, 1)]  # fmt: skip
    weights = np.stack([share, *fit], axis=1)
    size = np.zeros((eights, 3))
    size[:, 0] = np.linalg.norm(off, axis=2).max(axis=1)
    size[:, 1] = np.abs(np.einsum("mkx,mx->mk", off, normal)).max(axis=1)
    by_slot = (np.ascontiguousarray(a.transpose(2, 1, 0)) for a in (weights, plane))
    return Rest(vertices, *by_slot, *(padded(a) for a in (centre, t1, t2, normal, size)))


@kernel
def lie(known, x, leaf, boxes, tile, out):
    """Write how patches lie at x (n, 4) to `out`, and their boxes to a tree's leaves from the node `leaf` on. tile
    (3 k, 8): scratch."""
    many, width, last = len(known.centre), known.vertices.shape[1], len(known.vertices) - 1
    for first in range(0, many, 8):
        o = rows(x, known.vertices, first, last, 0)
        zero = 0.0 * o[0]
        centre, f1, f2 = (zero, zero, zero), (zero, zero, zero), (zero, zero, zero)
        low, high = (zero, zero, zero), (zero, zero, zero)
        for k in range(width):
            p = minus(rows(x, known.vertices, first, last, k), o)
            for axis in range(3):
                stored(p[axis], tile, 24 * k + 8 * axis)
            at = 3 * many * k + first
            centre = _added(centre, loaded(known.weights, at), p)
            f1 = _added(f1, loaded(known.weights, at + many), p)
            f2 = _added(f2, loaded(known.weights, at + 2 * many), p)
            low = _least(low[0], p[0]), _least(low[1], p[1]), _least(low[2], p[2])
            high = _most(high[0], p[0]), _most(high[1], p[1]), _most(high[2], p[2])
        e1 = _unit(f1)
        e2 = _unit(_added(f2, 0.0 - dot(f2, e1), e1))
        n = cross(e1, e2)
        along, across = zero, zero
        for k in range(width):
            p = loaded(tile, 24 * k), loaded(tile, 24 * k + 8), loaded(tile, 24 * k + 16)
            at = 2 * many * k + first
            y = _added(minus(p, centre), 0.0 - loaded(known.plane, at), f1)
            y = _added(y, 0.0 - loaded(known.plane, at + many), f2)
            a, b, c = dot(e1, y), dot(e2, y), dot(n, y)
            along, across = _most(along, a * a + b * b), _most(across, c * c)
        _put((centre[0] + o[0], centre[1] + o[1], centre[2] + o[2]), tile, first, out.centre)
        _put(f1, tile, first, out.f1)
        _put(f2, tile, first, out.f2)
        _put(n, tile, first, out.normal)
        _put((root(along), root(across), zero), tile, first, out.rest)
        at = 48 * (leaf + first // 8)
        for axis in range(3):
            stored(low[axis] + o[axis], boxes, at + 8 * axis)
            stored(high[axis] + o[axis], boxes, at + 24 + 8 * axis)


@inner
def _put(v, tile, first, out):
    """Write a vector of eight patches to their rows."""
    for axis in range(3):
        stored(v[axis], tile, 8 * axis)
    for lane in range(8):
        for axis in range(3):
            out[first + lane, axis] = tile[axis, lane]


@kernel
def doubtful(known, begin, end, pairs, count, apart, reach, share, out):
    """Write those of the first pairs of patches (k, 2), at rest `apart` (k,) [m] at least, to `out` whose primitives
    may come nearer than `reach` [m], and `share` of their distance at the begin, on the straight way from how they lie
    at its begin to how they lie at its end; how many."""
    found = 0
    for first in range(0, count, 8):
        left = 255 & ~_clear(known, begin, end, pairs, first, count - 1, loaded(apart, first), reach, share)
        for lane in range(8):
            if left >> lane & 1 and first + lane < count:
                out[found, 0], out[found, 1] = pairs[first + lane, 0], pairs[first + lane, 1]
                found += 1
    return found


@inner
def _clear(known, begin, end, pairs, first, last, apart, reach, share):
    """Which of eight pairs can not, as bits."""
    t1, t2, n = (rows(known.t1, pairs, first, last, 0), rows(known.t2, pairs, first, last, 0),
                 rows(known.normal, pairs, first, last, 0))  # fmt: skip
    u1, u2 = rows(known.t1, pairs, first, last, 1), rows(known.t2, pairs, first, last, 1)
    way = minus(rows(known.centre, pairs, first, last, 1), rows(known.centre, pairs, first, last, 0))
    mine, other = rows(known.size, pairs, first, last, 0), rows(known.size, pairs, first, last, 1)
    tilt1, tilt2 = dot(n, u1), dot(n, u2)
    out = root(dot(n, way) * dot(n, way)) + root(tilt1 * tilt1 + tilt2 * tilt2) * other[0] + mine[1] + other[1]
    turned = dot(t1, way), dot(t2, way), dot(t1, u1), dot(t2, u1), dot(t1, u2), dot(t2, u2), other[0], other[1]
    a1, a2 = rows(begin.f1, pairs, first, last, 0), rows(begin.f2, pairs, first, last, 0)
    b1, b2 = rows(end.f1, pairs, first, last, 0), rows(end.f2, pairs, first, last, 0)
    e1 = _unit((a1[0] + b1[0], a1[1] + b1[1], a1[2] + b1[2]))
    e2 = a2[0] + b2[0], a2[1] + b2[1], a2[2] + b2[2]
    e2 = _unit(_added(e2, 0.0 - dot(e2, e1), e1))
    l, most, z, far = _seen(begin, pairs, first, last, e1, e2, a1, a2, turned)
    m, _, w, _ = _seen(end, pairs, first, last, e1, e2, b1, b2, turned)
    l, m, apart, far = l - share * most, m - share * most, apart - out, share * far
    return bits((apart > 0.0) & (l > 0.0) & (m > 0.0) & (l * apart - z - far >= reach) & (m * apart - w - far >= reach))


@inner
def _seen(lies, pairs, first, last, e1, e2, f1, f2, turned):
    """l, the largest stretch, z, and z without E, of eight pairs; f1, f2: those of the first patch."""
    x1, x2, c11, c21, c12, c22, wide, out = turned
    a, d, b = dot(e1, f1), dot(e2, f2), 0.5 * (dot(e1, f2) + dot(e2, f1))
    least = 0.5 * (a + d) - root(0.25 * (a - d) * (a - d) + b * b)
    a, d, b = dot(f1, f1), dot(f2, f2), dot(f1, f2)
    most = root(0.5 * (a + d) + root(0.25 * (a - d) * (a - d) + b * b))
    c = minus(rows(lies.centre, pairs, first, last, 1), rows(lies.centre, pairs, first, last, 0))
    c = _added(_added(c, 0.0 - x1, f1), 0.0 - x2, f2)
    g1 = _added(_added(rows(lies.f1, pairs, first, last, 1), 0.0 - c11, f1), 0.0 - c21, f2)
    g2 = _added(_added(rows(lies.f2, pairs, first, last, 1), 0.0 - c12, f1), 0.0 - c22, f2)
    mine, other = rows(lies.rest, pairs, first, last, 0), rows(lies.rest, pairs, first, last, 1)
    n, m = rows(lies.normal, pairs, first, last, 0), rows(lies.normal, pairs, first, last, 1)
    z = _length(e1, e2, c) + mine[0] + mine[1] * _length(e1, e2, n) + other[0] + other[1] * _length(e1, e2, m)
    z = z + _norm(_length(e1, e2, g1), _length(e1, e2, g2)) * wide + most * out
    far = root(dot(c, c)) + root(dot(g1, g1) + dot(g2, g2)) * wide + most * out
    return least, most, z, far + mine[0] + mine[1] + other[0] + other[1]


@inner
def _length(e1, e2, v):
    return _norm(dot(e1, v), dot(e2, v))


@inner
def _norm(a, b):
    return root(a * a + b * b)


@inner
def _unit(v):
    size = root(dot(v, v))
    return ratio(v[0], size), ratio(v[1], size), ratio(v[2], size)


@inner
def _added(v, t, w):
    return v[0] + t * w[0], v[1] + t * w[1], v[2] + t * w[2]


@inner
def _least(a, b):
    return where(a < b, a, b)


@inner
def _most(a, b):
    return where(a > b, a, b)
