"""Supernodes: which columns of L are kept together, and which supernodes a thread does.

Columns of one structure are a supernode. Relaxed amalgamation (Ashcraft and Grimes 1989): a supernode joins its parent
where the solve gets cheaper by a model of its cost, although zeros are stored then.
"""

from __future__ import annotations

from heapq import heapify, heappop, heappush

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import inner, kept, part

WIDTH = 16
"""The most columns that a panel has."""

LANES = 4
"""Columns of a supernode are padded to a multiple of this."""

_PER_PANEL, _PER_ROW = 30.0, 3.0
"""The cost of a panel and of a row of it, in that of one entry: both measured, neither critical."""

GROUPS = 4
"""Subtrees are gathered into so many groups of about equal cost, which threads can do side by side."""

_WORTH_GROUPS = 3e4
"""Below this cost of a solve (a sheet of 28 x 28 vertices) one group is faster by 1 to 7 % on one thread, and waking a
second one eats up most of what it gains: 1.1 times as fast at 16 x 16, 1.3 at 20 x 20, 1.6 at 32 x 32."""


@inner
def _cost(width, rows):
    """What a supernode costs a solve, in the cost of an entry."""
    total = 0.0
    while width > 0:
        chunk = min(width, WIDTH)
        width -= chunk
        padded = (chunk + LANES - 1) // LANES * LANES
        total += _PER_PANEL + (rows + width) * (padded + _PER_ROW) + chunk * (0.5 * padded + _PER_ROW)
    return total


@kept()
def amalgamate(parent, count):
    """The tree of supernodes after amalgamation, the supernode of each column, and the cost of each supernode."""
    tree, of_column, width, rows = _fundamental(parent, count)
    into = _absorb(tree, width, rows)
    name = np.full(len(tree), -1, np.int32)
    kept = 0
    for s in range(len(tree)):
        if into[s] == s:
            name[s] = kept
            kept += 1
    for s in range(len(tree) - 1, -1, -1):  # a node's name is that of the one it went into
        name[s] = name[into[s]]
    merged = np.full(kept, -1, np.int32)
    cost = np.empty(kept)
    for s in range(len(tree)):
        if into[s] == s:
            cost[name[s]] = _cost(width[s], rows[s])
            if tree[s] >= 0:
                merged[name[s]] = name[tree[s]]
    for j in range(len(of_column)):
        of_column[j] = name[of_column[j]]
    return merged, of_column, cost


@part
def _fundamental(parent, count):
    """Columns of one structure as nodes: their tree, each column's node, and each node's columns and rows below."""
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


@part
def _absorb(tree, width, rows):
    """The node that each goes into, itself where it stays; `width` grows by what a node takes in."""
    nodes = len(tree)
    child = np.full(nodes, -1, np.int32)
    sibling = np.full(nodes, -1, np.int32)
    for s in range(nodes - 1, -1, -1):
        if tree[s] >= 0:
            sibling[s] = child[tree[s]]
            child[tree[s]] = s
    into = np.arange(nodes)
    for s in range(nodes):  # children come first, so theirs are settled
        while True:
            best, before = _gain_most(s, child, sibling, width, rows)
            if best < 0:
                break
            into[best] = s
            width[s] += width[best]
            if before >= 0:  # out of the list of children,
                sibling[before] = sibling[best]
            else:
                child[s] = sibling[best]
            c = child[best]
            while c >= 0:  # and its children into it
                following = sibling[c]
                sibling[c] = child[s]
                child[s] = c
                c = following
    return into


@inner
def _gain_most(s, child, sibling, width, rows):
    """The child that a node had best take in, -1 for none, and the one before it in the list of children."""
    best, best_gain, before_best, before = -1, 0.0, -1, -1
    c = child[s]
    while c >= 0:
        apart = _cost(width[c], rows[c]) + _cost(width[s], rows[s])
        gain = apart - _cost(width[c] + width[s], rows[s])
        if gain >= best_gain:
            best, best_gain, before_best = c, gain, before
        before = c
        c = sibling[c]
    return best, before_best


def groups(parent: NDArray[np.int32], cost: NDArray[np.float64]) -> NDArray[np.int32]:
    """The group of each node of a forest: whole subtrees, and GROUPS for the top; parents come after children.

    The heaviest subtree is opened, its root put in the top, until none has more than a group's share; the lightest
    group then takes the heaviest subtree that is left. It follows from the tree alone, never from threads.
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
    if whole < _WORTH_GROUPS:
        return np.zeros(len(parent), np.int32)
    heap = [(-total[v], v) for v in roots]
    heapify(heap)
    while heap and -heap[0][0] > 1.1 * whole / GROUPS:
        v = heappop(heap)[1]
        top.append(v)
        for c in children.get(v, []):
            heappush(heap, (-total[c], c))
    group = np.full(len(parent), -1, np.int32)
    group[top] = GROUPS
    load = np.zeros(GROUPS)
    for _, v in sorted(heap):
        lightest = int(np.argmin(load))
        group[v] = lightest
        load[lightest] += total[v]
    for v in range(len(parent) - 1, -1, -1):
        if group[v] < 0:
            group[v] = group[parent[v]]
    return group
