"""Elimination of a chunk of columns from a front, and its panel (see `numeric_factorisation`).

    S = L11^-T L11^-1       the inverse of the chunk's Schur complement
    W = -L21 L11^-1         contributions of its unknowns to the rows below

with the chunk's Cholesky factor [L11; L21]. For springs S and W are sums of terms of one sign (Q is an M-matrix), so
that the inversion loses no digits. The remaining front, minus L21 L21', is computed strip by strip by the same product
as a forward substitution.
"""

from __future__ import annotations

import numpy as np
from springbench.solvers.jit.kernel_compilation import jit_inner
from springbench.solvers.simd.panel_products import add_panel_product

_PIVOT_ROUNDOFF = 4.0 * np.finfo(np.float64).eps
"""Pivots below this fraction of the matrix entry are round-off."""


@jit_inner
def tile_offset(row, col, width):
    """Return the offset of an entry in a panel of tiles of four rows, stored by columns."""
    return (row >> 2) * 4 * width + 4 * col + (row & 3)


@jit_inner
def eliminate_chunk(front, size, start, num_columns, below, vertex, matrix, factor_panels, k):
    """Eliminate chunk k from a front, and write its panel.

    Args:
        front: frontal matrix and scratch.
        size: number of rows of the front.
        start: first column of the chunk.
        num_columns: columns of the supernode.
        below: rows below the supernode.
        vertex: vertices of the columns (num_columns,).
        matrix: sparse matrix, for the scale of the pivots.
        factor_panels: output.
        k: index of the chunk.

    Returns:
        The vertex whose pivot is not positive, or -1.
    """
    square, at, real, width = (
        factor_panels.chunks[k, 0],
        factor_panels.chunks[k, 1],
        factor_panels.chunks[k, 3],
        4 * factor_panels.chunks[k, 5],
    )
    panel, count = front.panel, size - start
    for strip in range(width // 4):
        source = 4 * ((start // 4 + strip) * size + start)
        for r in range(count):
            for c in range(4):
                panel[r, 4 * strip + c] = front.entries[source + 4 * r + c]
    bad = _factorise_diagonal_block(panel, width, vertex[start:], matrix)
    if bad >= 0:
        return bad
    _invert_triangle(panel, width, front.inverse)
    _write_inverse_block(front.inverse, real, width, factor_panels.inverse_blocks, square)
    _solve_below_diagonal(front, width, count)
    _write_panel(front, width, start, num_columns, below, vertex, factor_panels.panels, at)
    _subtract_outer_product(front, size, start, width)
    return -1


@jit_inner
def _factorise_diagonal_block(panel, width, vertex, matrix):
    """Compute L11 in place; return the vertex whose pivot is not positive, or -1."""
    for j in range(width):
        pivot = panel[j, j]
        v = vertex[j]
        scale = 0.0
        if v >= 0:
            for e in range(matrix.pointers[v], matrix.pointers[v + 1]):
                if matrix.neighbours[e] == v:
                    scale += matrix.values[e]
        if not pivot > _PIVOT_ROUNDOFF * scale:
            return v
        root = np.sqrt(pivot)
        panel[j, j] = root
        for i in range(j + 1, width):
            panel[i, j] /= root
        for k in range(j + 1, width):
            for i in range(k, width):
                panel[i, k] -= panel[i, j] * panel[k, j]
    return -1


@jit_inner
def _invert_triangle(panel, width, inverse):
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


@jit_inner
def _write_inverse_block(inverse, real, width, squares, begin):
    """Compute S = L11^-T L11^-1."""
    for i in range(real):
        for j in range(real):
            total = 0.0
            for k in range(max(i, j), real):
                total += inverse[k, i] * inverse[k, j]
            squares[begin + tile_offset(i, j, width)] = total


@jit_inner
def _solve_below_diagonal(front, width, count):
    """Compute L21 = A21 L11^-T into `tiles`."""
    panel, inverse, row = front.panel, front.inverse, front.row_scratch
    for r in range(width, count):
        for j in range(width):
            row[j] = 0.0
        for k in range(width):
            factor = panel[r, k]
            for j in range(width):
                row[j] += factor * inverse[j, k]
        for j in range(width):
            front.tiles[tile_offset(r, j, width)] = row[j]


@jit_inner
def _write_panel(front, width, start, num_columns, below, vertex, panels, begin):
    """Compute W = -L21 L11^-1, for the rows that are vertices."""
    tiles, inverse, row = front.tiles, front.inverse, front.row_scratch
    done = 0
    for local in range(start + width, num_columns + below):
        if local < num_columns and vertex[local] < 0:
            continue
        for j in range(width):
            row[j] = 0.0
        for k in range(width):
            factor = tiles[tile_offset(local - start, k, width)]
            for j in range(width):
                row[j] -= factor * inverse[k, j]
        for j in range(width):
            panels[begin + tile_offset(done, j, width)] = row[j]
        done += 1


@jit_inner
def _subtract_outer_product(front, size, start, width):
    """Subtract L21 L21' from the front, strip by strip, by the product of a forward substitution."""
    tiles, index, entries = front.tiles, front.row_numbers, front.entries
    flat = front.block_scratch
    for strip in range((start + width) // 4, size // 4):
        r = 4 * strip - start
        for c in range(4):
            for j in range(width):
                flat[4 * j + c] = -tiles[tile_offset(r + c, j, width)]
        begin = strip * size + 4 * strip
        count = size - 4 * strip
        if width == 16:
            add_panel_product(tiles, r * width, index, 0, count, flat, 0, entries, begin, 4, 4)
        elif width == 12:
            add_panel_product(tiles, r * width, index, 0, count, flat, 0, entries, begin, 4, 3)
        elif width == 8:
            add_panel_product(tiles, r * width, index, 0, count, flat, 0, entries, begin, 4, 2)
        else:
            add_panel_product(tiles, r * width, index, 0, count, flat, 0, entries, begin, 4, 1)
