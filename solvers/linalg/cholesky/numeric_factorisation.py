"""Multifrontal Cholesky factorisation (Duff and Reid 1983), which produces the panels used by a solve.

A front is the dense matrix of a supernode's columns and rows. It is stored in strips of four columns, each row by row.
Its columns are eliminated in chunks (`springbench.solvers.linalg.cholesky.panel_factorisation`). The remainder is an
update of its
parent's front, which is pushed on a stack.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import cached_njit, jit_inner, jit_inner_allocating
from springbench.solvers.linalg.cholesky.panel_factorisation import eliminate_chunk, tile_offset
from springbench.solvers.linalg.cholesky.supernode_amalgamation import MAX_PANEL_WIDTH


class SparseRows(NamedTuple):
    """A sparse matrix in compressed rows: pointers (n + 1,), neighbours and values of the entries."""

    pointers: NDArray[np.int64]
    neighbours: NDArray[np.int32]
    values: NDArray[np.float64]


class FactorPanels(NamedTuple):
    """Output of the factorisation: all S and W, and their layout.

    first_chunk (s + 1,) and chunks (c, 7): see `springbench.solvers.linalg.cholesky.supernodal_cholesky.PanelLayout`.
    """

    first_chunk: NDArray[np.int64]
    chunks: NDArray[np.int64]
    inverse_blocks: NDArray[np.float64]
    panels: NDArray[np.float64]


class _FrontalMatrix(NamedTuple):
    """A front, and scratch for a chunk of its columns.

    Attributes:
        entries: strips of four columns.
        slot_row: row of each slot in the front.
        panel: columns of the chunk, then their Cholesky factor, (., MAX_PANEL_WIDTH).
        inverse: L11^-1, (MAX_PANEL_WIDTH, MAX_PANEL_WIDTH).
        tiles: L21, by tiles of four rows.
        row_scratch, block_scratch: one row and four rows, (MAX_PANEL_WIDTH,) and (4 MAX_PANEL_WIDTH,).
        row_numbers: 0, 1, 2, ...
    """

    entries: NDArray[np.float64]
    slot_row: NDArray[np.int64]
    panel: NDArray[np.float64]
    inverse: NDArray[np.float64]
    tiles: NDArray[np.float64]
    row_scratch: NDArray[np.float64]
    block_scratch: NDArray[np.float64]
    row_numbers: NDArray[np.int32]


@cached_njit()
def factorise_supernodes(matrix, symbolic_factor, factor_panels):
    """Factorise a matrix in the postorder of its supernodes.

    Args:
        matrix: sparse matrix.
        symbolic_factor: its symbolic factor.
        factor_panels: output.

    Returns:
        The vertex whose pivot is not positive, or -1.
    """
    child, sibling, largest, room = _plan_update_stack(symbolic_factor)
    first, row_start, rows, vertex = (
        symbolic_factor.first_slot,
        symbolic_factor.row_start,
        symbolic_factor.rows,
        symbolic_factor.vertex_of_slot,
    )
    stack = np.empty(room)
    begun = np.zeros(len(child), np.int64)  # where a supernode's update matrix lies
    front = _FrontalMatrix(
        np.empty(largest * largest),
        np.empty(len(vertex), np.int64),
        np.empty((largest, MAX_PANEL_WIDTH)),
        np.empty((MAX_PANEL_WIDTH, MAX_PANEL_WIDTH)),
        np.empty(largest * MAX_PANEL_WIDTH),
        np.empty(MAX_PANEL_WIDTH),
        np.empty(4 * MAX_PANEL_WIDTH),
        np.arange(largest).astype(np.int32),
    )
    top = 0
    for s in symbolic_factor.postorder:
        own = first[s + 1] - first[s]
        below = row_start[s + 1] - row_start[s]
        size = own + _round_up_to_strips(below)
        _assemble_front(front, matrix, symbolic_factor, s, size)
        c = child[s]
        while c >= 0:
            top = begun[c]  # the last in this list was the first on the stack
            _extend_add(front.entries, size, stack, top, rows, row_start[c], row_start[c + 1], front.slot_row)
            c = sibling[c]
        for k in range(factor_panels.first_chunk[s], factor_panels.first_chunk[s + 1]):
            start = (k - factor_panels.first_chunk[s]) * MAX_PANEL_WIDTH
            bad = eliminate_chunk(
                front, size, start, own, below, vertex[first[s] : first[s + 1]], matrix, factor_panels, k
            )
            if bad >= 0:
                return bad
        begun[s] = top
        top = _push_update(front.entries, size, own, stack, top)
    return -1


@jit_inner_allocating
def _plan_update_stack(symbolic_factor):
    """Plan the stack of update matrices.

    Returns the children of each supernode as linked lists (`child`, `sibling`), the largest front size, and the stack
    size.
    """
    nodes = len(symbolic_factor.parent)
    child = np.full(nodes, -1, np.int64)
    sibling = np.full(nodes, -1, np.int64)
    largest, room, depth = 0, 0, 0
    for s in symbolic_factor.postorder:
        below = _round_up_to_strips(symbolic_factor.row_start[s + 1] - symbolic_factor.row_start[s])
        largest = max(largest, symbolic_factor.first_slot[s + 1] - symbolic_factor.first_slot[s] + below)
        c = child[s]
        while c >= 0:
            depth -= _round_up_to_strips(symbolic_factor.row_start[c + 1] - symbolic_factor.row_start[c]) ** 2
            c = sibling[c]
        depth += below**2
        room = max(room, depth)
        parent = symbolic_factor.parent[s]
        if parent >= 0:
            sibling[s] = child[parent]
            child[parent] = s
    return child, sibling, largest, room


@jit_inner
def _assemble_front(front, matrix, symbolic_factor, s, size):
    """Assemble the matrix entries of a supernode's columns in the front, zero elsewhere; write the rows of slots."""
    entries, place = front.entries, front.slot_row
    first, end = symbolic_factor.first_slot[s], symbolic_factor.first_slot[s + 1]
    row, row_end = symbolic_factor.row_start[s], symbolic_factor.row_start[s + 1]
    entries[: size * size] = 0.0
    for i in range(first, end):
        place[i] = i - first
    for k in range(row_end - row):
        place[symbolic_factor.rows[row + k]] = end - first + k
    for i in range(first, end):
        col = i - first
        v = symbolic_factor.vertex_of_slot[i]
        if v < 0:
            entries[_entry_offset(size, col, col)] = 1.0
            continue
        for e in range(matrix.pointers[v], matrix.pointers[v + 1]):
            j = symbolic_factor.slot_of_vertex[matrix.neighbours[e]]
            if j >= i:
                entries[_entry_offset(size, place[j], col)] += matrix.values[e]


