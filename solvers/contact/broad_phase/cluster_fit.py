"""Clusters of a surface as affine images of their rest shape.

    x_i = x_P + F_P (X_i - X_P) + y_i,     F_P = f_1 t_1' + f_2 t_2'

X: rest shape; t_1, t_2: axes of the plane of a cluster P at rest; F_P: least squares fit; y_i: its residual.
x_P and F_P are linear in the positions, so that a rotation of the cluster leaves the lengths of all y_i unchanged.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.contact.collisions import pad_positions
from springbench.solvers.contact.geometry.aabb import componentwise_max, componentwise_min, store_aabbs
from springbench.solvers.contact.geometry.distance import cross3, dot3, subtract3
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_kernel
from springbench.solvers.simd.float64x8 import divide_packet, gather_rows, load_packet, sqrt_packet, store_packet, where

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]

_MIN_WIDTH_RATIO = 1e-12
"""Minimum squared width relative to the squared length of a cluster, below which it has no plane."""


class RestClusters(NamedTuple):
    """Clusters at rest, padded to multiples of eight.

    Attributes:
        vertices: vertices of each cluster (m, k); the first one repeats where there are fewer.
        plane_coordinates: along t_1 and t_2 [m], (k, 2, m).
        weights: of the vertex sum in the mean, and of the moments in f_1 and f_2, (3, m).
        centre, t1, t2, normal: X_P [m] and axes (m, 4).
        extents: radius rho, and largest distance of a vertex from the plane [m], (m, 4).
    """

    vertices: IndexArray
    plane_coordinates: FloatArray
    weights: FloatArray
    centre: FloatArray
    t1: FloatArray
    t2: FloatArray
    normal: FloatArray
    extents: FloatArray


class ClusterPose(NamedTuple):
    """Poses of clusters at a position.

    Attributes:
        centre: x_P [m], (m, 4).
        f1, f2, normal: columns of the deformation, and their normal (m, 4).
        fit_residual: largest y_i in the plane, and normal to it [m], (m, 4).
    """

    centre: FloatArray
    f1: FloatArray
    f2: FloatArray
    normal: FloatArray
    fit_residual: FloatArray


def build_rest_clusters(x: FloatArray, members: IndexArray, num_clusters: int) -> RestClusters:
    """Fit the planes of clusters at rest.

    Args:
        x: rest shape (n, 3) [m].
        members: pairs of a cluster and a vertex (k, 2).
        num_clusters: number of clusters.
    """
    patch, vertex = np.unique(members, axis=0).T
    count = np.bincount(patch, minlength=num_clusters)
    slot = np.arange(len(patch)) - np.repeat(np.cumsum(count) - count, count)
    wide, eights = int(count.max()), 8 * (-(-num_clusters // 8))
    vertices, own = np.zeros((eights, wide), np.int64), np.zeros((eights, wide), bool)
    vertices[:num_clusters] = vertex[np.cumsum(count) - count][:, None]
    vertices[patch, slot], own[patch, slot] = vertex, True
    share = own / np.maximum(1, own.sum(axis=1, keepdims=True))
    centre = np.einsum("mk,mkx->mx", share, x[vertices])
    off = np.where(own[:, :, None], x[vertices] - centre[:, None], 0.0)
    axes, spread = np.linalg.eigh(np.einsum("mkx,mky->mxy", off, off))[::-1]
    t1, t2, normal = (np.ascontiguousarray(axes[:, :, k]) for k in (2, 1, 0))
    along = x[vertices] - centre[:, None]
    plane = np.stack([np.einsum("mkx,mx->mk", along, t) for t in (t1, t2)], axis=1)
    fit = [1.0 / np.where(spread[:, k] > _MIN_WIDTH_RATIO * spread[:, 2], spread[:, k], np.inf) for k in (2, 1)]
    weights = np.stack([1.0 / np.maximum(1, own.sum(axis=1)), *fit])
    size = np.zeros((eights, 3))
    size[:, 0] = np.linalg.norm(off, axis=2).max(axis=1)
    size[:, 1] = np.abs(np.einsum("mkx,mx->mk", off, normal)).max(axis=1)
    by_slot = np.ascontiguousarray(plane.transpose(2, 1, 0))
    return RestClusters(vertices, by_slot, weights, *(pad_positions(a) for a in (centre, t1, t2, normal, size)))


@jit_kernel
def fit_affine(rest_clusters, x, leaf, boxes, tile, out):
    """Fit the poses of clusters, and write their boxes to the leaves of a tree.

    Args:
        rest_clusters: clusters at rest.
        x: positions (n, 4) [m]; column 3 is padding.
        leaf: first leaf node.
        boxes: boxes of the tree (nodes, 6, 8), updated.
        tile: scratch (3 k, 8).
        out: poses, overwritten.
    """
    many, width, last = len(rest_clusters.centre), rest_clusters.vertices.shape[1], len(rest_clusters.vertices) - 1
    for first in range(0, many, 8):
        o = gather_rows(x, rest_clusters.vertices, first, last, 0)
        zero = 0.0 * o[0]
        centre, f1, f2 = (zero, zero, zero), (zero, zero, zero), (zero, zero, zero)
        low, high = (zero, zero, zero), (zero, zero, zero)
        for k in range(width):
            p = subtract3(gather_rows(x, rest_clusters.vertices, first, last, k), o)
            for axis in range(3):
                store_packet(p[axis], tile, 24 * k + 8 * axis)
            at = 2 * many * k + first
            centre = centre[0] + p[0], centre[1] + p[1], centre[2] + p[2]
            f1, f2 = (
                add_scaled(f1, load_packet(rest_clusters.plane_coordinates, at), p),
                add_scaled(f2, load_packet(rest_clusters.plane_coordinates, at + many), p),
            )
            low, high = componentwise_min(low, p), componentwise_max(high, p)
        # Repeated vertices contribute nothing: their p is zero.
        centre = _scale_vector(load_packet(rest_clusters.weights, first), centre)
        f1, f2 = (
            _scale_vector(load_packet(rest_clusters.weights, many + first), f1),
            _scale_vector(load_packet(rest_clusters.weights, 2 * many + first), f2),
        )
        e1 = normalise_vectors(f1)
        e2 = normalise_vectors(add_scaled(f2, 0.0 - dot3(f2, e1), e1))
        n = cross3(e1, e2)
        along, across = zero, zero
        for k in range(width):
            p = load_packet(tile, 24 * k), load_packet(tile, 24 * k + 8), load_packet(tile, 24 * k + 16)
            at = 2 * many * k + first
            y = add_scaled(subtract3(p, centre), 0.0 - load_packet(rest_clusters.plane_coordinates, at), f1)
            y = add_scaled(y, 0.0 - load_packet(rest_clusters.plane_coordinates, at + many), f2)
            a, b, c = dot3(e1, y), dot3(e2, y), dot3(n, y)
            along, across = _packet_max(along, a * a + b * b), _packet_max(across, c * c)
        store_vectors((centre[0] + o[0], centre[1] + o[1], centre[2] + o[2]), tile, first, out.centre)
        store_vectors(f1, tile, first, out.f1)
        store_vectors(f2, tile, first, out.f2)
        store_vectors(n, tile, first, out.normal)
        store_vectors((sqrt_packet(along), sqrt_packet(across), zero), tile, first, out.fit_residual)
        low, high = (low[0] + o[0], low[1] + o[1], low[2] + o[2]), (high[0] + o[0], high[1] + o[1], high[2] + o[2])
        store_aabbs(low, high, boxes, leaf + first // 8)


@jit_kernel
def max_cluster_displacement(vertices, pairs, num_pairs, p, q, displacement, tile, low, high):
    """Return the largest relative displacement [m] of two vertices in any cluster pair.

    The bound is the diagonal of the box of their displacements.

    Args:
        vertices: vertices of each cluster (m, k).
        pairs: cluster pairs (k, 2).
        num_pairs: number of pairs to include.
        p: start positions (n, 3) [m].
        q: end positions (n, 3) [m].
        displacement, low, high: scratch, (n, 4), (m, 4) and (m, 4).
        tile: scratch of at least (3, 8).
    """
    for i in range(len(p)):
        displacement[i, 0], displacement[i, 1], displacement[i, 2] = (
            q[i, 0] - p[i, 0],
            q[i, 1] - p[i, 1],
            q[i, 2] - p[i, 2],
        )
    for first in range(0, len(vertices), 8):
        x = gather_rows(displacement, vertices, first, first + 7, 0)
        least, most = x, x
        for k in range(1, vertices.shape[1]):
            x = gather_rows(displacement, vertices, first, first + 7, k)
            least, most = componentwise_min(x, least), componentwise_max(x, most)
        store_vectors(least, tile, first, low)
        store_vectors(most, tile, first, high)
    square = 0.0
    for first in range(0, num_pairs, 8):
        a, b = (
            gather_rows(low, pairs, first, num_pairs - 1, 0),
            gather_rows(low, pairs, first, num_pairs - 1, 1),
        )
        c, d = (
            gather_rows(high, pairs, first, num_pairs - 1, 0),
            gather_rows(high, pairs, first, num_pairs - 1, 1),
        )
        wide = subtract3(componentwise_max(c, d), componentwise_min(a, b))
        store_packet(dot3(wide, wide), tile, 0)
        for lane in range(8):
            square = max(square, tile[0, lane])
    return np.sqrt(square)


@jit_inner
def store_vectors(v, tile, first, out):
    """Store a packet of vectors in the rows of eight clusters.

    Args:
        v: three packets, one for each coordinate.
        tile: scratch of at least (3, 8).
        first: first of the eight rows.
        out: vectors (m, 4), of which the first three columns are updated.
    """
    for axis in range(3):
        store_packet(v[axis], tile, 8 * axis)
    for lane in range(8):
        for axis in range(3):
            out[first + lane, axis] = tile[axis, lane]


@jit_inner
def normalise_vectors(v):
    """Return a packet of vectors scaled to unit length."""
    size = sqrt_packet(dot3(v, v))
    return divide_packet(v[0], size), divide_packet(v[1], size), divide_packet(v[2], size)


@jit_inner
def _scale_vector(t, v):
    return t * v[0], t * v[1], t * v[2]


@jit_inner
def add_scaled(v, t, w):
    """Return v + t w.

    Args:
        v: packet of vectors.
        t: packet of factors.
        w: packet of vectors.
    """
    return v[0] + t * w[0], v[1] + t * w[1], v[2] + t * w[2]


@jit_inner
def _packet_max(a, b):
    return where(a > b, a, b)
