"""Primitives owned by clusters of a surface, and candidate pairs among those of two clusters."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from solvers.compiling import inner, kernel
from solvers.contact.boxes import Indices, hull, hulls, met, one_of, put_boxes, share_vertex
from solvers.vectors.eights import lowest


class Owned(NamedTuple):
    """Primitives grouped by cluster.

    primitives (m, k): vertices of each; starts (clusters + 1,): first primitive of each cluster.
    """

    corners: Indices
    starts: Indices

    @classmethod
    def of(cls, corners: Indices, rank: Indices, many: int) -> Owned:
        """Assign each primitive to the lowest cluster among its vertices.

        Args:
            corners: vertices of each primitive (m, k).
            rank: cluster of each vertex (n,).
            many: number of clusters.
        """
        owner = rank[corners].min(axis=1)
        starts = np.append(0, np.cumsum(np.bincount(owner, minlength=many)))
        return cls(np.ascontiguousarray(corners[np.argsort(owner, kind="stable")]), starts)

    def members(self) -> Indices:
        """Return pairs (k, 2) of a cluster and a vertex of one of its primitives."""
        patch = np.repeat(np.arange(len(self.starts) - 1), np.diff(self.starts))
        return np.column_stack([np.repeat(patch, self.corners.shape[1]), self.corners.ravel()])


@kernel
def among(owned, patches, x, y, limits, here, there, out):
    """Write the primitive pairs of cluster pairs whose boxes may violate the limits on a linear motion.

    Args:
        owned: points, edges and triangles of the clusters.
        patches: cluster pairs (k, 2).
        x: start positions (n, 4) [m]; column 3 is padding.
        y: end positions (n, 4) [m]; column 3 is padding.
        limits: limits of the distances.
        here, there: scratch boxes (nodes, 6, 8).
        out: vertices (capacity, 4) of point-triangle pairs, then of edge pairs; overwritten.

    Returns:
        Number of point-triangle pairs, and of all pairs; more than the capacity if that does not suffice.
    """
    points, edges, triangles = owned
    count = 0
    for k in range(len(patches)):
        if count > len(out):
            break
        a, b = patches[k, 0], patches[k, 1]
        count = _against(points, a, triangles, b, x, y, limits, here, there, out, count)
        if a != b:
            count = _against(points, b, triangles, a, x, y, limits, here, there, out, count)
    first = count
    for k in range(len(patches)):
        if count > len(out):
            break
        count = _against(edges, patches[k, 0], edges, patches[k, 1], x, y, limits, here, there, out, count)
    return first, count


@inner
def _against(one, a, other, b, x, y, limits, here, there, out, count):
    """Add pairs of primitives of clusters a and b, in 8-lane packets; return the new count."""
    begin, end, last = other.starts[b], other.starts[b + 1], one.starts[a + 1]
    for first in range(begin, end, 8):
        _around(other.corners, first, end, x, here, (first - begin) // 8)
        _around(other.corners, first, end, y, there, (first - begin) // 8)
    low, high = _above(here, (end - begin + 7) // 8)
    lower, upper = _above(there, (end - begin + 7) // 8)
    for first in range(one.starts[a], last, 8):
        _around(one.corners, first, last, x, here, len(here) - 1)
        _around(one.corners, first, last, y, there, len(here) - 1)
        mine = met(here, there, len(here) - 1, low, high, lower, upper, limits) & ((1 << min(8, last - first)) - 1)
        while mine != 0:  # what comes near anything there
            slot = lowest(mine)
            mine &= mine - 1
            count = _of_one(one, first + slot, slot, other, begin, end, a == b, limits, here, there, out, count)
    return count


@inner
def _of_one(one, e, slot, other, begin, end, same, limits, here, there, out, count):
    """Add pairs of primitive e with a range of others; within one cluster each edge pair is added once."""
    eights, wide, own = (end - begin + 7) // 8, one.corners.shape[1], len(here) - 1
    low, high = one_of(here[own], slot)
    lower, upper = one_of(there[own], slot)
    later = same and wide == 2
    for above in range(0, eights, 8):
        near = met(here, there, eights + above // 8, low, high, lower, upper, limits)
        while near != 0:
            node = above + lowest(near)
            near &= near - 1
            first = begin + 8 * node
            new = node < eights and (not later or first + 7 > e)
            left = met(here, there, node, low, high, lower, upper, limits) if new else 0
            while left != 0:
                f = first + lowest(left)
                left &= left - 1
                new = f < end and (not later or f > e)
                if new and not share_vertex(one.corners, e, other.corners, f):
                    if count < len(out):
                        for c in range(wide):
                            out[count, c] = one.corners[e, c]
                        for c in range(4 - wide):
                            out[count, wide + c] = other.corners[f, c]
                    count += 1
    return count


@inner
def _around(corners, first, end, x, boxes, node):
    """Store the boxes at x of eight primitives in a node; lanes beyond the end repeat the last one."""
    put_boxes(*hulls(corners, first, end - 1, x), boxes, node)


@inner
def _above(boxes, eights):
    """Store the boxes of the first nodes, eight per node, after them; return the box of all."""
    l0, l1, l2, h0, h1, h2 = np.inf, np.inf, np.inf, -np.inf, -np.inf, -np.inf
    for node in range(eights):
        low, high = hull(boxes[node], 8)
        above, slot = boxes[eights + node // 8], node % 8
        for axis in range(3):
            above[axis, slot], above[3 + axis, slot] = low[axis], high[axis]
        l0, l1, l2 = min(l0, low[0]), min(l1, low[1]), min(l2, low[2])
        h0, h1, h2 = max(h0, high[0]), max(h1, high[1]), max(h2, high[2])
    return (l0, l1, l2), (h0, h1, h2)
