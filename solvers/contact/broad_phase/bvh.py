"""Broad phase: bounding volume hierarchies (BVH) over points, edges or triangles.

A tree is built once and refitted in each query. A node has eight boxes, tested at once in vector registers
(`springbench.solvers.simd.float64x8`). Primitives are numbered along a Morton curve through the rest shape, so that
eight consecutive ones form a patch of the surface however it folds. The tree is implicit: the child of box b of node k
is node 8 k + 1 + b. Eight primitives traverse the other tree together and are separated at its leaves. Candidates are
ordered by these packets, by the leaves, and by primitives. The order depends on nothing else, so that sums over a
superset of the active pairs are bitwise identical.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from springbench.solvers.contact.geometry.aabb import (
    CollisionQuery,
    FloatArray,
    IndexArray,
    componentwise_max,
    componentwise_min,
    extract_aabb,
    has_common_vertex,
    merge_aabbs,
    overlap_mask,
    primitive_aabbs,
    store_aabbs,
)
from springbench.solvers.jit.kernel_compilation import jit_kernel
from springbench.solvers.model.step_problem import Positions
from springbench.solvers.simd.float64x8 import lowest_set_bit

_MORTON_BITS = 10
_STACK_SIZE = 8 * 22
"""Stack entries: eight per level, for more levels than any tree in memory has."""
_CANDIDATES_PER_PRIMITIVE = 24
"""Initial capacity per primitive for candidate pairs; if it is exceeded, the query is repeated. Four touching layers
need about 14."""


class BVH(NamedTuple):
    """Implicit tree of eight-box nodes.

    Attributes:
        primitives: vertices of each primitive in Morton order, (m, k).
        num_levels: number of levels, including the root.
        mean_primitive_size: mean diagonal of the primitives at rest [m].
    """

    primitives: IndexArray
    num_levels: int
    mean_primitive_size: float = 0.0

    @classmethod
    def from_primitives(cls, rest: Positions, corners: IndexArray) -> BVH:
        """Build a tree over the primitives of a rest shape.

        Args:
            rest: rest shape (n, 3) [m].
            corners: vertices of each primitive (m, k), in any order.
        """
        order, size = morton_order(rest[corners].mean(axis=1)), 0.0
        if len(corners):
            size = float(np.linalg.norm(np.ptp(rest[corners], axis=1), axis=1).mean())
        return cls.from_count(len(corners))._replace(
            primitives=np.ascontiguousarray(corners[order]), mean_primitive_size=size
        )

    @classmethod
    def from_count(cls, num_primitives: int) -> BVH:
        """Build a tree over items that are in Morton order already."""
        levels = 1
        while 8**levels < num_primitives:
            levels += 1
        return cls(np.arange(num_primitives)[:, None], levels)

    @property
    def num_nodes(self) -> int:
        """Number of nodes; the last level ends with the last primitive."""
        return _first_node_of_level(self.num_levels - 1) + max(1, -(-len(self.primitives) // 8))


def _first_node_of_level(level: int) -> int:
    """Return the index of a level's first node."""
    return (8**level - 1) // 7


def morton_order(x: Positions) -> IndexArray:
    """Return the order of points (m, 3) [m] along a Morton curve."""
    if not len(x):
        return np.empty(0, np.int64)
    size = float(np.ptp(x, axis=0).max()) or 1.0
    cell = np.minimum((x - x.min(axis=0)) / size * 2**_MORTON_BITS, 2**_MORTON_BITS - 1).astype(np.int64)
    code = np.zeros(len(x), np.int64)
    for bit in range(_MORTON_BITS):
        for axis in range(3):
            code |= ((cell[:, axis] >> bit) & 1) << (3 * bit + axis)
    return np.argsort(code, kind="stable")


def find_candidate_pairs(one: BVH, other: BVH, x: FloatArray, y: FloatArray, query: CollisionQuery) -> IndexArray:
    """Return the pairs of two trees that may violate the limits on a linear motion.

    Pairs that share a vertex are excluded. If vertices move relative to each other by less than the primitive size,
    boxes around the whole motion are as tight as separate start and end boxes, and take half the time.

    Args:
        one, other: the trees; if both are the same, each pair is found once, the lower index first.
        x: start positions (n, 4) [m]; column 3 is padding.
        y: end positions (n, 4) [m]; column 3 is padding.
        query: limits of the distances.

    Returns:
        Primitive indices (k, 2).
    """
    if not (len(one.primitives) and len(other.primitives)):
        return np.empty((0, 2), np.int64)
    if query.max_displacement <= max(one.mean_primitive_size, other.mean_primitive_size):
        begin = end = _build_node_aabbs(one, other, x, y)
    else:
        begin, end = _build_node_aabbs(one, other, x, x), _build_node_aabbs(one, other, y, y)
    room, traversal_stack = _CANDIDATES_PER_PRIMITIVE * len(one.primitives) + 64, allocate_traversal_stack()
    while True:
        out = np.empty((room, 2), np.int64)
        count = traverse_trees(one, other, begin, end, query, one is other, traversal_stack, out)
        if count <= room:
            return out[:count]
        room = count


