"""What may be near: a tree of boxes around triangles, or edges, that is made once and refitted at each look.

Leaves lie along a Morton curve through the rest shape, so that a box holds a patch of the surface however it folds; the
tree is implicit, node k has the nodes 2k and 2k + 1. What is found comes in the order of points or edges, then of
leaves: it depends on nothing else, so that sums over more candidates than are near are the same to the bit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import inner, kernel
from solvers.problem import Positions

Indices = NDArray[np.int64]

_BITS = 10
_DEPTH = 128
"""Of a stack: twice the levels of any tree that memory holds."""
_ROOM = 32
"""For pairs of each primitive; where more are found, all are looked for again. Four layers that touch have some 20."""


class Tree(NamedTuple):
    """corners (m, k): vertices of each primitive; leaves (L,): which primitive each leaf has, -1 for none."""

    corners: Indices
    leaves: Indices

    @classmethod
    def of(cls, rest: Positions, corners: Indices) -> Tree:
        """A tree over primitives of a rest shape (n, 3) [m]."""
        m = len(corners)
        leaves = np.full(1 << max(0, m - 1).bit_length(), -1)
        if m:
            leaves[:m] = np.argsort(_morton(rest[corners].mean(axis=1)), kind="stable")
        return cls(np.ascontiguousarray(corners), leaves)


def _morton(x: Positions) -> Indices:
    size = float(np.ptp(x, axis=0).max()) or 1.0
    cell = np.minimum((x - x.min(axis=0)) / size * 2**_BITS, 2**_BITS - 1).astype(np.int64)
    code = np.zeros(len(x), np.int64)
    for bit in range(_BITS):
        for axis in range(3):
            code |= ((cell[:, axis] >> bit) & 1) << (3 * bit + axis)
    return code


Trees = tuple[Tree, Tree]


def near(points: Indices, trees: Trees, p: Positions, q: Positions, reach: float) -> tuple[Indices, int]:
    """Pairs that may come nearer than `reach` [m] on the straight way from p to q, both (n, 3), by their boxes: of a
    point and a triangle, then of two edges, by their numbers, (k, 2), and how many are of the first kind. trees: of
    triangles and of edges. Pairs that share a vertex are left out."""
    triangles, edges = trees
    one = found(points[:, None], triangles, p, q, reach)
    return np.concatenate([one, found(edges.corners, edges, p, q, reach, same=True)]), len(one)


def found(corners: Indices, tree: Tree, p: Positions, q: Positions, reach: float, *, same: bool = False) -> Indices:
    """Primitives with corners (m, k) and those of a tree that may come nearer than `reach` [m] on the straight way from
    p to q, by their numbers, (k, 2); same: see `look`."""
    boxes = np.empty((2 * len(tree.leaves), 6))
    refit(tree, p, q, reach, boxes)
    room, stack, box = _ROOM * len(corners) + 64, np.empty(_DEPTH, np.int64), np.empty(6)
    while True:
        out = np.empty((room, 2), np.int64)
        count = look(corners, tree, boxes, p, q, same, stack, box, out)
        if count <= room:
            return out[:count]
        room = count


@inner
def _around(corners, e, p, q, box):
    """The box (6,) of a primitive on its way: low, then high."""
    for axis in range(3):
        low, high = np.inf, -np.inf
        for a in range(corners.shape[1]):
            i = corners[e, a]
            low, high = min(low, p[i, axis], q[i, axis]), max(high, p[i, axis], q[i, axis])
        box[axis], box[3 + axis] = low, high


@kernel
def refit(tree, p, q, pad, boxes):
    """Write the boxes (2L, 6) of all nodes, each wider by `pad` [m] on all sides."""
    size = len(tree.leaves)
    for leaf in range(size):
        e, box = tree.leaves[leaf], boxes[size + leaf]
        if e < 0:
            box[:3], box[3:] = np.inf, -np.inf
            continue
        _around(tree.corners, e, p, q, box)
        for axis in range(3):
            box[axis], box[3 + axis] = box[axis] - pad, box[3 + axis] + pad
    for node in range(size - 1, 0, -1):
        for axis in range(3):
            boxes[node, axis] = min(boxes[2 * node, axis], boxes[2 * node + 1, axis])
            boxes[node, 3 + axis] = max(boxes[2 * node, 3 + axis], boxes[2 * node + 1, 3 + axis])


@kernel
def look(corners, tree, boxes, p, q, same, stack, box, out):
    """Write the pairs of `corners` (m, k) with what the tree holds to `out`, as far as there is room; how many there
    are. same: whether both are the same edges, of which each pair is wanted once; stack,
    box (6,): scratch."""
    size, count = len(tree.leaves), 0
    if len(tree.corners) == 0:
        return 0
    for e in range(len(corners)):
        _around(corners, e, p, q, box)
        stack[0], top = 1, 1
        while top > 0:
            top -= 1
            node = stack[top]
            other = boxes[node]
            if (
                box[0] > other[3] or box[1] > other[4] or box[2] > other[5]
                or box[3] < other[0] or box[4] < other[1] or box[5] < other[2]
            ):  # fmt: skip
                continue
            if node < size:
                stack[top], stack[top + 1] = 2 * node + 1, 2 * node
                top += 2
                continue
            f = tree.leaves[node - size]
            if same and f <= e:
                continue
            if _share(corners, e, tree.corners, f):
                continue
            if count < len(out):
                out[count, 0], out[count, 1] = e, f
            count += 1
    return count


@inner
def _share(first, e, second, f):
    for a in range(first.shape[1]):
        for b in range(second.shape[1]):
            if first[e, a] == second[f, b]:
                return True
    return False
