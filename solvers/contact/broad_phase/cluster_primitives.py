"""Primitives owned by clusters of a surface, and candidate pairs among those of two clusters."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from springbench.solvers.contact.geometry.aabb import (
    IndexArray,
    extract_aabb,
    has_common_vertex,
    merge_aabbs,
    overlap_mask,
    primitive_aabbs,
    store_aabbs,
)
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_kernel
from springbench.solvers.model.system_matrix_assembly import compute_row_starts
from springbench.solvers.simd.float64x8 import lowest_set_bit


class ClusterPrimitives(NamedTuple):
    """Primitives grouped by cluster.

    primitives (m, k): vertices of each; cluster_starts (clusters + 1,): first primitive of each cluster.
    """

    primitives: IndexArray
    cluster_starts: IndexArray

    @classmethod
    def from_primitives(cls, corners: IndexArray, vertex_cluster: IndexArray, num_clusters: int) -> ClusterPrimitives:
        """Assign each primitive to the lowest cluster among its vertices.

        Args:
            corners: vertices of each primitive (m, k).
            vertex_cluster: cluster of each vertex (n,).
            num_clusters: number of clusters.
        """
        owner = vertex_cluster[corners].min(axis=1)
        starts = compute_row_starts(owner, num_clusters)
        return cls(np.ascontiguousarray(corners[np.argsort(owner, kind="stable")]), starts)

    def cluster_vertices(self) -> IndexArray:
        """Return pairs (k, 2) of a cluster and a vertex of one of its primitives."""
        patch = np.repeat(np.arange(len(self.cluster_starts) - 1), np.diff(self.cluster_starts))
        return np.column_stack([np.repeat(patch, self.primitives.shape[1]), self.primitives.ravel()])


@jit_kernel
def cluster_candidates(cluster_primitives, patches, x, y, query, start_aabbs, end_aabbs, out):
    """Write the primitive pairs whose boxes may violate the limits on a linear motion.

    Args:
        cluster_primitives: points, edges and triangles of the clusters.
        patches: cluster pairs (k, 2).
        x: start positions (n, 4) [m]; column 3 is padding.
        y: end positions (n, 4) [m]; column 3 is padding.
        query: limits of the distances.
        start_aabbs, end_aabbs: scratch boxes (nodes, 6, 8).
        out: vertices (capacity, 4) of point-triangle pairs, then of edge pairs; overwritten.

    Returns:
        Number of point-triangle pairs, and of all pairs; more than the capacity if that does not suffice.
    """
    points, edges, triangles = cluster_primitives
    count = 0
    for k in range(len(patches)):
        if count > len(out):
            break
        a, b = patches[k, 0], patches[k, 1]
        count = _add_cluster_pair(points, a, triangles, b, x, y, query, start_aabbs, end_aabbs, out, count)
        if a != b:
            count = _add_cluster_pair(points, b, triangles, a, x, y, query, start_aabbs, end_aabbs, out, count)
    first = count
    for k in range(len(patches)):
        if count > len(out):
            break
        count = _add_cluster_pair(
            edges, patches[k, 0], edges, patches[k, 1], x, y, query, start_aabbs, end_aabbs, out, count
        )
    return first, count


@jit_inner
def _add_cluster_pair(one, a, other, b, x, y, query, start_aabbs, end_aabbs, out, count):
    """Add pairs of primitives of clusters a and b; return the new count."""
    begin, end, last = other.cluster_starts[b], other.cluster_starts[b + 1], one.cluster_starts[a + 1]
    for first in range(begin, end, 8):
        _store_primitive_aabbs(other.primitives, first, end, x, start_aabbs, (first - begin) // 8)
        _store_primitive_aabbs(other.primitives, first, end, y, end_aabbs, (first - begin) // 8)
    low, high = _store_parent_aabbs(start_aabbs, (end - begin + 7) // 8)
    lower, upper = _store_parent_aabbs(end_aabbs, (end - begin + 7) // 8)
    for first in range(one.cluster_starts[a], last, 8):
        _store_primitive_aabbs(one.primitives, first, last, x, start_aabbs, len(start_aabbs) - 1)
        _store_primitive_aabbs(one.primitives, first, last, y, end_aabbs, len(start_aabbs) - 1)
        mine = overlap_mask(start_aabbs, end_aabbs, len(start_aabbs) - 1, low, high, lower, upper, query) & (
            (1 << min(8, last - first)) - 1
        )
        while mine != 0:  # primitives near the box of the other cluster
            slot = lowest_set_bit(mine)
            mine &= mine - 1
            count = _add_primitive_candidates(
                one, first + slot, slot, other, begin, end, a == b, query, start_aabbs, end_aabbs, out, count
            )
    return count


@jit_inner
def _add_primitive_candidates(one, e, slot, other, begin, end, same, query, start_aabbs, end_aabbs, out, count):
    """Add pairs of primitive e with a range of others.

    Within one cluster each edge pair is added once.
    """
    eights, wide, own = (end - begin + 7) // 8, one.primitives.shape[1], len(start_aabbs) - 1
    low, high = extract_aabb(start_aabbs[own], slot)
    lower, upper = extract_aabb(end_aabbs[own], slot)
    later = same and wide == 2
    for above in range(0, eights, 8):
        near = overlap_mask(start_aabbs, end_aabbs, eights + above // 8, low, high, lower, upper, query)
        while near != 0:
            node = above + lowest_set_bit(near)
            near &= near - 1
            first = begin + 8 * node
            new = node < eights and (not later or first + 7 > e)
            left = overlap_mask(start_aabbs, end_aabbs, node, low, high, lower, upper, query) if new else 0
            while left != 0:
                f = first + lowest_set_bit(left)
                left &= left - 1
                new = f < end and (not later or f > e)
                if new and not has_common_vertex(one.primitives, e, other.primitives, f):
                    if count < len(out):
                        for c in range(wide):
                            out[count, c] = one.primitives[e, c]
                        for c in range(4 - wide):
                            out[count, wide + c] = other.primitives[f, c]
                    count += 1
    return count


@jit_inner
def _store_primitive_aabbs(corners, first, end, x, boxes, node):
    """Store the boxes of eight primitives at x; lanes beyond the end repeat the last."""
    store_aabbs(*primitive_aabbs(corners, first, end - 1, x), boxes, node)


@jit_inner
def _store_parent_aabbs(boxes, eights):
    """Store the boxes of the first nodes behind them, eight per node; return their union."""
    l0, l1, l2, h0, h1, h2 = np.inf, np.inf, np.inf, -np.inf, -np.inf, -np.inf
    for node in range(eights):
        low, high = merge_aabbs(boxes[node], 8)
        above, slot = boxes[eights + node // 8], node % 8
        for axis in range(3):
            above[axis, slot], above[3 + axis, slot] = low[axis], high[axis]
        l0, l1, l2 = min(l0, low[0]), min(l1, low[1]), min(l2, low[2])
        h0, h1, h2 = max(h0, high[0]), max(h1, high[1]), max(h2, high[2])
    return (l0, l1, l2), (h0, h1, h2)
