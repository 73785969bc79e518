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
from solvers.vectors.eights import bits, loaded, lowest, root, where

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_BITS = 10
_DEPTH = 8 * 22
"""Of a stack: eight times the levels of any tree that memory holds."""
_ROOM = 24
"""For pairs of each primitive; where more are found, all are looked for again. Four layers that touch have some 14."""
_NUMBERS = 48
"""Numbers of a node: six coordinates of eight boxes."""


class Limits(NamedTuple):
    """What no pair may come to on a way: nearer than `reach` [m], or than `share` of its distance where the way begins
    and `closed` [m] more."""

    reach: float
    closed: float
    share: float


class Gaps(NamedTuple):
    """How far pairs are apart at least [m]: near of what is near each other at rest, and far of all else."""

    near: float
    far: float


class Tree(NamedTuple):
    """corners (m, k): vertices of each primitive, along the curve; levels: of nodes, with the root's."""

    corners: Indices
    levels: int

    @classmethod
    def of(cls, rest: Positions, corners: Indices) -> Tree:
        """A tree over primitives of a rest shape (n, 3) [m]."""
        order = along_curve(rest[corners].mean(axis=1))
        return cls.over(len(corners))._replace(corners=np.ascontiguousarray(corners[order]))

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


def near(
    points: Tree, triangles: Tree, edges: Tree, p: Positions, q: Positions, reach: float, share: float = 0.0
) -> tuple[Indices, int]:
    """Pairs that may come nearer than `reach` [m], and `share` of their distance at p, on the straight way from p to q,
    both (n, 3), by their boxes: of a point and a triangle, then of two edges, by their numbers, (k, 2), and how many
    are of the first kind. Pairs that share a vertex are left out."""
    one = found(points, triangles, p, q, reach, share)
    return np.concatenate([one, found(edges, edges, p, q, reach, share)]), len(one)


def found(one: Tree, other: Tree, p: Positions, q: Positions, reach: float, share: float = 0.0) -> Indices:
    """What of two trees may come nearer than `reach` [m], and `share` of its distance at p, on the straight way from p
    to q, by their numbers, (k, 2); of a tree and itself each pair once, the lower number first."""
    if not (len(one.corners) and len(other.corners)):
        return np.empty((0, 2), np.int64)
    begin = _boxes(one, other, p)
    end = begin if q is p else _boxes(one, other, q)
    room, ways, limits = _ROOM * len(one.corners) + 64, stack(), Limits(reach, reach, share)
    while True:
        out = np.empty((room, 2), np.int64)
        count = look(one, other, begin, end, limits, one is other, ways, out)
        if count <= room:
            return out[:count]
        room = count


def stack() -> Indices:
    """Scratch of a look."""
    return np.empty((_DEPTH, 3), np.int64)


def _boxes(one: Tree, other: Tree, x: Positions) -> tuple[Array, Array]:
    """The boxes of both at x (n, 3)."""
    boxes = [np.empty((tree.nodes, 6, 8)) for tree in ((one,) if one is other else (one, other))]
    for tree, around in zip((one, other), boxes, strict=False):
        refit(tree, x, around)
    return boxes[0], boxes[-1]