def allocate_traversal_stack() -> IndexArray:
    """Allocate the scratch of a traversal."""
    return np.empty((_STACK_SIZE, 3), np.int64)


def _build_node_aabbs(one: BVH, other: BVH, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Build the boxes of both trees around the linear motion from x to y."""
    boxes = [np.empty((tree.num_nodes, 6, 8)) for tree in ((one,) if one is other else (one, other))]
    for tree, around in zip((one, other), boxes, strict=False):
        refit_aabbs(tree, x, y, around)
    return boxes[0], boxes[-1]


@jit_kernel
def refit_aabbs(tree, x, y, boxes):
    """Refit the boxes of a tree to a linear motion.

    Args:
        tree: the tree.
        x: start positions (n, 4) [m].
        y: end positions (n, 4) [m].
        boxes: boxes (nodes, 6, 8) [m], overwritten; unused lanes get empty boxes at infinity.
    """
    many = len(tree.primitives)
    leaf = len(boxes) - (many + 7) // 8
    for first in range(0, many, 8):
        low, high = primitive_aabbs(tree.primitives, first, many - 1, x)
        if x is not y:
            lower, upper = primitive_aabbs(tree.primitives, first, many - 1, y)
            low, high = componentwise_min(low, lower), componentwise_max(high, upper)
        store_aabbs(low, high, boxes, leaf + first // 8)
    propagate_bounds(boxes, many)


@jit_kernel
def propagate_bounds(boxes, num_primitives):
    """Compute the boxes of all inner nodes from those of the last level.

    Args:
        boxes: boxes (nodes, 6, 8) [m], updated; unused lanes of the last level get empty boxes at infinity.
        num_primitives: number of boxes of the last level.
    """
    last = len(boxes) - (num_primitives + 7) // 8
    boxes[:last, :3], boxes[:last, 3:] = np.inf, -np.inf
    for k in range(num_primitives, 8 * ((num_primitives + 7) // 8)):
        boxes[last + k // 8, :3, k % 8], boxes[last + k // 8, 3:, k % 8] = np.inf, -np.inf
    for node in range(len(boxes) - 1, 0, -1):
        above, slot = boxes[(node - 1) // 8], (node - 1) % 8
        for axis in range(3):
            low, high = np.inf, -np.inf
            for k in range(8):
                low, high = min(low, boxes[node, axis, k]), max(high, boxes[node, 3 + axis, k])
            above[axis, slot], above[3 + axis, slot] = low, high


@jit_kernel
def traverse_trees(one, other, begin, end, query, is_same_tree, stack, out):
    """Write the pairs of two trees that may violate the limits, and return their number.

    Args:
        one, other: the trees.
        begin, end: boxes of both trees at the start and at the end of the motion.
        query: limits of the distances.
        is_same_tree: whether both trees are the same; each pair is then found once.
        stack: scratch, (s, 3).
        out: primitive indices (k, 2); pairs beyond its capacity are counted only.
    """
    (mine, boxes), (yours, there) = begin, end
    count, leaf = 0, len(mine) - (len(one.primitives) + 7) // 8
    for first_of_eight in range(0, len(one.primitives), 8):
        around, after = mine[leaf + first_of_eight // 8], yours[leaf + first_of_eight // 8]
        low, high = merge_aabbs(around, 8)
        lower, upper = merge_aabbs(after, 8)
        # Stack entries: a node, its first primitive, and the number of primitives in each of its boxes.
        stack[0, 0], stack[0, 1], stack[0, 2], top = 0, 0, 8 ** (other.num_levels - 1), 1
        while top > 0:
            top -= 1
            node, first, each = stack[top, 0], stack[top, 1], stack[top, 2]
            if each > 1:
                left = overlap_mask(boxes, there, node, low, high, lower, upper, query)
                if is_same_tree:
                    left &= -1 << max(0, (first_of_eight - first) // each)  # skip boxes before these eight primitives
                for slot in range(7, -1, -1):  # the first one is popped first
                    if left >> slot & 1:
                        stack[top, 0], stack[top, 1], stack[top, 2] = (
                            8 * node + 1 + slot,
                            first + slot * each,
                            each // 8,
                        )
                        top += 1
                continue
            above, slot, own = max(0, node - 1) // 8, (node - 1) % 8, 255
            if node > 0:  # select those of the eight that come near the box around this node
                own = overlap_mask(
                    mine, yours, leaf + first_of_eight // 8,
                    *extract_aabb(boxes[above], slot), *extract_aabb(there[above], slot), query,
                )  # fmt: skip
            while own != 0:
                k = lowest_set_bit(own)
                own &= own - 1
                left = overlap_mask(boxes, there, node, *extract_aabb(around, k), *extract_aabb(after, k), query)
                if is_same_tree:
                    left &= -1 << max(0, first_of_eight + k - first + 1)
                while left != 0:
                    f = first + lowest_set_bit(left)
                    left &= left - 1
                    # Pairs with a common vertex are overwritten by the next pair: a branch would be mispredicted.
                    if count < len(out):
                        out[count, 0], out[count, 1] = first_of_eight + k, f
                    count += not has_common_vertex(one.primitives, first_of_eight + k, other.primitives, f)
    return count
