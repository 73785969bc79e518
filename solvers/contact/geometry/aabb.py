"""Axis-aligned bounding boxes (AABB) of primitives, and tests of distance limits during a motion.

Let a pair have the distance d at the start of a linear motion in which no two vertices move relative to each other by
more than M. Its distance stays at least d - M. Let t be the minimum distance, and s the one relative to d. If the pair
comes closer than t + s d, then d < (t + M)/(1 - s), so that it comes closer than

    t + s d < (t + s M)/(1 - s)

A pair that stays farther apart violates no limit. Also, no two points in two boxes are farther apart at the start than
the diagonal of the union of both boxes; where that is short, it gives the tighter bound.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_kernel
from springbench.solvers.model.step_problem import Positions
from springbench.solvers.simd.float64x8 import gather_rows, load_packet, mask_to_bits, sqrt_packet, store_packet, where

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]

_NODE_STRIDE = 48
"""Numbers of a node: six coordinates of eight boxes."""


class CollisionQuery(NamedTuple):
    """Limits that no pair may violate during a motion.

    A pair violates them if it comes closer than `inflation_radius` [m], or closer than `min_distance` [m] plus
    `relative_min_distance` times its initial distance. The second limit does not apply to ranges of vertices whose
    boxes around the whole motion are farther apart than `inflation_radius` (`compute_aabb_clearance`).
    max_displacement [m]: upper bound of the displacement of any two vertices relative to each other.
    """

    inflation_radius: float
    min_distance: float
    relative_min_distance: float
    max_displacement: float = np.inf


class ClearanceBounds(NamedTuple):
    """Lower bounds of distances [m]: `near_clearance` of pairs close at rest, `far_clearance` of all others."""

    near_clearance: float
    far_clearance: float


@jit_inner
def primitive_aabbs(corners, first, last, x):
    """Return the lower and upper corners of the boxes of eight primitives.

    Args:
        corners: vertices of each primitive (m, k).
        first: index of the first of the eight primitives.
        last: index of the last primitive, which is repeated in lanes beyond it.
        x: positions (n, 4) [m]; column 3 is padding.
    """
    low = gather_rows(x, corners, first, last, 0)
    high = low
    for a in range(1, corners.shape[1]):
        v = gather_rows(x, corners, first, last, a)
        low, high = componentwise_min(low, v), componentwise_max(high, v)
    return low, high


@jit_inner
def store_aabbs(low, high, boxes, node):
    """Store eight boxes in a node.

    Args:
        low, high: lower and upper corners [m], three packets each.
        boxes: boxes of the tree (nodes, 6, 8) [m], updated.
        node: index of the node.
    """
    for axis in range(3):
        store_packet(low[axis], boxes, _NODE_STRIDE * node + 8 * axis)
        store_packet(high[axis], boxes, _NODE_STRIDE * node + 24 + 8 * axis)


def compute_aabb_clearance(
    one: tuple[int, int], other: tuple[int, int], p: Positions, q: Positions, query: CollisionQuery
) -> float:
    """Return the distance [m] at q of the boxes of two vertex ranges.

    It is 0 unless the boxes prove that no limit is violated. If the boxes around the whole motion are farther apart
    than the inflation radius, the limit relative to the initial distance is not tested.

    Args:
        one: first vertex of one range, and the vertex after its last one.
        other: first vertex of the other range, and the vertex after its last one.
        p: start positions (n, 3) [m] of the linear motion.
        q: end positions (n, 3) [m].
        query: limits of the distances.

    Returns:
        Lower bound of the distances at q, at least the inflation radius; 0 without a proof.
    """
    low, high = np.empty((2, 2, 3)), np.empty((2, 2, 3))
    for k, x in enumerate((p, q)):
        for j, (first, end) in enumerate((one, other)):
            compute_vertex_aabb(x, first, end, low[k, j], high[k, j])
    apart = np.maximum(low[1, 0] - high[1, 1], low[1, 1] - high[1, 0])
    clearance = float(np.linalg.norm(np.maximum(apart, 0.0)))
    least, most = low.min(axis=0), high.max(axis=0)
    if max(float((least[0] - most[1]).max()), float((least[1] - most[0]).max())) > query.inflation_radius:
        return clearance  # the boxes around the whole motion are separated, so that no pair limits the step size
    wide = float(np.linalg.norm(high[0].max(axis=0) - low[0].min(axis=0)))
    wide = min(
        max(query.inflation_radius, query.min_distance + query.relative_min_distance * wide), max_inflation(query)
    )
    gap = np.array([low[:, 0] - high[:, 1], low[:, 1] - high[:, 0]])
    return clearance if (gap > wide).all(axis=1).any() else 0.0


@jit_kernel
def compute_vertex_aabb(x, first, end, low, high):
    """Write the smallest and largest coordinates of a range of vertices.

    Args:
        x: positions (n, 3) [m].
        first, end: first row of the range, and the row after its last one.
        low, high: outputs (3,) [m]; infinite for an empty range.
    """
    low[:], high[:] = np.inf, -np.inf
    for i in range(first, end):
        for axis in range(3):
            low[axis], high[axis] = min(low[axis], x[i, axis]), max(high[axis], x[i, axis])


@jit_inner
def merge_aabbs(boxes, num_boxes):
    """Return the lower and upper corner of the union of boxes of a node.

    Args:
        boxes: boxes of the node (6, 8) [m].
        num_boxes: number of leading boxes to unite.
    """
    l0, l1, l2, h0, h1, h2 = np.inf, np.inf, np.inf, -np.inf, -np.inf, -np.inf
    for k in range(num_boxes):
        l0, l1, l2 = min(l0, boxes[0, k]), min(l1, boxes[1, k]), min(l2, boxes[2, k])
        h0, h1, h2 = max(h0, boxes[3, k]), max(h1, boxes[4, k]), max(h2, boxes[5, k])
    return (l0, l1, l2), (h0, h1, h2)


@jit_kernel
def max_inflation(query):
    """Return the distance [m] beyond which no limit can be violated."""
    # The test avoids 0 times an infinite displacement, which would be NaN.
    relative_offset = query.relative_min_distance * query.max_displacement if query.relative_min_distance > 0.0 else 0.0
    return max(query.inflation_radius, (query.min_distance + relative_offset) / (1.0 - query.relative_min_distance))


@jit_inner
def overlap_mask(boxes, end_boxes, node, low, high, lower, upper, query):
    """Return as bits which boxes of a node may violate the limits with another box.

    Boxes that are separated by the inflation along one axis, on the same side at the start and at the end of the
    motion, are excluded. If both arrays of boxes are the same, the boxes contain the whole motion.

    Args:
        boxes: start boxes (nodes, 6, 8) [m].
        end_boxes: end boxes (nodes, 6, 8) [m].
        node: index of the node.
        low, high: corners of the other box at the start.
        lower, upper: corners of the other box at the end.
        query: limits of the distances.
    """
    at, most = _NODE_STRIDE * node, max_inflation(query)
    x0, x1, x2 = load_packet(boxes, at), load_packet(boxes, at + 8), load_packet(boxes, at + 16)
    y0, y1, y2 = load_packet(boxes, at + 24), load_packet(boxes, at + 32), load_packet(boxes, at + 40)
    if end_boxes is boxes:  # the tests of the end boxes are those of the start boxes
        return mask_to_bits(
            (x0 <= high[0] + most)
            & (y0 >= low[0] - most)
            & (x1 <= high[1] + most)
            & (y1 >= low[1] - most)
            & (x2 <= high[2] + most)
            & (y2 >= low[2] - most)
        )
    s0, s1, s2 = load_packet(end_boxes, at), load_packet(end_boxes, at + 8), load_packet(end_boxes, at + 16)
    t0, t1, t2 = load_packet(end_boxes, at + 24), load_packet(end_boxes, at + 32), load_packet(end_boxes, at + 40)
    w0, w1, w2 = (
        _union_width(x0, y0, low[0], high[0]),
        _union_width(x1, y1, low[1], high[1]),
        _union_width(x2, y2, low[2], high[2]),
    )
    wide = query.min_distance + query.relative_min_distance * sqrt_packet(w0 * w0 + w1 * w1 + w2 * w2)
    wide = where(wide > query.inflation_radius, wide, query.inflation_radius + 0.0 * wide)
    wide = where(wide < most, wide, most + 0.0 * wide)
    return mask_to_bits(
        ((x0 <= high[0] + wide) | (s0 <= upper[0] + wide))
        & ((y0 >= low[0] - wide) | (t0 >= lower[0] - wide))
        & ((x1 <= high[1] + wide) | (s1 <= upper[1] + wide))
        & ((y1 >= low[1] - wide) | (t1 >= lower[1] - wide))
        & ((x2 <= high[2] + wide) | (s2 <= upper[2] + wide))
        & ((y2 >= low[2] - wide) | (t2 >= lower[2] - wide))
    )


@jit_inner
def extract_aabb(boxes, slot):
    """Return the lower and upper corner of one box of a node.

    Args:
        boxes: boxes of the node (6, 8) [m].
        slot: column of the box.
    """
    return (boxes[0, slot], boxes[1, slot], boxes[2, slot]), (boxes[3, slot], boxes[4, slot], boxes[5, slot])


@jit_inner
def componentwise_min(a, b):
    """Return the componentwise minimum of packets of points.

    Args:
        a, b: three packets each, one for each coordinate.
    """
    return where(a[0] < b[0], a[0], b[0]), where(a[1] < b[1], a[1], b[1]), where(a[2] < b[2], a[2], b[2])


@jit_inner
def componentwise_max(a, b):
    """Return the componentwise maximum of packets of points.

    Args:
        a, b: three packets each, one for each coordinate.
    """
    return where(a[0] > b[0], a[0], b[0]), where(a[1] > b[1], a[1], b[1]), where(a[2] > b[2], a[2], b[2])


@jit_inner
def _union_width(x, y, low, high):
    """Return the width of the union of two intervals."""
    return where(y > high, y, high) - where(x < low, x, low)


@jit_inner
def has_common_vertex(first, e, second, f):
    """Return whether two primitives have a common vertex.

    Args:
        first: vertices of the primitives of one tree (m, k).
        e: index of a primitive in `first`.
        second: vertices of the primitives of the other tree (l, j).
        f: index of a primitive in `second`.
    """
    shared = False
    for a in range(first.shape[1]):
        for b in range(second.shape[1]):
            shared |= first[e, a] == second[f, b]
    return shared
