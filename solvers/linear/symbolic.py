"""What the factor of a sparse symmetric matrix will look like, found from its graph alone.

Elimination tree and column counts (Liu 1990; Davis 2006, chapter 4), supernodes (columns of one structure) and their
relaxed amalgamation (Ashcraft and Grimes 1989): a supernode joins its parent where the solve gets cheaper, by a
model of its cost, although zeros are stored then.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

WIDTH = 16
"""The most columns that a panel has."""

LANES = 4
"""Columns of a supernode are padded to a multiple of this."""

_PER_PANEL, _PER_ROW = 60.0, 3.0
"""The cost of a panel and of a row of it, in that of one entry: both measured, neither critical."""


class Symbolic(NamedTuple):
    """The structure of L, over slots: the places of the work vector, padded so that each supernode begins at a lane.

    slot: the slot of each vertex (n,); vertex: the vertex of each slot, -1 for padding (slots,);
    parent: each supernode's in the tree, -1 for a root (s,); first: its first slot (s + 1,);
    width: its columns that are not padding (s,); row_start (s + 1,), rows: the slots of its rows below, sorted;
    nonzeros: those of L before amalgamation, diagonal included. Supernodes are in postorder.
    """

    slot: NDArray[np.int32]
    vertex: NDArray[np.int32]
    parent: NDArray[np.int32]
    first: NDArray[np.int32]
    width: NDArray[np.int32]
    row_start: NDArray[np.int64]
    rows: NDArray[np.int32]
    nonzeros: int


def analyse(pointers: NDArray[np.int32], neighbours: NDArray[np.int32], order: NDArray[np.int32]) -> Symbolic:
    """The structure of the factor when vertices are eliminated in `order` (n,), up to a postorder of its tree."""
    place = np.empty(len(order), np.int32)
    place[order] = np.arange(len(order), dtype=np.int32)
    parent = _elimination_tree(pointers, neighbours, order, place)
    post = _postorder(parent)
    order = order[post]
    place[order] = np.arange(len(order), dtype=np.int32)
    parent = _elimination_tree(pointers, neighbours, order, place)
    count = _column_counts(pointers, neighbours, order, place, parent)
    tree, of_column = _amalgamate(parent, count)
    post = _postorder(tree)
    place_of_node = np.empty(len(post), np.int32)
    place_of_node[post] = np.arange(len(post), dtype=np.int32)
    node = place_of_node[of_column]
    upper = tree[post]
    node_parent = np.where(upper < 0, np.int32(-1), place_of_node[upper])
    column = np.argsort(node, kind="stable")  # within a node the columns keep their order
    width = np.bincount(node, minlength=len(post)).astype(np.int32)
    first = np.zeros(len(post) + 1, np.int32)
    np.cumsum((width + LANES - 1) // LANES * LANES, out=first[1:])
    vertex = np.full(first[-1], -1, np.int32)
    slot = np.empty(len(order), np.int32)
    start = np.cumsum(width) - width
    slots = (np.arange(len(order)) + np.repeat(first[:-1] - start, width)).astype(np.int32)
    vertex[slots] = order[column]
    slot[order[column]] = slots
    node_of_slot = np.repeat(np.arange(len(post), dtype=np.int32), np.diff(first))
    row_start, rows = _structure(pointers, neighbours, slot, vertex, node_parent, node_of_slot, len(post))
    return Symbolic(slot, vertex, node_parent, first, width, row_start, rows, int(count.sum()))


@njit(cache=True)
def _elimination_tree(pointers, neighbours, order, place):
    """The parent of each column, -1 for a root (Davis 2006, section 4.1)."""
    n = len(order)
    parent = np.full(n, -1, np.int32)
    ancestor = np.full(n, -1, np.int32)
    for i in range(n):
        v = order[i]
        for e in range(pointers[v], pointers[v + 1]):
            j = place[neighbours[e]]
            while j != -1 and j < i:
                above = ancestor[j]
                ancestor[j] = i
                if above == -1:
                    parent[j] = i
                j = above
    return parent


@njit(cache=True)
def _postorder(parent):
    """The nodes of a forest, children before parents, each subtree together; children in ascending order."""
    n = len(parent)
    child = np.full(n, -1, np.int32)
    sibling = np.full(n, -1, np.int32)
    for v in range(n - 1, -1, -1):
        if parent[v] >= 0:
            sibling[v] = child[parent[v]]
            child[parent[v]] = v
    post = np.empty(n, np.int32)
    at = 0
    for root in range(n):
        if parent[root] >= 0:
            continue
        v = np.int32(root)
        while True:
            while child[v] >= 0:  # down to a leaf
                below = child[v]
                child[v] = sibling[below]
                v = below
            post[at] = v
            at += 1
            v = parent[v]
            if v < 0:
                break
    return post


@njit(cache=True)
def _column_counts(pointers, neighbours, order, place, parent):
    """The entries of each column of L, diagonal included: row i has those on the paths from its entries up to i."""
    n = len(order)
    count = np.ones(n, np.int64)
    mark = np.full(n, -1, np.int32)
    for i in range(n):
        mark[i] = i
        v = order[i]
        for e in range(pointers[v], pointers[v + 1]):
            j = place[neighbours[e]]
            while j < i and mark[j] != i:
                count[j] += 1
                mark[j] = i
                j = parent[j]
    return count


@njit(cache=True)
def _cost(width, rows):
    """What a supernode costs a solve, in the cost of an entry."""
    total = 0.0
    while width > 0:
        chunk = min(width, WIDTH)
        width -= chunk
        padded = (chunk + LANES - 1) // LANES * LANES
        total += _PER_PANEL + (rows + width) * (padded + _PER_ROW) + chunk * (0.5 * padded + _PER_ROW)
    return total


@njit(cache=True)
def _amalgamate(parent, count):
    """The tree of supernodes after amalgamation, and the supernode of each column."""
    n = len(parent)
    of_column = np.empty(n, np.int32)
    nodes = 0
    for j in range(n):  # columns with one structure
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

    child = np.full(nodes, -1, np.int32)
    sibling = np.full(nodes, -1, np.int32)
    for s in range(nodes - 1, -1, -1):
        if tree[s] >= 0:
            sibling[s] = child[tree[s]]
            child[tree[s]] = s
    into = np.arange(nodes)
    for s in range(nodes):  # children come first, so theirs are settled
        while True:
            best, best_gain, before_best, before = -1, 0.0, -1, -1
            c = child[s]
            while c >= 0:
                apart = _cost(width[c], rows[c]) + _cost(width[s], rows[s])
                gain = apart - _cost(width[c] + width[s], rows[s])
                if gain >= best_gain:
                    best, best_gain, before_best = c, gain, before
                before = c
                c = sibling[c]
            if best < 0:
                break
            into[best] = s
            width[s] += width[best]
            if before_best >= 0:  # out of the list of children,
                sibling[before_best] = sibling[best]
            else:
                child[s] = sibling[best]
            c = child[best]
            while c >= 0:  # and its children into it
                following = sibling[c]
                sibling[c] = child[s]
                child[s] = c
                c = following
    name = np.full(nodes, -1, np.int32)
    kept = 0
    for s in range(nodes):
        if into[s] == s:
            name[s] = kept
            kept += 1
    for s in range(nodes - 1, -1, -1):  # a node's name is that of the one it went into
        name[s] = name[into[s]]
    merged = np.full(kept, -1, np.int32)
    for s in range(nodes):
        if into[s] == s and tree[s] >= 0:
            merged[name[s]] = name[tree[s]]
    for j in range(n):
        of_column[j] = name[of_column[j]]
    return merged, of_column


@njit(cache=True)
def _structure(pointers, neighbours, slot, vertex, parent, node_of_slot, nodes):
    """The rows below each supernode, by slot: row i belongs to those on the paths from its entries up to i's own."""
    start = np.zeros(nodes + 1, np.int64)
    rows = np.empty(0, np.int32)
    for fill in range(2):
        mark = np.full(nodes, -1, np.int32)
        for i in range(len(vertex)):
            v = vertex[i]
            if v < 0:
                continue
            own = node_of_slot[i]
            for e in range(pointers[v], pointers[v + 1]):
                s = node_of_slot[slot[neighbours[e]]]
                while s < own and mark[s] != i:
                    mark[s] = i
                    if fill:
                        rows[start[s]] = i
                    start[s] += 1
                    s = parent[s]
        for s in range(nodes, 0, -1):  # counts, or ends, to beginnings
            start[s] = start[s - 1]
        start[0] = 0
        if fill == 0:
            for s in range(nodes):
                start[s + 1] += start[s]
            rows = np.empty(start[nodes], np.int32)
    return start, rows
