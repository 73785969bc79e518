"""The panels of a solve by multiplications, from the panels of L.

    S = L11^-T L11^-1       the inverse of a chunk's Schur complement
    W = -L21 L11^-1         contributions of its unknowns to the rows below

with the chunk's Cholesky factor [L11; L21]. For springs S and W are sums of terms of one sign (Q is an M-matrix), so
that the inversion loses no digits.
"""

from __future__ import annotations

import numpy as np
from springbench.solvers.jit.kernel_compilation import cached_njit, jit_inner
from springbench.solvers.linalg.cholesky.block_front import round_up_columns_inner, round_up_rows_inner
from springbench.solvers.linalg.cholesky.supernode_amalgamation import MAX_PANEL_WIDTH


@jit_inner
def tile_offset(row, col, width):
    """Return the offset of an entry in a panel.

    A panel has tiles of four rows, stored by columns.

    Args:
        row, col: position of the entry in the panel.
        width: number of columns of the panel.
    """
    return (row >> 2) * 4 * width + 4 * col + (row & 3)


@cached_njit()
def write_inverse_panels(fronts, factor, postorder, first_chunk, chunks, squares, panels):
    """Write S and W of all chunks.

    Args:
        fronts: fronts of L, for numbers.
        factor: panels of L.
        postorder: supernode of each front (s,).
        first_chunk: first chunk of each supernode (s + 1,).
        chunks: offsets and sizes of each chunk (c, 7), as in `PanelLayout`.
        squares, panels: entries of all S and all W, initially zero.
    """
    inverse, row = np.zeros((MAX_PANEL_WIDTH, MAX_PANEL_WIDTH)), np.empty((MAX_PANEL_WIDTH, 4))
    for k in range(len(postorder)):
        own = fronts.num_columns[k]
        below = fronts.member_start[k + 1] - fronts.member_start[k] - own
        head = round_up_rows_inner(round_up_columns_inner(own))
        stride = head + round_up_rows_inner(below)
        for chunk in range(first_chunk[postorder[k]], first_chunk[postorder[k] + 1]):
            start = (chunk - first_chunk[postorder[k]]) * MAX_PANEL_WIDTH
            real, width = chunks[chunk, 3], 4 * chunks[chunk, 5]
            at = fronts.panel_start[k] + start * stride
            _invert_triangle(factor, at + start, stride, real, inverse)
            _write_inverse_block(inverse, real, width, squares, chunks[chunk, 0])
            done = own - start - real
            _write_rows(factor, at + start + real, stride, done, inverse, real, width, panels, chunks[chunk, 1], 0, row)
            _write_rows(factor, at + head, stride, below, inverse, real, width, panels, chunks[chunk, 1], done, row)


@jit_inner
def _invert_triangle(factor, at, stride, width, inverse):
    """Compute L11^-1, column by column; the diagonal of L has inverses."""
    for j in range(width):
        inverse[j, j] = factor[at + j * stride + j]
        for i in range(j + 1, width):
            total = 0.0
            for k in range(j, i):
                total -= factor[at + k * stride + i] * inverse[k, j]
            inverse[i, j] = total * factor[at + i * stride + i]


@jit_inner
def _write_inverse_block(inverse, real, width, squares, begin):
    """Compute S = L11^-T L11^-1."""
    for i in range(real):
        for j in range(i, real):
            total = 0.0
            for k in range(j, real):
                total += inverse[k, i] * inverse[k, j]
            squares[begin + tile_offset(i, j, width)] = total
            squares[begin + tile_offset(j, i, width)] = total


@jit_inner
def _write_rows(factor, at, stride, count, inverse, real, width, panels, begin, done, row):
    """Compute rows of W = -L21 L11^-1, four at a time; `done` rows precede them."""
    for first in range(0, count, 4):
        for k in range(real):
            for r in range(4):
                row[k, r] = factor[at + first + k * stride + r]
        rows = min(4, count - first)
        for j in range(real):
            a, b, c, d = 0.0, 0.0, 0.0, 0.0
            for k in range(j, real):
                by = inverse[k, j]
                a -= row[k, 0] * by
                b -= row[k, 1] * by
                c -= row[k, 2] * by
                d -= row[k, 3] * by
            panels[begin + tile_offset(done + first, j, width)] = a
            if rows > 1:
                panels[begin + tile_offset(done + first + 1, j, width)] = b
            if rows > 2:
                panels[begin + tile_offset(done + first + 2, j, width)] = c
            if rows > 3:
                panels[begin + tile_offset(done + first + 3, j, width)] = d


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
