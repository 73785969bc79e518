"""Patches of a surface as affine images of their rest shape.

    x_i = x_P + F_P (X_i - X_P) + y_i,     F_P = f_1 t_1' + f_2 t_2'

X: the rest shape; t_1, t_2: the plane in which a patch P lies there; F_P: the least squares fit, y_i what it leaves.
All of it is sums over vertices, which no rotation of a patch changes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import inner, kernel
from solvers.contact.boxes import larger, put_boxes, smaller
from solvers.contact.closest import cross, dot, minus
from solvers.contact.contacts import padded
from solvers.vectors.eights import loaded, ratio, root, rows, stored, where

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_THIN = 1e-12
"""Of the square of a patch's length: one that is not even so wide has no plane."""


class Rest(NamedTuple):
    """Patches at rest, in eights: vertices (m, k) of each, the first one repeated where there are fewer; plane
    (k, 2, m): where they lie along t_1 and t_2 [m]; weights (3, m): of their sum in the mean, and of their moments in
    f_1 and f_2; centre, t1, t2, normal (m, 4): X_P [m] and axes; size (m, 4): rho, and how far vertices lie out of the
    plane [m]."""

    vertices: Indices
    plane: Array
    weights: Array
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
    fit = [1.0 / np.where(spread[:, k] > _THIN * spread[:, 2], spread[:, k], np.inf) for k in (2, 1)]
    weights = np.stack([1.0 / np.maximum(1, own.sum(axis=1)), *fit])
    size = np.zeros((eights, 3))
    size[:, 0] = np.linalg.norm(off, axis=2).max(axis=1)
    size[:, 1] = np.abs(np.einsum("mkx,mx->mk", off, normal)).max(axis=1)
    by_slot = np.ascontiguousarray(plane.transpose(2, 1, 0))
    return Rest(vertices, by_slot, weights, *(padded(a) for a in (centre, t1, t2, normal, size)))


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
            at = 2 * many * k + first
            centre = centre[0] + p[0], centre[1] + p[1], centre[2] + p[2]
            f1, f2 = added(f1, loaded(known.plane, at), p), added(f2, loaded(known.plane, at + many), p)
            low, high = smaller(low, p), larger(high, p)
        # A vertex that is there again is where p is zero.
        centre = _times(loaded(known.weights, first), centre)
        f1, f2 = _times(loaded(known.weights, many + first), f1), _times(loaded(known.weights, 2 * many + first), f2)
        e1 = unit(f1)
        e2 = unit(added(f2, 0.0 - dot(f2, e1), e1))
        n = cross(e1, e2)
        along, across = zero, zero
        for k in range(width):
            p = loaded(tile, 24 * k), loaded(tile, 24 * k + 8), loaded(tile, 24 * k + 16)
            at = 2 * many * k + first
            y = added(minus(p, centre), 0.0 - loaded(known.plane, at), f1)
            y = added(y, 0.0 - loaded(known.plane, at + many), f2)
            a, b, c = dot(e1, y), dot(e2, y), dot(n, y)
            along, across = _most(along, a * a + b * b), _most(across, c * c)
        put((centre[0] + o[0], centre[1] + o[1], centre[2] + o[2]), tile, first, out.centre)
        put(f1, tile, first, out.f1)
        put(f2, tile, first, out.f2)
        put(n, tile, first, out.normal)
        put((root(along), root(across), zero), tile, first, out.rest)
        low, high = (low[0] + o[0], low[1] + o[1], low[2] + o[2]), (high[0] + o[0], high[1] + o[1], high[2] + o[2])
        put_boxes(low, high, boxes, leaf + first // 8)


@kernel
def spread(vertices, pairs, known, p, q, way, tile, low, high):
    """The largest diagonal of the boxes around q - p of the vertices of two patches, of the first pairs of them; way
    (n, 4), low, high (m, 4), tile (3, 8) or more: scratch."""
    for i in range(len(p)):
        way[i, 0], way[i, 1], way[i, 2] = q[i, 0] - p[i, 0], q[i, 1] - p[i, 1], q[i, 2] - p[i, 2]
    for first in range(0, len(vertices), 8):
        x = rows(way, vertices, first, first + 7, 0)
        least, most = x, x
        for k in range(1, vertices.shape[1]):
            x = rows(way, vertices, first, first + 7, k)
            least, most = smaller(x, least), larger(x, most)
        put(least, tile, first, low)
        put(most, tile, first, high)
    square = 0.0
    for first in range(0, known, 8):
        a, b = rows(low, pairs, first, known - 1, 0), rows(low, pairs, first, known - 1, 1)
        c, d = rows(high, pairs, first, known - 1, 0), rows(high, pairs, first, known - 1, 1)
        wide = minus(larger(c, d), smaller(a, b))
        stored(dot(wide, wide), tile, 0)
        for lane in range(8):
            square = max(square, tile[0, lane])
    return np.sqrt(square)


@inner
def put(v, tile, first, out):
    """Write a vector of eight patches to their rows."""
    for axis in range(3):
        stored(v[axis], tile, 8 * axis)
    for lane in range(8):
        for axis in range(3):
            out[first + lane, axis] = tile[axis, lane]


@inner
def unit(v):
    """A vector of eight, of length 1."""
    size = root(dot(v, v))
    return ratio(v[0], size), ratio(v[1], size), ratio(v[2], size)


@inner
def _times(t, v):
    return t * v[0], t * v[1], t * v[2]


@inner
def added(v, t, w):
    """v + t w."""
    return v[0] + t * w[0], v[1] + t * w[1], v[2] + t * w[2]


@inner
def _most(a, b):
    return where(a > b, a, b)
