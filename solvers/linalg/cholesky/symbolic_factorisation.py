"""Symbolic Cholesky factorisation: the structure of the factor, from the graph of the matrix alone.

Elimination tree and column counts (Liu 1990; Davis 2006, chapter 4), and the rows of each supernode.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import cached_njit
from springbench.solvers.linalg.cholesky.nested_dissection import nested_dissection_order
from springbench.solvers.linalg.cholesky.supernode_amalgamation import (
    COLUMN_LANES,
    MIN_GROUPED_COST,
    NUM_SUBTREE_GROUPS,
    amalgamate_supernodes,
    group_subtrees,
)


class SymbolicFactor(NamedTuple):
    """Structure of L over slots, the positions in the work vector.

    Slots are padded so that each supernode starts at a multiple of COLUMN_LANES.

    Supernodes are numbered group by group, followed by those above all groups, the top; children precede parents.

    Attributes:
        slot_of_vertex: (n,).
        vertex_of_slot: -1 for padding, (slots,).
        parent: parent of each supernode, -1 for a root, (s,).
        first_slot: first slot of each supernode, (s + 1,).
        num_columns: columns of each supernode without padding, (s,).
        row_start: first entry of each supernode in `rows`, (s + 1,).
        rows: sorted slots of the rows below each supernode.
        postorder: the supernodes in a postorder of their tree, (s,).
        group_start: first supernode of each group and of the top, (NUM_SUBTREE_GROUPS + 2,).
        nonzeros: entries of L before amalgamation, including the diagonal.
    """

    slot_of_vertex: NDArray[np.int32]
    vertex_of_slot: NDArray[np.int32]
    parent: NDArray[np.int32]
    first_slot: NDArray[np.int32]
    num_columns: NDArray[np.int32]
    row_start: NDArray[np.int64]
    rows: NDArray[np.int32]
    postorder: NDArray[np.int32]
    group_start: NDArray[np.int64]
    nonzeros: int


_AnalysisCache = list[tuple[NDArray[np.int64], NDArray[np.int32], SymbolicFactor]]

_analysis_cache: ContextVar[_AnalysisCache | None] = ContextVar("analysis_cache", default=None)


@contextmanager
def cache_symbolic_analysis() -> Iterator[None]:
    """Within this context, `analyse_graph` analyses each graph once, however many matrices share it."""
    token = _analysis_cache.set([])
    try:
        yield
    finally:
        _analysis_cache.reset(token)


def analyse_graph(pointers: NDArray[np.int64], neighbours: NDArray[np.int32]) -> SymbolicFactor:
    """Analyse a graph with the nested dissection order; the result must not be modified.

    Args:
        pointers: row pointers (n + 1,) of the graph in CSR form.
        neighbours: column indices.
    """
    known = _analysis_cache.get()
    for p, n, found in known or ():
        if np.array_equal(p, pointers) and np.array_equal(n, neighbours):
            return found
    found = analyse_with_order(pointers, neighbours, nested_dissection_order(pointers, neighbours))
    if known is not None:
        known.append((pointers, neighbours, found))
    return found


def analyse_with_order(
    pointers: NDArray[np.int64], neighbours: NDArray[np.int32], order: NDArray[np.int32]
) -> SymbolicFactor:
    """Analyse a graph with a given elimination order, up to a postorder of its tree.

    Args:
        pointers: row pointers (n + 1,) of the graph in CSR form.
        neighbours: column indices.
        order: vertices in the order of elimination (n,).
    """
    place = _invert_permutation(order)
    post = _compute_postorder(_build_elimination_tree(pointers, neighbours, order, place))
    order = order[post]
    place = _invert_permutation(order)
    parent = _build_elimination_tree(pointers, neighbours, order, place)
    count = _count_column_entries(pointers, neighbours, order, place, parent)
    tree, of_column, cost = amalgamate_supernodes(parent, count)

    post = _compute_postorder(tree)
    groups = NUM_SUBTREE_GROUPS if cost.sum() >= MIN_GROUPED_COST else 1
    group = group_subtrees(tree, cost, groups)
    by_number = post[np.argsort(group[post], kind="stable")]
    number = _invert_permutation(by_number)
    upper = tree[by_number]
    node_parent = np.where(upper < 0, np.int32(-1), number[upper])
    group_start = np.searchsorted(group[by_number], np.arange(NUM_SUBTREE_GROUPS + 2))

    node = number[of_column]
    column = np.argsort(node, kind="stable")  # within a node the order of the columns is unchanged
    width = np.bincount(node, minlength=len(tree)).astype(np.int32)
    first = np.zeros(len(tree) + 1, np.int32)
    np.cumsum((width + COLUMN_LANES - 1) // COLUMN_LANES * COLUMN_LANES, out=first[1:])
    start = np.cumsum(width) - width
    slots = (np.arange(len(order)) + np.repeat(first[:-1] - start, width)).astype(np.int32)
    vertex = np.full(first[-1], -1, np.int32)
    slot = np.empty(len(order), np.int32)
    vertex[slots] = order[column]
    slot[order[column]] = slots
    node_of_slot = np.repeat(np.arange(len(tree), dtype=np.int32), np.diff(first))
    row_start, rows = _find_supernode_rows(pointers, neighbours, slot, vertex, node_parent, node_of_slot, len(tree))
    return SymbolicFactor(
        slot, vertex, node_parent, first, width, row_start, rows, number[post], group_start, int(count.sum())
    )  # fmt: skip


def _invert_permutation(order: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return the inverse of a permutation."""
    place = np.empty(len(order), np.int32)
    place[order] = np.arange(len(order), dtype=np.int32)
    return place


@cached_njit()
def _build_elimination_tree(pointers, neighbours, order, place):
    """Return the parent of each column, -1 for a root (Davis 2006, section 4.1)."""
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


@cached_njit()
def _compute_postorder(parent):
    """Return the nodes of a forest in postorder, with children in ascending order."""
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


@cached_njit()
def _count_column_entries(pointers, neighbours, order, place, parent):
    """Return the number of entries of each column of L, with its diagonal.

    Row i has an entry in each column on the paths in the tree from its entries in the matrix to i.
    """
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


@cached_njit()
def _find_supernode_rows(pointers, neighbours, slot, vertex, parent, node_of_slot, nodes):
    """Return the rows below each supernode, by slot.

    Row i belongs to the supernodes on the paths in the tree from its entries in the matrix to its own supernode.
    """
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
        for s in range(nodes, 0, -1):  # from counts, or from ends, to starts
            start[s] = start[s - 1]
        start[0] = 0
        if fill == 0:
            for s in range(nodes):
                start[s + 1] += start[s]
            rows = np.empty(start[nodes], np.int32)
    return start, rows
