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
from numpy.typing import NDArray

from solvers.compiling import inner, kernel
from solvers.problem import Positions
from solvers.vectors.eights import bits, loaded, lowest

Indices = NDArray[np.int64]

_BITS = 10
_DEPTH = 8 * 22
"""Of a stack: eight times the levels of any tree that memory holds."""
_ROOM = 24
"""For pairs of each primitive; where more are found, all are looked for again. Four layers that touch have some 14."""
_NUMBERS = 48
"""Numbers of a node: six coordinates of eight boxes."""


class Tree(NamedTuple):
    """corners (m, k): vertices of each primitive, along the curve; levels: of nodes, with the root's."""

    corners: Indices
    levels: int

    @classmethod
    def of(cls, rest: Positions, corners: Indices) -> Tree:
        """A tree over primitives of a rest shape (n, 3) [m]."""
        order = along_curve(rest[corners].mean(axis=1))
        levels = 1
        while 8**levels < len(corners):
            levels += 1
        return cls(np.ascontiguousarray(corners[order]), levels)

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


def near(points: Tree, triangles: Tree, edges: Tree, p: Positions, q: Positions, reach: float) -> tuple[Indices, int]:
    """Pairs that may come nearer than `reach` [m] on the straight way from p to q, both (n, 3), by their boxes: of a
    point and a triangle, then of two edges, by their numbers, (k, 2), and how many are of the first kind. Pairs that
    share a vertex are left out."""
    one = found(points, triangles, p, q, reach)
    return np.concatenate([one, found(edges, edges, p, q, reach)]), len(one)


def found(one: Tree, other: Tree, p: Positions, q: Positions, reach: float) -> Indices:
    """What of two trees may come nearer than `reach` [m] on the straight way from p to q, by their numbers, (k, 2); of
    a tree and itself each pair once, the lower number first."""
    if not (len(one.corners) and len(other.corners)):
        return np.empty((0, 2), np.int64)
    boxes = [np.empty((tree.nodes, 6, 8)) for tree in ((one,) if one is other else (one, other))]
    for tree, around in zip((one, other), boxes, strict=False):
        refit(tree, p, q, 0.5 * reach, around)
    room, stack = _ROOM * len(one.corners) + 64, np.empty((_DEPTH, 3), np.int64)
    while True:
        out = np.empty((room, 2), np.int64)
        count = look(one, other, boxes[0], boxes[-1], one is other, stack, out)
        if count <= room:
            return out[:count]
        room = count


@kernel
def refit(tree, p, q, pad, boxes):
    """Write the boxes (nodes, 6, 8), each wider by `pad` [m] on all sides; those of nothing are nowhere."""
    boxes[:, :3], boxes[:, 3:] = np.inf, -np.inf
    size, last = len(tree.corners), len(boxes) - (len(tree.corners) + 7) // 8
    for e in range(size):
        box, slot = boxes[last + e // 8], e % 8
        for axis in range(3):
            low, high = np.inf, -np.inf
            for a in range(tree.corners.shape[1]):
                i = tree.corners[e, a]
                low, high = min(low, p[i, axis], q[i, axis]), max(high, p[i, axis], q[i, axis])
            box[axis, slot], box[3 + axis, slot] = low - pad, high + pad
    for node in range(len(boxes) - 1, 0, -1):
        above, slot = boxes[(node - 1) // 8], (node - 1) % 8
        for axis in range(3):
            low, high = np.inf, -np.inf
            for k in range(8):
                low, high = min(low, boxes[node, axis, k]), max(high, boxes[node, 3 + axis, k])
            above[axis, slot], above[3 + axis, slot] = low, high


@kernel
def look(one, other, mine, boxes, same, stack, out):
    """Write the pairs of two trees, with their boxes, to `out`, as far as there is room; how many there are. same:
    whether both are one tree, of which each pair is wanted once; stack: scratch."""
    count, leaf = 0, len(mine) - (len(one.corners) + 7) // 8
    for begin in range(0, len(one.corners), 8):
        around = mine[leaf + begin // 8]
        l0, l1, l2, h0, h1, h2 = np.inf, np.inf, np.inf, -np.inf, -np.inf, -np.inf
        for k in range(8):
            l0, l1, l2 = min(l0, around[0, k]), min(l1, around[1, k]), min(l2, around[2, k])
            h0, h1, h2 = max(h0, around[3, k]), max(h1, around[4, k]), max(h2, around[5, k])
        # A node, its first primitive, and how many lie in each of its boxes.
        stack[0, 0], stack[0, 1], stack[0, 2], top = 0, 0, 8 ** (other.levels - 1), 1
        while top > 0:
            top -= 1
            node, first, each = stack[top, 0], stack[top, 1], stack[top, 2]
            at = _NUMBERS * node
            x0, x1, x2 = loaded(boxes, at), loaded(boxes, at + 8), loaded(boxes, at + 16)
            y0, y1, y2 = loaded(boxes, at + 24), loaded(boxes, at + 32), loaded(boxes, at + 40)
            if each > 1:
                left = bits((x0 <= h0) & (x1 <= h1) & (x2 <= h2) & (y0 >= l0) & (y1 >= l1) & (y2 >= l2))
                if same:
                    left &= -1 << max(0, (begin - first) // each)  # nothing that comes before these eight
                for slot in range(7, -1, -1):  # the first one comes out first
                    if left >> slot & 1:
                        stack[top, 0], stack[top, 1], stack[top, 2] = (
                            8 * node + 1 + slot,
                            first + slot * each,
                            each // 8,
                        )
                        top += 1
                continue
            for k in range(min(8, len(one.corners) - begin)):
                left = bits(
                    (x0 <= around[3, k]) & (x1 <= around[4, k]) & (x2 <= around[5, k])
                    & (y0 >= around[0, k]) & (y1 >= around[1, k]) & (y2 >= around[2, k])
                )  # fmt: skip
                if same:
                    left &= -1 << max(0, begin + k - first + 1)
                while left != 0:
                    f = first + lowest(left)
                    left &= left - 1
                    if count < len(out):  # what shares a vertex is written over: nobody could foretell a branch here
                        out[count, 0], out[count, 1] = begin + k, f
                    count += not _share(one.corners, begin + k, other.corners, f)
    return count


@inner
def _share(first, e, second, f):
    shared = False
    for a in range(first.shape[1]):
        for b in range(second.shape[1]):
            shared |= first[e, a] == second[f, b]
    return shared
