"""Distance bounds of clusters that are affine images of their rest shape.

The bounds are those of projections onto a plane. Let a and b be points of primitives of two clusters P and Q, and A and
B the same points at rest. x_P, F_P and y_i are those of `springbench.solvers.contact.broad_phase.cluster_fit`. Let
e_1, e_2 span P's plane, projected on which bending is a second-order effect, and E = (e_1, e_2)'. Then

    |a - b| >= |E (a - b)| >= l |A - B| - z,     l = least eigenvalue of the symmetric part of E F_P (t_1, t_2)
    z = |E (x_Q - x_P - F_P (X_Q - X_P))| + |E (F_Q - F_P)| rho_Q + |E y_i| + |E y_j|

z is an upper bound, and |A - B| is reduced by its part out of the plane. On a linear motion E is constant, l concave
and z convex. A bound that is satisfied at both ends is therefore satisfied between them.

The initial distance is at most |F_P| |A - B| + z', with z' the value of z without E. A fraction s of it remains if
l |A - B| - z >= s (|F_P| |A - B| + z'). For l > s |F_P| a test at the smallest |A - B| covers all larger ones.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.contact.broad_phase.cluster_fit import add_scaled, normalise_vectors, store_vectors
from springbench.solvers.contact.geometry.distance import dot3, subtract3
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_kernel
from springbench.solvers.simd.float64x8 import gather_rows, load_packet, mask_to_bits, sqrt_packet, store_packet

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]


class ClusterPairs(NamedTuple):
    """Pairs of clusters.

    Attributes:
        clusters: (k, 2).
        rest_distance: lower bound of the distance at rest [m], (k,).
        relative_pose: centre [m] and axes of the second cluster along the plane of the first; its rho [m]; distance of
            both from that plane [m]; (8, k).
    """

    clusters: IndexArray
    rest_distance: FloatArray
    relative_pose: FloatArray

    @classmethod
    def allocate_pairs(cls, capacity: int) -> ClusterPairs:
        """Allocate pairs for a capacity, rounded up to a multiple of eight."""
        eights = 8 * (-(-capacity // 8))
        return cls(np.empty((eights, 2), np.int64), np.empty(eights), np.empty((8, eights)))


class ProjectionBasis(NamedTuple):
    """Projections of clusters during a motion.

    Attributes:
        e1, e2: axes of the projection (m, 4).
        start_bounds, end_bounds: l, the largest stretch, and |E y_i| [m], (m, 4).
        indices: cluster indices (m, 1).
    """

    e1: FloatArray
    e2: FloatArray
    start_bounds: FloatArray
    end_bounds: FloatArray
    indices: IndexArray

    @classmethod
    def allocate_basis(cls, capacity: int) -> ProjectionBasis:
        """Allocate the projections of a number of clusters."""
        e1, e2, begin, end = np.empty((4, capacity, 4))
        return cls(e1, e2, begin, end, np.arange(capacity)[:, None])


@jit_kernel
def compute_rest_relations(rest_clusters, first, count, out):
    """Compute the relative poses of cluster pairs at rest.

    Args:
        rest_clusters: clusters at rest.
        first: first pair to compute.
        count: end of the pairs to compute.
        out: cluster pairs, updated.
    """
    for at in range(first // 8 * 8, count, 8):
        end, x, k = count - 1, out.clusters, len(out.rest_distance)
        t1, t2, n = (
            gather_rows(rest_clusters.t1, x, at, end, 0),
            gather_rows(rest_clusters.t2, x, at, end, 0),
            gather_rows(rest_clusters.normal, x, at, end, 0),
        )
        u1, u2 = gather_rows(rest_clusters.t1, x, at, end, 1), gather_rows(rest_clusters.t2, x, at, end, 1)
        axis = subtract3(
            gather_rows(rest_clusters.centre, x, at, end, 1), gather_rows(rest_clusters.centre, x, at, end, 0)
        )
        mine, other = (
            gather_rows(rest_clusters.extents, x, at, end, 0),
            gather_rows(rest_clusters.extents, x, at, end, 1),
        )
        for slot, v in enumerate((axis, u1, u2)):
            store_packet(dot3(t1, v), out.relative_pose, 2 * slot * k + at)
            store_packet(dot3(t2, v), out.relative_pose, (2 * slot + 1) * k + at)
        store_packet(other[0], out.relative_pose, 6 * k + at)
        off = (
            sqrt_packet(dot3(n, axis) * dot3(n, axis))
            + _norm2(dot3(n, u1), dot3(n, u2)) * other[0]
            + mine[1]
            + other[1]
        )
        store_packet(off, out.relative_pose, 7 * k + at)


@jit_kernel
def unresolved_cluster_pairs(begin, end, pairs, count, query, min_end_distance, basis, tile, out):
    """Write the cluster pairs that are not proved to be separated during a linear motion.

    Args:
        begin, end: poses at the start and at the end.
        pairs: cluster pairs.
        count: number of pairs to test.
        query: limits of the distances.
        min_end_distance: required distance at the end [m].
        basis, tile: scratch.
        out: clusters of the unresolved pairs (k, 2).

    Returns:
        Number of unresolved pairs, and a lower bound of the end distances of all others [m].
    """
    for first in range(0, len(basis.e1), 8):
        _project_packet(begin, end, first, tile, basis)
    found, least = 0, np.inf
    for first in range(0, count, 8):
        clear, apart = _separated_mask(begin, end, pairs, basis, first, count - 1, query, min_end_distance)
        store_packet(apart, tile, 0)
        for lane in range(min(8, count - first)):
            if clear >> lane & 1:
                least = min(least, tile[0, lane])
            else:
                out[found, 0], out[found, 1] = pairs.clusters[first + lane, 0], pairs.clusters[first + lane, 1]
                found += 1
    return found, least


@jit_inner
def _project_packet(begin, end, first, tile, basis):
    """Write the projections of eight clusters."""
    last, x = first + 7, basis.indices
    a1, a2 = gather_rows(begin.f1, x, first, last, 0), gather_rows(begin.f2, x, first, last, 0)
    b1, b2 = gather_rows(end.f1, x, first, last, 0), gather_rows(end.f2, x, first, last, 0)
    e1 = normalise_vectors((a1[0] + b1[0], a1[1] + b1[1], a1[2] + b1[2]))
    e2 = a2[0] + b2[0], a2[1] + b2[1], a2[2] + b2[2]
    e2 = normalise_vectors(add_scaled(e2, 0.0 - dot3(e2, e1), e1))
    store_vectors(e1, tile, first, basis.e1)
    store_vectors(e2, tile, first, basis.e2)
    store_vectors(_stretch_bounds(begin, x, first, e1, e2, a1, a2), tile, first, basis.start_bounds)
    store_vectors(_stretch_bounds(end, x, first, e1, e2, b1, b2), tile, first, basis.end_bounds)


@jit_inner
def _stretch_bounds(poses, x, first, e1, e2, f1, f2):
    """Return l, the largest stretch, and |E y_i| of eight clusters."""
    a, d, b = dot3(e1, f1), dot3(e2, f2), 0.5 * (dot3(e1, f2) + dot3(e2, f1))
    least = 0.5 * (a + d) - sqrt_packet(0.25 * (a - d) * (a - d) + b * b)
    a, d, b = dot3(f1, f1), dot3(f2, f2), dot3(f1, f2)
    most = sqrt_packet(0.5 * (a + d) + sqrt_packet(0.25 * (a - d) * (a - d) + b * b))
    left = gather_rows(poses.fit_residual, x, first, first + 7, 0)
    return least, most, left[0] + left[1] * _projected_length(e1, e2, gather_rows(poses.normal, x, first, first + 7, 0))


@jit_inner
def _separated_mask(begin, end, pairs, basis, first, last, query, min_end_distance):
    """Return as bits which of eight pairs are separated, and their distances at the end."""
    e1, e2 = (
        gather_rows(basis.e1, pairs.clusters, first, last, 0),
        gather_rows(basis.e2, pairs.clusters, first, last, 0),
    )
    here, there = (
        gather_rows(basis.start_bounds, pairs.clusters, first, last, 0),
        gather_rows(basis.end_bounds, pairs.clusters, first, last, 0),
    )
    out = load_packet(pairs.relative_pose, 7 * len(pairs.rest_distance) + first)
    apart = load_packet(pairs.rest_distance, first) - out
    z, far = _deviation_bounds(begin, pairs, first, last, e1, e2)
    w, _ = _deviation_bounds(end, pairs, first, last, e1, e2)
    own = gather_rows(begin.fit_residual, pairs.clusters, first, last, 0)
    share, most = query.relative_min_distance, here[1]
    z, w, far = z + here[2] + most * out, w + there[2] + there[1] * out, far + own[0] + own[1] + most * out
    far = query.min_distance + share * far
    l, m = here[0] - share * most, there[0] - share * most
    after = there[0] * apart - w
    return mask_to_bits((apart > 0.0) & (l > 0.0) & (m > 0.0) & (here[0] * apart - z >= query.inflation_radius)
                & (after >= min_end_distance) & (l * apart - z >= far) & (m * apart - w >= far)), after  # fmt: skip


@jit_inner
def _deviation_bounds(poses, pairs, first, last, e1, e2):
    """Return z of eight pairs with and without E.

    Both exclude the residual of the first clusters.
    """
    room, x = len(pairs.rest_distance), pairs.clusters
    f1, f2 = gather_rows(poses.f1, x, first, last, 0), gather_rows(poses.f2, x, first, last, 0)
    c = subtract3(gather_rows(poses.centre, x, first, last, 1), gather_rows(poses.centre, x, first, last, 0))
    c = _subtract_combination(
        c, load_packet(pairs.relative_pose, first), f1, load_packet(pairs.relative_pose, room + first), f2
    )
    g1 = _subtract_combination(
        gather_rows(poses.f1, x, first, last, 1),
        load_packet(pairs.relative_pose, 2 * room + first),
        f1,
        load_packet(pairs.relative_pose, 3 * room + first),
        f2,
    )
    g2 = _subtract_combination(
        gather_rows(poses.f2, x, first, last, 1),
        load_packet(pairs.relative_pose, 4 * room + first),
        f1,
        load_packet(pairs.relative_pose, 5 * room + first),
        f2,
    )
    wide, left = load_packet(pairs.relative_pose, 6 * room + first), gather_rows(poses.fit_residual, x, first, last, 1)
    a, b, c1, d = dot3(e1, g1), dot3(e2, g1), dot3(e1, g2), dot3(e2, g2)
    z = _projected_length(e1, e2, c) + sqrt_packet(a * a + b * b + c1 * c1 + d * d) * wide
    z = z + left[0] + left[1] * _projected_length(e1, e2, gather_rows(poses.normal, x, first, last, 1))
    return z, sqrt_packet(dot3(c, c)) + sqrt_packet(dot3(g1, g1) + dot3(g2, g2)) * wide + left[0] + left[1]


@jit_inner
def _subtract_combination(v, s, f1, t, f2):
    """Return v - s f_1 - t f_2."""
    return v[0] - s * f1[0] - t * f2[0], v[1] - s * f1[1] - t * f2[1], v[2] - s * f1[2] - t * f2[2]


@jit_inner
def _projected_length(e1, e2, v):
    return _norm2(dot3(e1, v), dot3(e2, v))


@jit_inner
def _norm2(a, b):
    return sqrt_packet(a * a + b * b)
