"""Broad phase: bounding volume hierarchies (BVH) over points, edges or triangles, built once and refitted per query.

A node has eight boxes, tested at once in vector registers (`solvers.vectors.eights`). Primitives are numbered along a
Morton curve through the rest shape, so that eight consecutive ones form a patch of the surface however it folds. The
tree is implicit: the child of box b of node k is node 8 k + 1 + b. Eight primitives traverse the other tree together
and are separated at its leaves. Candidates are ordered by these packets, by the leaves, and by primitives. The order
depends on nothing else, so that sums over a superset of the active pairs are bitwise identical.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from solvers.compiling import kernel
from solvers.contact.boxes import (
    Array,
    Indices,
    Limits,
    hull,
    hulls,
    larger,
    met,
    one_of,
    put_boxes,
    share_vertex,
    smaller,
)
from solvers.problem import Positions
from solvers.vectors.eights import lowest

_BITS = 10
_DEPTH = 8 * 22
"""Stack entries: eight times the number of levels of any tree that fits in memory."""
_ROOM = 24
"""Initial capacity for pairs of each primitive; beyond it the query is repeated. Four touching layers have some 14."""


class Tree(NamedTuple):
    """Implicit tree of eight-box nodes.

    Attributes:
        corners: vertices of each primitive in Morton order, (m, k).
        levels: number of levels, including the root.
        size: mean diagonal of the primitives at rest [m].
    """

    corners: Indices
    levels: int
    size: float = 0.0

    @classmethod
    def of(cls, rest: Positions, corners: Indices) -> Tree:
        """Build a tree over primitives (m, k) of a rest shape (n, 3) [m]."""
        order, size = along_curve(rest[corners].mean(axis=1)), 0.0
        if len(corners):
            size = float(np.linalg.norm(np.ptp(rest[corners], axis=1), axis=1).mean())
        return cls.over(len(corners))._replace(corners=np.ascontiguousarray(corners[order]), size=size)

    @classmethod
    def over(cls, many: int) -> Tree:
        """Build a tree over items that are in Morton order already."""
        levels = 1
        while 8**levels < many:
            levels += 1
        return cls(np.arange(many)[:, None], levels)

    @property
    def nodes(self) -> int:
        """Number of nodes; the last level ends with the last primitive."""
        return _first(self.levels - 1) + max(1, -(-len(self.corners) // 8))


def _first(level: int) -> int:
    """Return the index of a level's first node."""
    return (8**level - 1) // 7


def along_curve(x: Positions) -> Indices:
    """Return the order of points (m, 3) [m] along a Morton curve."""
    if not len(x):
        return np.empty(0, np.int64)
    size = float(np.ptp(x, axis=0).max()) or 1.0
    cell = np.minimum((x - x.min(axis=0)) / size * 2**_BITS, 2**_BITS - 1).astype(np.int64)
    code = np.zeros(len(x), np.int64)
    for bit in range(_BITS):
        for axis in range(3):
            code |= ((cell[:, axis] >> bit) & 1) << (3 * bit + axis)
    return np.argsort(code, kind="stable")


def found(one: Tree, other: Tree, x: Array, y: Array, limits: Limits) -> Indices:
    """Return the pairs of two trees that may violate the limits on a linear motion.

    Pairs that share a vertex are excluded. If vertices move relative to each other by less than the primitive size,
    boxes around the whole motion are as tight as separate start and end boxes, and take half the time.

    Args:
        one, other: the trees; if both are the same, each pair is found once, the lower index first.
        x: start positions (n, 4) [m]; column 3 is padding.
        y: end positions (n, 4) [m]; column 3 is padding.
        limits: limits of the distances.

    Returns:
        Primitive indices (k, 2).
    """
    if not (len(one.corners) and len(other.corners)):
        return np.empty((0, 2), np.int64)
    if limits.moved <= max(one.size, other.size):
        begin = end = _boxes(one, other, x, y)
    else:
        begin, end = _boxes(one, other, x, x), _boxes(one, other, y, y)
    room, ways = _ROOM * len(one.corners) + 64, stack()
    while True:
        out = np.empty((room, 2), np.int64)
        count = look(one, other, begin, end, limits, one is other, ways, out)
        if count <= room:
            return out[:count]
        room = count


def stack() -> Indices:
    """Allocate the scratch of a traversal."""
    return np.empty((_DEPTH, 3), np.int64)


