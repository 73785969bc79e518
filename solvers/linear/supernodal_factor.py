"""Multifrontal Cholesky factorisation (Duff and Reid 1983), which produces the panels used by a solve.

A front is the dense matrix of a supernode's columns and rows. It is stored in strips of four columns, each row by row.
Its columns are eliminated in chunks (`solvers.linear.supernodal_chunk`). The remainder is an update of its
parent's front, which is pushed on a stack.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import inner, kept, part
from solvers.linear.supernodal_chunk import eliminate, in_tile
from solvers.linear.supernodes import WIDTH


class Matrix(NamedTuple):
    """A sparse matrix in compressed rows: pointers (n + 1,), neighbours and values of the entries."""

    pointers: NDArray[np.int64]
    neighbours: NDArray[np.int32]
    values: NDArray[np.float64]


class Panels(NamedTuple):
    """Output of the factorisation: all S and W, and their layout.

    chunk_of (s + 1,) and chunks (c, 7): see `solvers.linear.supernodal.Layout`.
    """

    chunk_of: NDArray[np.int64]
    chunks: NDArray[np.int64]
    squares: NDArray[np.float64]
    panels: NDArray[np.float64]


class _Front(NamedTuple):
    """A front, and scratch for a chunk of its columns.

    Attributes:
        entries: strips of four columns.
        place: row of each slot in the front.
        panel: columns of the chunk, then their Cholesky factor, (., WIDTH).
        inverse: L11^-1, (WIDTH, WIDTH).
        tiles: L21, by tiles of four rows.
        row, block: one row and four rows, (WIDTH,) and (4 WIDTH,).
        numbers: 0, 1, 2, ...
    """

    entries: NDArray[np.float64]
    place: NDArray[np.int64]
    panel: NDArray[np.float64]
    inverse: NDArray[np.float64]
    tiles: NDArray[np.float64]
    row: NDArray[np.float64]
    block: NDArray[np.float64]
    numbers: NDArray[np.int32]


@kept()
def factorise(matrix, structure, into):
    """Factorise a matrix in the postorder of its supernodes.

    Args:
        matrix: sparse matrix.
        structure: its symbolic factor.
        into: output.

    Returns:
        The vertex whose pivot is not positive, or -1.
    """
    child, sibling, largest, room = _plan(structure)
    first, row_start, rows, vertex = structure.first, structure.row_start, structure.rows, structure.vertex
    stack = np.empty(room)
    begun = np.zeros(len(child), np.int64)  # where a supernode's update matrix lies
    front = _Front(
        np.empty(largest * largest),
        np.empty(len(vertex), np.int64),
        np.empty((largest, WIDTH)),
        np.empty((WIDTH, WIDTH)),
        np.empty(largest * WIDTH),
        np.empty(WIDTH),
        np.empty(4 * WIDTH),
        np.arange(largest).astype(np.int32),
    )
    top = 0
    for s in structure.sequence:
        own = first[s + 1] - first[s]
        below = row_start[s + 1] - row_start[s]
        size = own + _padded(below)
        _assemble(front, matrix, structure, s, size)
        c = child[s]
        while c >= 0:
            top = begun[c]  # the last in this list was the first on the stack
            _extend_add(front.entries, size, stack, top, rows, row_start[c], row_start[c + 1], front.place)
            c = sibling[c]
        for k in range(into.chunk_of[s], into.chunk_of[s + 1]):
            start = (k - into.chunk_of[s]) * WIDTH
            bad = eliminate(front, size, start, own, below, vertex[first[s] : first[s + 1]], matrix, into, k)
            if bad >= 0:
                return bad
        begun[s] = top
        top = _push(front.entries, size, own, stack, top)
    return -1


@part
def _plan(structure):
    """Plan the stack of update matrices.

    Returns the children of each supernode as linked lists (`child`, `sibling`), the largest front size, and the stack
    size.
    """
    nodes = len(structure.parent)
    child = np.full(nodes, -1, np.int64)
    sibling = np.full(nodes, -1, np.int64)
    largest, room, depth = 0, 0, 0
    for s in structure.sequence:
        below = _padded(structure.row_start[s + 1] - structure.row_start[s])
        largest = max(largest, structure.first[s + 1] - structure.first[s] + below)
        c = child[s]
        while c >= 0:
            depth -= _padded(structure.row_start[c + 1] - structure.row_start[c]) ** 2
            c = sibling[c]
        depth += below**2
        room = max(room, depth)
        parent = structure.parent[s]
        if parent >= 0:
            sibling[s] = child[parent]
            child[parent] = s
    return child, sibling, largest, room


@inner
def _assemble(front, matrix, structure, s, size):
    """Assemble the matrix entries of a supernode's columns in the front, zero elsewhere; write the rows of slots."""
    entries, place = front.entries, front.place
    first, end = structure.first[s], structure.first[s + 1]
    row, row_end = structure.row_start[s], structure.row_start[s + 1]
    entries[: size * size] = 0.0
    for i in range(first, end):
        place[i] = i - first
    for k in range(row_end - row):
        place[structure.rows[row + k]] = end - first + k
    for i in range(first, end):
        col = i - first
        v = structure.vertex[i]
        if v < 0:
            entries[_at(size, col, col)] = 1.0
            continue
        for e in range(matrix.pointers[v], matrix.pointers[v + 1]):
            j = structure.slot[matrix.neighbours[e]]
            if j >= i:
                entries[_at(size, place[j], col)] += matrix.values[e]


@inner
def _push(entries, size, own, stack, top):
    """Push the remainder of a front on the stack; return the new end of the stack."""
    rest = size - own
    for strip in range(rest // 4):
        source = 4 * ((strip + own // 4) * size + own)
        target = top + 4 * strip * rest
        for k in range(16 * strip, 4 * rest):
            stack[target + k] = entries[source + k]
    return top + rest * rest


@inner
def _padded(count):
    """Return the count rounded up to whole strips."""
    return (count + 3) // 4 * 4


@inner
def _at(size, row, col):
    """Return the offset of an entry in a front."""
    return 4 * ((col >> 2) * size + row) + (col & 3)


@inner
def _extend_add(front, size, stack, begin, rows, start, end, place):
    """Add a child's update matrix to its parent's front."""
    count = end - start
    height = _padded(count)
    for b in range(count):
        source = begin + 4 * (b >> 2) * height + (b & 3)
        col = place[rows[start + b]]
        target = 4 * (col >> 2) * size + (col & 3)
        for a in range(b, count):
            front[target + 4 * place[rows[start + a]]] += stack[source + 4 * a]


@kept()
def keep_sums(panels, rounding, chunks):
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
                at = offset + in_tile(r, j, width)
                lost += rounding[at]
                if abs(panels[at]) < abs(panels[least]):
                    least = at
            panels[least] += lost
