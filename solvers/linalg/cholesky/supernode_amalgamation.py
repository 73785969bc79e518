"""Supernodes: columns of L with a common structure, and groups of supernodes for threads.

Consecutive columns of one structure form a supernode. Relaxed amalgamation (Ashcraft and Grimes 1989) merges a
supernode with its parent if the solve becomes cheaper by a cost model, although explicit zeros are stored then.
"""

from __future__ import annotations

from heapq import heapify, heappop, heappush
from typing import Any

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import cached_njit, jit_inner, jit_inner_allocating

MAX_PANEL_WIDTH = 16
"""Maximum number of columns of a panel."""

COLUMN_LANES = 4
"""Columns of a supernode are padded to a multiple of this number."""

_PANEL_COST, _ROW_COST = 30.0, 3.0
"""Cost of a panel and of a panel row, in units of an entry: both measured, neither critical."""

NUM_SUBTREE_GROUPS = 4
"""Number of groups of subtrees, of about equal cost, that threads can process in parallel."""

_MAX_GROUP_EXCESS = 1.1
"""Cost of a subtree, relative to a group's equal share, up to which it is not split: each split moves a root to the
top, which one thread processes."""

MIN_GROUPED_COST = 3e4
"""Cost of a solve below which a single group is used (a sheet of 28 x 28 vertices). One group is then faster by 1 to 7
% on one thread, and waking a second thread consumes most of its gain: speedup 1.1 at 16 x 16, 1.3 at 20 x 20, 1.6 at
32 x 32."""


@jit_inner
def _solve_cost(width, rows):
    """Return the cost of a supernode in a solve, in units of an entry."""
    total = 0.0
    while width > 0:
        chunk = min(width, MAX_PANEL_WIDTH)
        width -= chunk
        padded = (chunk + COLUMN_LANES - 1) // COLUMN_LANES * COLUMN_LANES
        total += _PANEL_COST + (rows + width) * (padded + _ROW_COST) + chunk * (0.5 * padded + _ROW_COST)
    return total


@cached_njit()
def amalgamate_supernodes(parent, count):
    """Amalgamate supernodes.

    Args:
        parent: elimination tree (n,), -1 for roots.
        count: entries of each column of L (n,).

    Returns:
        The tree of supernodes, the supernode of each column, and the cost of each supernode.
    """
    tree, of_column, width, rows = _find_fundamental_supernodes(parent, count)
    into = _merge_children(tree, width, rows)
    name = np.full(len(tree), -1, np.int32)
    num_supernodes = 0
    for s in range(len(tree)):
        if into[s] == s:
            name[s] = num_supernodes
            num_supernodes += 1
    for s in range(len(tree) - 1, -1, -1):  # a node's name is that of the one it was merged into
        name[s] = name[into[s]]
    merged = np.full(num_supernodes, -1, np.int32)
    cost = np.empty(num_supernodes)
    for s in range(len(tree)):
        if into[s] == s:
            cost[name[s]] = _solve_cost(width[s], rows[s])
            if tree[s] >= 0:
                merged[name[s]] = name[tree[s]]
    for j in range(len(of_column)):
        of_column[j] = name[of_column[j]]
    return merged, of_column, cost


@jit_inner_allocating
def _find_fundamental_supernodes(parent, count):
    """Find columns of one structure.

    The results are the tree of these nodes, the node of each column, and the widths and rows of the nodes.
    """
    n = len(parent)
    of_column = np.empty(n, np.int32)
    nodes = 0
    for j in range(n):
        if j > 0 and parent[j - 1] == j and count[j - 1] == count[j] + 1:
            of_column[j] = nodes - 1
        else:
            of_column[j] = nodes
            nodes += 1
    width = np.zeros(nodes, np.int64)
    rows = np.zeros(nodes, np.int64)
    tree = np.full(nodes, -1, np.int32)
    for j in range(n):
        s = of_column[j]
        width[s] += 1
        rows[s] = count[j] - 1
        tree[s] = of_column[parent[j]] if parent[j] >= 0 else -1
    return tree, of_column, width, rows


@jit_inner_allocating
def _merge_children(tree, width, rows):
    """Return the node that each node is merged into, itself if it remains.

    `width` is updated.
    """
    nodes = len(tree)
    child = np.full(nodes, -1, np.int32)
    sibling = np.full(nodes, -1, np.int32)
    for s in range(nodes - 1, -1, -1):
        if tree[s] >= 0:
            sibling[s] = child[tree[s]]
            child[tree[s]] = s
    into = np.arange(nodes)
    for s in range(nodes):  # children come first, so their merges are complete
        while True:
            best, before = _find_best_merge(s, child, sibling, width, rows)
            if best < 0:
                break
            into[best] = s
            width[s] += width[best]
            if before >= 0:  # remove it from the list of children
                sibling[before] = sibling[best]
            else:
                child[s] = sibling[best]
            c = child[best]
            while c >= 0:  # and add its children to the list
                following = sibling[c]
                sibling[c] = child[s]
                child[s] = c
                c = following
    return into


@jit_inner
def _find_best_merge(s, child, sibling, width, rows):
    """Return the child whose merge gains most, -1 for none, and its predecessor."""
    best, best_gain, before_best, before = -1, 0.0, -1, -1
    c = child[s]
    while c >= 0:
        apart = _solve_cost(width[c], rows[c]) + _solve_cost(width[s], rows[s])
        gain = apart - _solve_cost(width[c] + width[s], rows[s])
        if gain >= best_gain:
            best, best_gain, before_best = c, gain, before
        before = c
        c = sibling[c]
    return best, before_best


def group_subtrees(parent: NDArray[Any], cost: NDArray[np.float64], num_groups: int) -> NDArray[np.int32]:
    """Assign each node of a forest to a group of subtrees, `num_groups` for the top.

    The heaviest subtree is split, with its root assigned to the top, until none exceeds `_MAX_GROUP_EXCESS` times a
    group's share. The lightest group then repeatedly gets the heaviest remaining subtree. The result depends on the
    tree alone, never on threads.

    Args:
        parent: parent of each node, after its children; -1 for roots.
        cost: cost of each node.
        num_groups: number of groups.
    """
    total = cost.copy()
    children: dict[int, list[int]] = {}
    for v, above in enumerate(parent.tolist()):
        children.setdefault(above, []).append(v)
        if above >= 0:
            total[above] += total[v]
    roots = children.get(-1, [])
    whole = float(total[roots].sum())
    top = []
    heap = [(-total[v], v) for v in roots]
    heapify(heap)
    while heap and -heap[0][0] > _MAX_GROUP_EXCESS * whole / num_groups:
        v = heappop(heap)[1]
        top.append(v)
        for c in children.get(v, []):
            heappush(heap, (-total[c], c))
    group = np.full(len(parent), -1, np.int32)
    group[top] = num_groups
    load = np.zeros(num_groups)
    for _, v in sorted(heap):
        lightest = int(np.argmin(load))
        group[v] = lightest
        load[lightest] += total[v]
    for v in range(len(parent) - 1, -1, -1):
        if group[v] < 0:
            group[v] = group[parent[v]]
    return group
