"""Clusters of a surface as affine images of their rest shape.

    x_i = x_P + F_P (X_i - X_P) + y_i,     F_P = f_1 t_1' + f_2 t_2'

X: rest shape; t_1, t_2: axes of the plane of a cluster P at rest; F_P: least squares fit; y_i: its residual.
All of these are sums over vertices, which are invariant to rotations of a cluster.
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
"""Minimum squared width relative to the squared length of a cluster, below which it has no plane."""


class Rest(NamedTuple):
    """Clusters at rest, padded to multiples of eight.

    Attributes:
        vertices: vertices of each cluster (m, k); the first one repeats where there are fewer.
        plane: along t_1 and t_2 [m], (k, 2, m).
        weights: of the vertex sum in the mean, and of the moments in f_1 and f_2, (3, m).
        centre, t1, t2, normal: X_P [m] and axes (m, 4).
        size: radius rho, and largest distance of a vertex from the plane [m], (m, 4).
    """

    vertices: Indices
    plane: Array
    weights: Array
    centre: Array
    t1: Array
    t2: Array
    normal: Array
    size: Array


class Lie(NamedTuple):
    """Poses of clusters at a position.

    Attributes:
        centre: x_P [m], (m, 4).
        f1, f2, normal: columns of the deformation, and their normal (m, 4).
        rest: largest y_i in the plane, and normal to it [m], (m, 4).
    """

    centre: Array
    f1: Array
    f2: Array
    normal: Array
    rest: Array


def rest(x: Array, members: Indices, many: int) -> Rest:
    """Fit the planes of clusters at rest.

    Args:
        x: rest shape (n, 3) [m].
        members: pairs of a cluster and a vertex (k, 2).
        many: number of clusters.
    """
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
    """Fit the poses of clusters, and write their boxes to the leaves of a tree.

    Args:
        known: clusters at rest.
        x: positions (n, 4) [m]; column 3 is padding.
        leaf: first leaf node.
        boxes: boxes of the tree (nodes, 6, 8), updated.
        tile: scratch (3 k, 8).
        out: poses, overwritten.
    """
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
        # Repeated vertices contribute nothing: their p is zero.
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
    """Return the largest relative displacement [m] of two vertices in any cluster pair.

    The bound is the diagonal of the box of their displacements.

    Args:
        vertices: vertices of each cluster (m, k).
        pairs: cluster pairs (k, 2).
        known: number of pairs to include.
        p: start positions (n, 3) [m].
        q: end positions (n, 3) [m].
        way, low, high: scratch, (n, 4), (m, 4) and (m, 4).
        tile: scratch of at least (3, 8).
    """
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
    """Store a vector packet in the rows of eight clusters."""
    for axis in range(3):
        stored(v[axis], tile, 8 * axis)
    for lane in range(8):
        for axis in range(3):
            out[first + lane, axis] = tile[axis, lane]


@inner
def unit(v):
    """Return a packet of vectors scaled to unit length."""
    size = root(dot(v, v))
    return ratio(v[0], size), ratio(v[1], size), ratio(v[2], size)


@inner
def _times(t, v):
    return t * v[0], t * v[1], t * v[2]


@inner
def added(v, t, w):
    """Return v + t w."""
    return v[0] + t * w[0], v[1] + t * w[1], v[2] + t * w[2]


@inner
def _most(a, b):
    return where(a > b, a, b)
