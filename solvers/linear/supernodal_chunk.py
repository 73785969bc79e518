"""Elimination of a chunk of columns from a front, and its panel (see `numeric_factorisation`).

    S = L11^-T L11^-1       the inverse of the chunk's Schur complement
    W = -L21 L11^-1         contributions of its unknowns to the rows below

with the chunk's Cholesky factor [L11; L21]. For springs S and W are sums of terms of one sign (Q is an M-matrix), so
that the inversion loses no digits. The remaining front, minus L21 L21', is computed strip by strip by the same product
as a forward substitution.
"""

from __future__ import annotations

import numpy as np

from solvers.compiling import inner
from solvers.vectors.supernodal import add_forward

_NO_DIGITS = 4.0 * np.finfo(np.float64).eps
"""Pivots below this fraction of the matrix entry are round-off."""


@inner
def in_tile(row, col, width):
    """Return the offset of an entry in a panel of tiles of four rows, stored by columns."""
    return (row >> 2) * 4 * width + 4 * col + (row & 3)


@inner
def eliminate(front, size, start, own, below, vertex, matrix, into, k):
    """Eliminate chunk k from a front, and write its panel.

    Args:
        front: frontal matrix and scratch.
        size: number of rows of the front.
        start: first column of the chunk.
        own: columns of the supernode.
        below: rows below the supernode.
        vertex: vertices of the columns (own,).
        matrix: sparse matrix, for the scale of the pivots.
        into: output.
        k: index of the chunk.

    Returns:
        The vertex whose pivot is not positive, or -1.
    """
    square, at, real, width = into.chunks[k, 0], into.chunks[k, 1], into.chunks[k, 3], 4 * into.chunks[k, 5]
    panel, count = front.panel, size - start
    for strip in range(width // 4):
        source = 4 * ((start // 4 + strip) * size + start)
        for r in range(count):
            for c in range(4):
                panel[r, 4 * strip + c] = front.entries[source + 4 * r + c]
    bad = _cholesky(panel, width, vertex[start:], matrix)
    if bad >= 0:
        return bad
    _invert(panel, width, front.inverse)
    _write_square(front.inverse, real, width, into.squares, square)
    _divide(front, width, count)
    _write_panel(front, width, start, own, below, vertex, into.panels, at)
    _subtract(front, size, start, width)
    return -1


@inner
def _cholesky(panel, width, vertex, matrix):
    """Compute L11 in place; return the vertex whose pivot is not positive, or -1."""
    for j in range(width):
        pivot = panel[j, j]
        v = vertex[j]
        scale = 0.0
        if v >= 0:
            for e in range(matrix.pointers[v], matrix.pointers[v + 1]):
                if matrix.neighbours[e] == v:
                    scale += matrix.values[e]
        if not pivot > _NO_DIGITS * scale:
            return v
        root = np.sqrt(pivot)
        panel[j, j] = root
        for i in range(j + 1, width):
            panel[i, j] /= root
        for k in range(j + 1, width):
            for i in range(k, width):
                panel[i, k] -= panel[i, j] * panel[k, j]
    return -1


@inner
def _invert(panel, width, inverse):
    """Compute L11^-1, column by column."""
    for j in range(width):
        for i in range(width):
            inverse[i, j] = 0.0
        inverse[j, j] = 1.0 / panel[j, j]
        for i in range(j + 1, width):
            total = 0.0
            for k in range(j, i):
                total -= panel[i, k] * inverse[k, j]
            inverse[i, j] = total / panel[i, i]


@inner
def _write_square(inverse, real, width, squares, begin):
    """Compute S = L11^-T L11^-1."""
    for i in range(real):
        for j in range(real):
            total = 0.0
            for k in range(max(i, j), real):
                total += inverse[k, i] * inverse[k, j]
            squares[begin + in_tile(i, j, width)] = total


@inner
def _divide(front, width, count):
    """Compute L21 = A21 L11^-T into `tiles`."""
    panel, inverse, row = front.panel, front.inverse, front.row
    for r in range(width, count):
        for j in range(width):
            row[j] = 0.0
        for k in range(width):
            factor = panel[r, k]
            for j in range(width):
                row[j] += factor * inverse[j, k]
        for j in range(width):
            front.tiles[in_tile(r, j, width)] = row[j]


@inner
def _write_panel(front, width, start, own, below, vertex, panels, begin):
    """Compute W = -L21 L11^-1, for the rows that are vertices."""
    tiles, inverse, row = front.tiles, front.inverse, front.row
    done = 0
    for local in range(start + width, own + below):
        if local < own and vertex[local] < 0:
            continue
        for j in range(width):
            row[j] = 0.0
        for k in range(width):
            factor = tiles[in_tile(local - start, k, width)]
            for j in range(width):
                row[j] -= factor * inverse[k, j]
        for j in range(width):
            panels[begin + in_tile(done, j, width)] = row[j]
        done += 1


@inner
def _subtract(front, size, start, width):
    """Subtract L21 L21' from the front, strip by strip, by the product of a forward substitution."""
    tiles, index, entries = front.tiles, front.numbers, front.entries
    flat = front.block
    for strip in range((start + width) // 4, size // 4):
        r = 4 * strip - start
        for c in range(4):
            for j in range(width):
                flat[4 * j + c] = -tiles[in_tile(r + c, j, width)]
        begin = strip * size + 4 * strip
        count = size - 4 * strip
        if width == 16:
            add_forward(tiles, r * width, index, 0, count, flat, 0, entries, begin, 4, 4)
        elif width == 12:
            add_forward(tiles, r * width, index, 0, count, flat, 0, entries, begin, 4, 3)
        elif width == 8:
            add_forward(tiles, r * width, index, 0, count, flat, 0, entries, begin, 4, 2)
        else:
            add_forward(tiles, r * width, index, 0, count, flat, 0, entries, begin, 4, 1)