def _boxes(one: Tree, other: Tree, x: Array, y: Array) -> tuple[Array, Array]:
    """Build the boxes of both trees around the linear motion from x to y, (n, 4) each."""
    boxes = [np.empty((tree.nodes, 6, 8)) for tree in ((one,) if one is other else (one, other))]
    for tree, around in zip((one, other), boxes, strict=False):
        refit(tree, x, y, around)
    return boxes[0], boxes[-1]


@kernel
def refit(tree, x, y, boxes):
    """Refit the boxes of a tree to a linear motion.

    Args:
        tree: the tree.
        x: start positions (n, 4) [m].
        y: end positions (n, 4) [m].
        boxes: boxes (nodes, 6, 8) [m], overwritten; unused lanes get empty boxes at infinity.
    """
    many = len(tree.corners)
    leaf = len(boxes) - (many + 7) // 8
    for first in range(0, many, 8):
        low, high = hulls(tree.corners, first, many - 1, x)
        if x is not y:
            lower, upper = hulls(tree.corners, first, many - 1, y)
            low, high = smaller(low, lower), larger(high, upper)
        put_boxes(low, high, boxes, leaf + first // 8)
    lift(boxes, many)


@kernel
def lift(boxes, many):
    """Compute the boxes (nodes, 6, 8) of all inner nodes from those of the last level."""
    last = len(boxes) - (many + 7) // 8
    boxes[:last, :3], boxes[:last, 3:] = np.inf, -np.inf
    for k in range(many, 8 * ((many + 7) // 8)):
        boxes[last + k // 8, :3, k % 8], boxes[last + k // 8, 3:, k % 8] = np.inf, -np.inf
    for node in range(len(boxes) - 1, 0, -1):
        above, slot = boxes[(node - 1) // 8], (node - 1) % 8
        for axis in range(3):
            low, high = np.inf, -np.inf
            for k in range(8):
                low, high = min(low, boxes[node, axis, k]), max(high, boxes[node, 3 + axis, k])
            above[axis, slot], above[3 + axis, slot] = low, high


@kernel
def look(one, other, begin, end, limits, same, stack, out):
    """Write the pairs of two trees that may violate the limits, and return their number.

    Args:
        one, other: the trees.
        begin, end: boxes of both trees at the start and at the end of the motion.
        limits: limits of the distances.
        same: whether both trees are the same; each pair is then found once.
        stack: scratch, (s, 3).
        out: primitive indices (k, 2); pairs beyond its capacity are counted only.
    """
    (mine, boxes), (yours, there) = begin, end
    count, leaf = 0, len(mine) - (len(one.corners) + 7) // 8
    for first_of_eight in range(0, len(one.corners), 8):
        around, after = mine[leaf + first_of_eight // 8], yours[leaf + first_of_eight // 8]
        low, high = hull(around, 8)
        lower, upper = hull(after, 8)
        # Stack entries: a node, its first primitive, and the number of primitives in each of its boxes.
        stack[0, 0], stack[0, 1], stack[0, 2], top = 0, 0, 8 ** (other.levels - 1), 1
        while top > 0:
            top -= 1
            node, first, each = stack[top, 0], stack[top, 1], stack[top, 2]
            if each > 1:
                left = met(boxes, there, node, low, high, lower, upper, limits)
                if same:
                    left &= -1 << max(0, (first_of_eight - first) // each)  # nothing that comes before these eight
                for slot in range(7, -1, -1):  # the first one comes out first
                    if left >> slot & 1:
                        stack[top, 0], stack[top, 1], stack[top, 2] = (
                            8 * node + 1 + slot,
                            first + slot * each,
                            each // 8,
                        )
                        top += 1
                continue
            above, slot, own = max(0, node - 1) // 8, (node - 1) % 8, 255
            if node > 0:  # which of the eight come near the box around this node
                own = met(
                    mine, yours, leaf + first_of_eight // 8, *one_of(boxes[above], slot), *one_of(there[above], slot),
                    limits,
                )  # fmt: skip
            while own != 0:
                k = lowest(own)
                own &= own - 1
                left = met(boxes, there, node, *one_of(around, k), *one_of(after, k), limits)
                if same:
                    left &= -1 << max(0, first_of_eight + k - first + 1)
                while left != 0:
                    f = first + lowest(left)
                    left &= left - 1
                    if count < len(out):  # what shares a vertex is written over: nobody could foretell a branch here
                        out[count, 0], out[count, 1] = first_of_eight + k, f
                    count += not share_vertex(one.corners, first_of_eight + k, other.corners, f)
    return count
