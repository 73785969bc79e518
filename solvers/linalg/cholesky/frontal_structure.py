"""Fronts of a multifrontal factorisation of a block matrix, from its symbolic factor."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import cached_njit
from springbench.solvers.linalg.cholesky.block_front import round_up_columns_inner, round_up_rows_inner
from springbench.solvers.linalg.cholesky.symbolic_factorisation import SymbolicFactor


class FrontalStructure(NamedTuple):
    """Structure of a factor with n vertices and s supernodes in postorder.

    Attributes:
        member_start: first member of each supernode, (s + 1,).
        member_vertices: vertices of each supernode's columns, followed by those of the rows below.
        num_columns: number of columns in vertices, (s,).
        parent_position: of each member below, its position among the parent's members.
        parent: (s,), -1 for a root.
        first_child: last child in postorder, -1 for a leaf, (s,).
        next_sibling: previous child of the same parent in postorder, -1 for its first, (s,).
        panel_start: first entry of each panel, (s + 1,).
        block_start: first matrix block of each supernode, (s + 1,).
        block_index: matrix blocks in the order of supernodes, (b,).
        entry_offset: target of each of them in the panels, (b,).
        diagonal_block: diagonal block of each vertex, -1 if it has none, (n,).
        block_size: rows of a block, d.
    """

    member_start: NDArray[np.int64]
    member_vertices: NDArray[np.int64]
    num_columns: NDArray[np.int64]
    parent_position: NDArray[np.int64]
    parent: NDArray[np.int64]
    first_child: NDArray[np.int64]
    next_sibling: NDArray[np.int64]
    panel_start: NDArray[np.int64]
    block_start: NDArray[np.int64]
    block_index: NDArray[np.int64]
    entry_offset: NDArray[np.int64]
    diagonal_block: NDArray[np.int64]
    block_size: int

    @classmethod
    def from_symbolic(
        cls, pointers: NDArray[np.int64], neighbours: NDArray[np.int32], symbolic: SymbolicFactor, block_size: int
    ) -> FrontalStructure:
        """Build the fronts of a symbolic factor, with supernodes renumbered in elimination order.

        Args:
            pointers: row pointers (n + 1,) of the matrix's graph in CSR form.
            neighbours: column indices.
            symbolic: symbolic factor of the graph.
            block_size: rows of a block.
        """
        entries = _place_entries(pointers, neighbours, symbolic, block_size)
        return cls._make([*_list_members(symbolic), *entries, block_size])


@cached_njit()
def _list_members(symbolic):
    """Return the fields from `member_start` to `next_sibling`."""
    first, row_start, order = symbolic.first_slot, symbolic.row_start, symbolic.postorder
    nodes = len(order)
    number = np.empty(nodes, np.int64)
    for k in range(nodes):
        number[order[k]] = k
    start, own, parent = np.zeros(nodes + 1, np.int64), np.empty(nodes, np.int64), np.full(nodes, -1, np.int64)
    for k in range(nodes):
        s = order[k]
        own[k] = symbolic.num_columns[s]
        start[k + 1] = start[k] + own[k] + row_start[s + 1] - row_start[s]
        if symbolic.parent[s] >= 0:
            parent[k] = number[symbolic.parent[s]]
    members = np.empty(start[nodes], np.int64)
    for k in range(nodes):
        s, at = order[k], start[k]
        for i in range(own[k]):
            members[at + i] = symbolic.vertex_of_slot[first[s] + i]
        for i in range(row_start[s + 1] - row_start[s]):
            members[at + own[k] + i] = symbolic.vertex_of_slot[symbolic.rows[row_start[s] + i]]
    within = np.full(len(members), -1, np.int64)
    child, sibling = np.full(nodes, -1, np.int64), np.full(nodes, -1, np.int64)
    for k in range(nodes):
        if parent[k] >= 0:
            sibling[k] = child[parent[k]]
            child[parent[k]] = k
    place = np.empty(len(symbolic.slot_of_vertex), np.int64)
    for k in range(nodes):
        for i in range(start[k], start[k + 1]):
            place[members[i]] = i - start[k]
        c = child[k]
        while c >= 0:
            for i in range(start[c] + own[c], start[c + 1]):
                within[i] = place[members[i]]
            c = sibling[c]
    return start, members, own, within, parent, child, sibling


@cached_njit()
def _place_entries(pointers, neighbours, symbolic, size):
    """Return the fields from `panel_start` to `diagonal_block`.

    A block (v, u), with u not eliminated before v, is stored in the column of v in its supernode's panel, in row u.
    """
    first, row_start, order, slot = symbolic.first_slot, symbolic.row_start, symbolic.postorder, symbolic.slot_of_vertex
    nodes, n = len(order), len(slot)
    panel, begin = np.zeros(nodes + 1, np.int64), np.zeros(nodes + 1, np.int64)
    index, offset = np.empty(len(neighbours), np.int64), np.empty(len(neighbours), np.int64)
    diagonal, row_of = np.full(n, -1, np.int64), np.empty(n, np.int64)
    filled = 0
    for k in range(nodes):
        s = order[k]
        own, below = symbolic.num_columns[s], row_start[s + 1] - row_start[s]
        width = round_up_columns_inner(size * own)
        head = round_up_rows_inner(width)
        stride = head + round_up_rows_inner(size * below)
        for i in range(own):
            row_of[symbolic.vertex_of_slot[first[s] + i]] = size * i
        for i in range(below):
            row_of[symbolic.vertex_of_slot[symbolic.rows[row_start[s] + i]]] = head + size * i
        for i in range(own):
            v = symbolic.vertex_of_slot[first[s] + i]
            for e in range(pointers[v], pointers[v + 1]):
                u = neighbours[e]
                if slot[u] >= slot[v]:
                    index[filled] = e
                    offset[filled] = panel[k] + size * i * stride + row_of[u]
                    filled += 1
                if u == v:
                    diagonal[v] = e
        begin[k + 1] = filled
        panel[k + 1] = panel[k] + width * stride
    return panel, begin, index[:filled].copy(), offset[:filled].copy(), diagonal
