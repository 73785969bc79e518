"""Axis-aligned bounding boxes (AABB) of primitives, and tests of which may violate distance limits during a motion.

Let a pair have the distance d at the start of a linear motion in which no two vertices move relative to each other by
more than M. It keeps at least the distance d - M. If it comes closer than t + s d, then d < (t + M)/(1 - s), so that it
comes closer than

    t + s d < (t + s M)/(1 - s)

A pair that stays farther apart violates no limit. Also, no two points in two boxes are farther apart at the start than
the diagonal of the union of both boxes; where that is short, it gives the tighter bound.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import inner, kernel
from solvers.problem import Positions
from solvers.vectors.eights import bits, loaded, root, rows, stored, where

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_NUMBERS = 48
"""Numbers of a node: six coordinates of eight boxes."""


class Limits(NamedTuple):
    """Limits that no pair may violate during a motion.

    A pair violates them if it comes closer than `reach` [m], or closer than `closed` [m] plus
    `share` times its initial distance. moved [m]: upper bound of the displacement of any two
    vertices relative to each other.
    """

    reach: float
    closed: float
    share: float
    moved: float = np.inf


class Gaps(NamedTuple):
    """Lower bounds of distances [m]: `near` of pairs close at rest, `far` of all others."""

    near: float
    far: float


@inner
def hulls(corners, first, last, x):
    """Return the lower and upper corners of the boxes of eight primitives at x (n, 4).

    Args:
        corners: vertices of each primitive (m, k).
        first: index of the first of the eight primitives.
        last: index of the last primitive, which is repeated in lanes beyond it.
        x: positions (n, 4) [m]; column 3 is padding.
    """
    low = rows(x, corners, first, last, 0)
    high = low
    for a in range(1, corners.shape[1]):
        v = rows(x, corners, first, last, a)
        low, high = smaller(low, v), larger(high, v)
    return low, high


@inner
def put_boxes(low, high, boxes, node):
    """Store eight boxes in a node."""
    for axis in range(3):
        stored(low[axis], boxes, _NUMBERS * node + 8 * axis)
        stored(high[axis], boxes, _NUMBERS * node + 24 + 8 * axis)


def apart(one: tuple[int, int], other: tuple[int, int], p: Positions, q: Positions, limits: Limits) -> bool:
    """Return whether the boxes of two vertex ranges prove that no limit is violated.

    Args:
        one: first and last vertex of one range.
        other: first and last vertex of the other range.
        p: start positions (n, 3) [m] of the linear motion.
        q: end positions (n, 3) [m].
        limits: limits of the distances.
    """
    low, high = np.empty((2, 2, 3)), np.empty((2, 2, 3))
    for k, x in enumerate((p, q)):
        for j, (first, last) in enumerate((one, other)):
            extent(x, first, last, low[k, j], high[k, j])
    begin, end = low.min(axis=0), high.max(axis=0)
    if max(float((begin[0] - end[1]).max()), float((begin[1] - end[0]).max())) > limits.reach:
        return True  # no way leads so near, and what no way leads to bounds no step
    wide = float(np.linalg.norm(high[0].max(axis=0) - low[0].min(axis=0)))
    wide = min(max(limits.reach, limits.closed + limits.share * wide), widest(limits))
    gap = np.array([low[:, 0] - high[:, 1], low[:, 1] - high[:, 0]])
    return bool((gap > wide).all(axis=1).any())


@kernel
def extent(x, first, last, low, high):
    """Write the smallest and largest coordinates (3,) of the rows `first` to `last` of x (n, 3)."""
    low[:], high[:] = np.inf, -np.inf
    for i in range(first, last):
        for axis in range(3):
            low[axis], high[axis] = min(low[axis], x[i, axis]), max(high[axis], x[i, axis])


@inner
def hull(boxes, many):
    """Return the corners of the union of the first `many` boxes of a node (6, 8)."""
    l0, l1, l2, h0, h1, h2 = np.inf, np.inf, np.inf, -np.inf, -np.inf, -np.inf
    for k in range(many):
        l0, l1, l2 = min(l0, boxes[0, k]), min(l1, boxes[1, k]), min(l2, boxes[2, k])
        h0, h1, h2 = max(h0, boxes[3, k]), max(h1, boxes[4, k]), max(h2, boxes[5, k])
    return (l0, l1, l2), (h0, h1, h2)


@kernel
def widest(limits):
    """Return the distance [m] beyond which no limit can be violated."""
    beside = limits.share * limits.moved if limits.share > 0.0 else 0.0
    return max(limits.reach, (limits.closed + beside) / (1.0 - limits.share))


@inner
def met(boxes, there, node, low, high, lower, upper, limits):
    """Return as bits which boxes of a node may violate the limits with another box.

    Boxes that are separated by the inflation along one axis, on the same side at the start and at the end of the
    motion, are excluded. If both arrays of boxes are the same, the boxes contain the whole motion.

    Args:
        boxes: start boxes (nodes, 6, 8) [m].
        there: end boxes (nodes, 6, 8) [m].
        node: index of the node.
        low, high: corners of the other box at the start.
        lower, upper: corners of the other box at the end.
        limits: limits of the distances.
    """
    at, most = _NUMBERS * node, widest(limits)
    x0, x1, x2 = loaded(boxes, at), loaded(boxes, at + 8), loaded(boxes, at + 16)
    y0, y1, y2 = loaded(boxes, at + 24), loaded(boxes, at + 32), loaded(boxes, at + 40)
    if there is boxes:  # half the tests say the other half
        return bits((x0 <= high[0] + most) & (y0 >= low[0] - most) & (x1 <= high[1] + most) & (y1 >= low[1] - most)
                    & (x2 <= high[2] + most) & (y2 >= low[2] - most))  # fmt: skip
    s0, s1, s2 = loaded(there, at), loaded(there, at + 8), loaded(there, at + 16)
    t0, t1, t2 = loaded(there, at + 24), loaded(there, at + 32), loaded(there, at + 40)
    w0, w1, w2 = _width(x0, y0, low[0], high[0]), _width(x1, y1, low[1], high[1]), _width(x2, y2, low[2], high[2])
    wide = limits.closed + limits.share * root(w0 * w0 + w1 * w1 + w2 * w2)
    wide = where(wide > limits.reach, wide, limits.reach + 0.0 * wide)
    wide = where(wide < most, wide, most + 0.0 * wide)
    return bits(((x0 <= high[0] + wide) | (s0 <= upper[0] + wide)) & ((y0 >= low[0] - wide) | (t0 >= lower[0] - wide))
        & ((x1 <= high[1] + wide) | (s1 <= upper[1] + wide)) & ((y1 >= low[1] - wide) | (t1 >= lower[1] - wide))
        & ((x2 <= high[2] + wide) | (s2 <= upper[2] + wide)) & ((y2 >= low[2] - wide) | (t2 >= lower[2] - wide))
    )  # fmt: skip


@inner
def one_of(boxes, slot):
    """Return the lower and upper corner of one box of a node (6, 8)."""
    return (boxes[0, slot], boxes[1, slot], boxes[2, slot]), (boxes[3, slot], boxes[4, slot], boxes[5, slot])


@inner
def smaller(a, b):
    """Return the componentwise minimum of packets of points."""
    return where(a[0] < b[0], a[0], b[0]), where(a[1] < b[1], a[1], b[1]), where(a[2] < b[2], a[2], b[2])


@inner
def larger(a, b):
    """Return the componentwise maximum of packets of points."""
    return where(a[0] > b[0], a[0], b[0]), where(a[1] > b[1], a[1], b[1]), where(a[2] > b[2], a[2], b[2])


@inner
def _width(x, y, low, high):
    """Return the width of the union of two intervals."""
    return where(y > high, y, high) - where(x < low, x, low)


@inner
def share_vertex(first, e, second, f):
    """Return whether two primitives have a common vertex."""
    shared = False
    for a in range(first.shape[1]):
        for b in range(second.shape[1]):
            shared |= first[e, a] == second[f, b]
    return shared