@jit_inner
def _push_update(entries, size, num_columns, stack, top):
    """Push the remainder of a front on the stack; return the new end of the stack."""
    rest = size - num_columns
    for strip in range(rest // 4):
        source = 4 * ((strip + num_columns // 4) * size + num_columns)
        target = top + 4 * strip * rest
        for k in range(16 * strip, 4 * rest):
            stack[target + k] = entries[source + k]
    return top + rest * rest


@jit_inner
def _round_up_to_strips(count):
    """Return the count rounded up to whole strips."""
    return (count + 3) // 4 * 4


@jit_inner
def _entry_offset(size, row, col):
    """Return the offset of an entry in a front."""
    return 4 * ((col >> 2) * size + row) + (col & 3)


@jit_inner
def _extend_add(front, size, stack, begin, rows, start, end, place):
    """Add a child's update matrix to its parent's front."""
    count = end - start
    height = _round_up_to_strips(count)
    for b in range(count):
        source = begin + 4 * (b >> 2) * height + (b & 3)
        col = place[rows[start + b]]
        target = 4 * (col >> 2) * size + (col & 3)
        for a in range(b, count):
            front[target + 4 * place[rows[start + a]]] += stack[source + 4 * a]


@cached_njit()
def preserve_column_sums(panels, rounding, chunks):
    """Add the total rounding error of each column of W to its smallest entry.

    That entry has the smallest rounding error.

    A column contains the weights with which a vertex follows those below. Errors of their sum would separate vertices
    that should move together, against stiff springs. The largest eigenvalue of the preconditioned matrix, 1 without
    rounding, was 1.028 on a sheet of 128 x 128 vertices and grew with their number. With the sums preserved it is
    1.0002 at any size. The smallest entry may be in a row that completes a tile, since that row refers to the last one.

    Args:
        panels: entries of all W, updated.
        rounding: each entry minus its rounded value.
        chunks: layout of the panels (c, 7).
    """
    for k in range(len(chunks)):
        offset, below, width = chunks[k, 1], chunks[k, 4], 4 * chunks[k, 5]
        for j in range(width if below > 0 else 0):
            lost = 0.0
            least = offset + 4 * j
            for r in range(below):
                at = offset + tile_offset(r, j, width)
                lost += rounding[at]
                if abs(panels[at]) < abs(panels[least]):
                    least = at
            panels[least] += lost