@kernel
def refit(tree, x, boxes):
    """Write the boxes (nodes, 6, 8) at x (n, 3); those of nothing are nowhere."""
    boxes[:, :3], boxes[:, 3:] = np.inf, -np.inf
    size, last = len(tree.corners), len(boxes) - (len(tree.corners) + 7) // 8
    for e in range(size):
        enclose(tree.corners, e, x, boxes[last + e // 8], e % 8)
    _lift(boxes)


@inner
def enclose(corners, e, x, boxes, slot):
    """Write the box of a primitive at x, in rows of three or more, to one of eight (6, 8)."""
    low, high = box(corners, e, x)
    for axis in range(3):
        boxes[axis, slot], boxes[3 + axis, slot] = low[axis], high[axis]


@inner
def box(corners, e, x):
    """The least and the largest corner of a primitive's box at x, in rows of three or more."""
    l0, l1, l2, h0, h1, h2 = np.inf, np.inf, np.inf, -np.inf, -np.inf, -np.inf
    for a in range(corners.shape[1]):
        i = corners[e, a]
        l0, l1, l2 = min(l0, x[i, 0]), min(l1, x[i, 1]), min(l2, x[i, 2])
        h0, h1, h2 = max(h0, x[i, 0]), max(h1, x[i, 1]), max(h2, x[i, 2])
    return (l0, l1, l2), (h0, h1, h2)


@kernel
def lift(boxes, many):
    """Write the boxes (nodes, 6, 8) above those of so many things, of which those of the last level are written."""
    last = len(boxes) - (many + 7) // 8
    boxes[:last, :3], boxes[:last, 3:] = np.inf, -np.inf
    for k in range(many, 8 * ((many + 7) // 8)):
        boxes[last + k // 8, :3, k % 8], boxes[last + k // 8, 3:, k % 8] = np.inf, -np.inf
    _lift(boxes)


@inner
def _lift(boxes):
    """The same, with all others nowhere."""
    for node in range(len(boxes) - 1, 0, -1):
        above, slot = boxes[(node - 1) // 8], (node - 1) % 8
        for axis in range(3):
            low, high = np.inf, -np.inf
            for k in range(8):
                low, high = min(low, boxes[node, axis, k]), max(high, boxes[node, 3 + axis, k])
            above[axis, slot], above[3 + axis, slot] = low, high


def apart(one: tuple[int, int], other: tuple[int, int], p: Positions, q: Positions, limits: Limits) -> bool:
    """Whether one box around vertices from a first to a last one, and one around others, tell that nothing comes to its
    limits on the straight way from p to q, (n, 3) both."""
    low, high = np.empty((2, 2, 3)), np.empty((2, 2, 3))
    for k, x in enumerate((p, q)):
        for j, (first, last) in enumerate((one, other)):
            extent(x, first, last, low[k, j], high[k, j])
    begin, end = low.min(axis=0), high.max(axis=0)
    if max(float((begin[0] - end[1]).max()), float((begin[1] - end[0]).max())) > limits.reach:
        return True  # no way leads so near, and what no way leads to bounds no step
    wide = float(np.linalg.norm(high[0].max(axis=0) - low[0].min(axis=0)))
    wide = max(limits.reach, limits.closed + limits.share * wide)
    gap = np.array([low[:, 0] - high[:, 1], low[:, 1] - high[:, 0]])
    return bool((gap > wide).all(axis=1).any())


@kernel
def extent(x, first, last, low, high):
    """Write the least and the largest coordinates (3,) of rows of x (n, 3)."""
    low[:], high[:] = np.inf, -np.inf
    for i in range(first, last):
        for axis in range(3):
            low[axis], high[axis] = min(low[axis], x[i, axis]), max(high[axis], x[i, axis])


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
            for k in range(min(8, len(one.corners) - first_of_eight)):
                left = met(
                    boxes, there, node,
                    (around[0, k], around[1, k], around[2, k]), (around[3, k], around[4, k], around[5, k]),
                    (after[0, k], after[1, k], after[2, k]), (after[3, k], after[4, k], after[5, k]), limits,
                )  # fmt: skip
                if same:
                    left &= -1 << max(0, first_of_eight + k - first + 1)
                while left != 0:
                    f = first + lowest(left)
                    left &= left - 1
                    if count < len(out):  # what shares a vertex is written over: nobody could foretell a branch here
                        out[count, 0], out[count, 1] = first_of_eight + k, f
                    count += not share_vertex(one.corners, first_of_eight + k, other.corners, f)
    return count


@inner
def hull(boxes, many):
    """The least and the largest corner of the first of eight boxes (6, 8)."""
    l0, l1, l2, h0, h1, h2 = np.inf, np.inf, np.inf, -np.inf, -np.inf, -np.inf
    for k in range(many):
        l0, l1, l2 = min(l0, boxes[0, k]), min(l1, boxes[1, k]), min(l2, boxes[2, k])
        h0, h1, h2 = max(h0, boxes[3, k]), max(h1, boxes[4, k]), max(h2, boxes[5, k])
    return (l0, l1, l2), (h0, h1, h2)


@inner
def met(boxes, there, node, low, high, lower, upper, limits):
    """Which boxes of a node may come to their limits with another box, as bits: not those that lie so far apart along
    one axis, on the same side, at the begin and at the end of their ways."""
    at = _NUMBERS * node
    x0, x1, x2 = loaded(boxes, at), loaded(boxes, at + 8), loaded(boxes, at + 16)
    y0, y1, y2 = loaded(boxes, at + 24), loaded(boxes, at + 32), loaded(boxes, at + 40)
    if there is boxes and limits.share == 0.0:  # nothing moves: half the tests say the other half
        near = max(limits.reach, limits.closed)
        return bits((x0 <= high[0] + near) & (y0 >= low[0] - near) & (x1 <= high[1] + near) & (y1 >= low[1] - near)
                    & (x2 <= high[2] + near) & (y2 >= low[2] - near))  # fmt: skip
    s0, s1, s2 = loaded(there, at), loaded(there, at + 8), loaded(there, at + 16)
    t0, t1, t2 = loaded(there, at + 24), loaded(there, at + 32), loaded(there, at + 40)
    # No two points of both are farther apart at the begin than the diagonal of the box around both.
    w0, w1, w2 = _width(x0, y0, low[0], high[0]), _width(x1, y1, low[1], high[1]), _width(x2, y2, low[2], high[2])
    wide = limits.closed + limits.share * root(w0 * w0 + w1 * w1 + w2 * w2)
    wide = where(wide > limits.reach, wide, limits.reach + 0.0 * wide)
    return bits(((x0 <= high[0] + wide) | (s0 <= upper[0] + wide)) & ((y0 >= low[0] - wide) | (t0 >= lower[0] - wide))
        & ((x1 <= high[1] + wide) | (s1 <= upper[1] + wide)) & ((y1 >= low[1] - wide) | (t1 >= lower[1] - wide))
        & ((x2 <= high[2] + wide) | (s2 <= upper[2] + wide)) & ((y2 >= low[2] - wide) | (t2 >= lower[2] - wide))
    )  # fmt: skip


@inner
def _width(x, y, low, high):
    """From the least to the largest of two intervals."""
    return where(y > high, y, high) - where(x < low, x, low)


@inner
def share_vertex(first, e, second, f):
    """Whether two primitives have a vertex in common."""
    shared = False
    for a in range(first.shape[1]):
        for b in range(second.shape[1]):
            shared |= first[e, a] == second[f, b]
    return shared
