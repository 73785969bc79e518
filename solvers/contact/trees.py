"""What may be near: trees of boxes around points, edges or triangles, made once and refitted at each look.

A node has eight boxes, tested at once in vector registers (`solvers.vectors.eights`). Primitives are numbered along a
Morton curve through the rest shape, so that eight that follow each other are a patch of the surface however it folds,
and a tree is implicit: below box b of node k is the node 8 k + 1 + b. Eight primitives go down another tree together,
and are told apart where it ends. What is found comes in the order of these eights, of those that they meet, and of
primitives: it depends on nothing else, so that sums over more candidates than are near are the same to the bit.
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
"""Of a stack: eight times the levels of any tree that memory holds."""
_ROOM = 24
"""For pairs of each primitive; where more are found, all are looked for again. Four layers that touch have some 14."""


class Tree(NamedTuple):
    """corners (m, k): vertices of each primitive, along the curve; levels: of nodes, with the root's; size [m]: of
    primitives at rest, in the mean."""

    corners: Indices
    levels: int
    size: float = 0.0

    @classmethod
    def of(cls, rest: Positions, corners: Indices) -> Tree:
        """A tree over primitives of a rest shape (n, 3) [m]."""
        order, size = along_curve(rest[corners].mean(axis=1)), 0.0
        if len(corners):
            size = float(np.linalg.norm(np.ptp(rest[corners], axis=1), axis=1).mean())
        return cls.over(len(corners))._replace(corners=np.ascontiguousarray(corners[order]), size=size)

    @classmethod
    def over(cls, many: int) -> Tree:
        """A tree over so many things that follow each other along the curve already."""
        levels = 1
        while 8**levels < many:
            levels += 1
        return cls(np.arange(many)[:, None], levels)

    @property
    def nodes(self) -> int:
        """How many there are, those of the last level as far as primitives go."""
        return _first(self.levels - 1) + max(1, -(-len(self.corners) // 8))


def _first(level: int) -> int:
    """The number of a level's first node."""
    return (8**level - 1) // 7


def along_curve(x: Positions) -> Indices:
    """The order of points (m, 3) [m] along a Morton curve."""
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
    """What of two trees may come to its limits on the straight way from x to y, (n, 4) both, positions with a column
    more, by their numbers, (k, 2); of a tree and itself each pair once, the lower number first. What shares a vertex is
    left out. Where vertices move beside each other by less than primitives are long, and not all alike by more, boxes
    around their ways say as much as boxes at the begin and at the end, and take half the time."""
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
    """Scratch of a look."""
    return np.empty((_DEPTH, 3), np.int64)


def _boxes(one: Tree, other: Tree, x: Array, y: Array) -> tuple[Array, Array]:
    """The boxes of both around the ways from x to y, (n, 4) both."""
    boxes = [np.empty((tree.nodes, 6, 8)) for tree in ((one,) if one is other else (one, other))]
    for tree, around in zip((one, other), boxes, strict=False):
        refit(tree, x, y, around)
    return boxes[0], boxes[-1]


@kernel
def refit(tree, x, y, boxes):
    """Write the boxes (nodes, 6, 8) around the ways from x to y, (n, 4) both; those of nothing are nowhere."""
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
    """Write the boxes (nodes, 6, 8) above those of so many things, of which those of the last level are written."""
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
    """Write the pairs of two trees that may come to their limits, with their boxes at the begin of a way and at its
    end, to `out`, as far as there is room; how many there are. same: whether both are one tree, of which each pair is
    wanted once; stack: scratch."""
    (mine, boxes), (yours, there) = begin, end
    count, leaf = 0, len(mine) - (len(one.corners) + 7) // 8
    for first_of_eight in range(0, len(one.corners), 8):
        around, after = mine[leaf + first_of_eight // 8], yours[leaf + first_of_eight // 8]
        low, high = hull(around, 8)
        lower, upper = hull(after, 8)
        # A node, its first primitive, and how many lie in each of its boxes.
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
