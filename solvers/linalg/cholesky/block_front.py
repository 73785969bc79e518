"""Partial factorisation of a frontal matrix: elimination of its columns, and the remaining update.

    L_JJ L_JJ' = F_JJ,   L_BJ = F_BJ L_JJ^-T,   update: F_BB - L_BJ L_BJ'

Columns are processed from left to right, one tile at a time. The product of the columns to the left is subtracted, then
the tile is divided by its own triangle. Blocks of PANEL_DEPTH columns and ROW_BLOCK_HEIGHT rows let the factors of the
products stay in cache. The products of an entry are subtracted in the order of columns, whatever these two sizes are.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import ONE, ZERO, jit_inner
from springbench.solvers.simd.front_tiles import (
    TILE_COLUMNS,
    TILE_ROWS,
    factorise_tile,
    solve_tile_triangle,
    subtract_tile_product,
)

PANEL_DEPTH, ROW_BLOCK_HEIGHT = 192, 128
"""Columns and rows of a panel that are multiplied together: whole tiles and whole vectors, 192 KiB."""

_MIN_PART_HEIGHT = 32
"""Least height of the row blocks of parts that threads share: four vectors."""

_PIVOT_ROUNDOFF = 4.0 * np.finfo(np.float64).eps
"""Pivots below this fraction of the matrix entry are round-off."""


class DenseFront(NamedTuple):
    """Frontal matrix of a supernode.

    Attributes:
        num_columns: number of columns in vertices.
        width: columns of the panel, in whole tiles.
        below_offset: offset of the rows below in a panel column.
        stride: entries from one panel column to the next.
        panels: memory of the panels.
        panel_offset: first entry of the panel.
        update_buffer: memory of the parent's update.
        update_offset: first entry of the update.
        update_stride: entries from one update column to the next.
    """

    num_columns: int
    width: int
    below_offset: int
    stride: int
    panels: NDArray[np.float64]
    panel_offset: int
    update_buffer: NDArray[np.float64]
    update_offset: int
    update_stride: int


def round_up_rows(rows: Any) -> Any:
    """Return the number of rows, rounded up to whole vectors."""
    return (rows + TILE_ROWS - 1) // TILE_ROWS * TILE_ROWS


def round_up_columns(columns: Any) -> Any:
    """Return the number of columns, rounded up to tiles of three and six."""
    return (columns + 2) // 3 * 3


round_up_rows_inner = jit_inner(round_up_rows)
round_up_columns_inner = jit_inner(round_up_columns)


@jit_inner
def clear_lower_triangle(matrix, start, stride, first, end):
    """Set the lower triangle of columns to zero, in whole tiles.

    Args:
        matrix: memory of the matrix.
        start: its first entry.
        stride: entries from one column to the next.
        first, end: range of the columns.
    """
    for j in range(first, end):
        column = start + j * stride
        matrix[column + j // TILE_COLUMNS * TILE_COLUMNS // TILE_ROWS * TILE_ROWS : column + stride] = 0.0


@jit_inner
def eliminate_front(fronts, supernode, values, to, min_pivots, triangles):
    """Factorise the panel of a supernode.

    Args:
        fronts: structure of the factor.
        supernode: index of the supernode.
        values: matrix blocks (b, d, d), for the scale of the pivots.
        to: front of the supernode, whose panel is updated.
        min_pivots, triangles: scratch.

    Returns:
        First vertex with a pivot that is not positive, or -1.
    """
    for first in range(0, to.width, PANEL_DEPTH):
        failed = factorise_diagonal_block(fronts, supernode, values, to, first, min_pivots, triangles)
        if failed >= 0:
            return failed
        eliminate_rows_below(to, first, triangles, ZERO, ONE)
        subtract_panel_product(to, first, ZERO, ONE)
    return -1


@jit_inner
def factorise_diagonal_block(fronts, supernode, values, to, first, min_pivots, triangles):
    """Factorise the rows of a panel block, at column `first`, that contain its diagonal.

    Args:
        fronts: structure of the factor.
        supernode: index of the supernode.
        values: matrix blocks (b, d, d), for the scale of the pivots.
        to: front of the supernode.
        first: first column of the block.
        min_pivots: scratch.
        triangles: factors of the tiles, output.

    Returns:
        First vertex with a pivot that is not positive, or -1.
    """
    start, size = fronts.member_start[supernode], fronts.block_size
    end, left = _block_end(to, first), to.panel_offset + first * to.stride
    for tile in range(first, end, TILE_COLUMNS):
        columns, triangle = min(TILE_COLUMNS, end - tile), triangles[(tile - first) // TILE_COLUMNS]
        above = tile // TILE_ROWS * TILE_ROWS
        column, strips = to.panel_offset + tile * to.stride, (_diagonal_end(to, end) - above) // TILE_ROWS
        _subtract_tile(
            to.panels,
            left,
            above,
            tile,
            to.stride,
            tile - first,
            to.panels,
            column + above,
            to.stride,
            strips,
            ZERO,
            columns,
        )
        for j in range(columns):
            min_pivots[j] = 0.0  # columns that complete a tile are those of the identity
            if tile + j < size * to.num_columns:
                v = fronts.member_vertices[start + (tile + j) // size]
                c = (tile + j) % size
                min_pivots[j] = max(0.0, _PIVOT_ROUNDOFF * values[fronts.diagonal_block[v], c, c])
        if columns == 6:
            positive = factorise_tile(to.panels, column + tile, to.stride, min_pivots, triangle, 6)
        else:
            positive = factorise_tile(to.panels, column + tile, to.stride, min_pivots, triangle, 3)
        if not positive:
            j = _failed_column(triangle, min_pivots, columns)
            return fronts.member_vertices[start + (tile + j) // size]
        _solve_tile(to, column + above, triangle, strips, columns)
        for j in range(columns):
            to.panels[column + j * to.stride + tile + j] = triangle[j, j]
    return -1


@jit_inner
def _failed_column(triangle, min_pivots, columns):
    """Return the first column of a tile whose pivot is too small.

    The diagonal of `triangle` contains the inverse square roots of the pivots.
    """
    for j in range(columns):
        if not min_pivots[j] * triangle[j, j] * triangle[j, j] < 1.0:
            return j
    return columns - 1


@jit_inner
def eliminate_rows_below(to, first, triangles, part, parts):
    """Eliminate one of several parts of the rows below the diagonal of a panel block.

    Args:
        to: front of a supernode.
        first: first column of the block.
        triangles: factors of its tiles.
        part: which part.
        parts: number of parts.
    """
    end, left = _block_end(to, first), to.panel_offset + first * to.stride
    begin = _diagonal_end(to, end)
    height = _part_height(to.stride - begin, parts)
    for row in range(begin + part * height, to.stride, parts * height):
        strips = (min(row + height, to.stride) - row) // TILE_ROWS
        for tile in range(first, end, TILE_COLUMNS):
            columns, column = min(TILE_COLUMNS, end - tile), to.panel_offset + tile * to.stride
            _subtract_tile(
                to.panels,
                left,
                row,
                tile,
                to.stride,
                tile - first,
                to.panels,
                column + row,
                to.stride,
                strips,
                ZERO,
                columns,
            )
            _solve_tile(to, column + row, triangles[(tile - first) // TILE_COLUMNS], strips, columns)


@jit_inner
def subtract_panel_product(to, first, part, parts):
    """Subtract the product of a panel block from the columns to its right.

    Args:
        to: front of a supernode, whose panel is updated.
        first: first column of the block.
        part, parts: which part of the rows is processed, and number of parts.
    """
    end, left = _block_end(to, first), to.panel_offset + first * to.stride
    _subtract_lower_product(
        to.panels,
        left,
        to.stride,
        end - first,
        ZERO,
        to.panels,
        to.panel_offset,
        to.stride,
        end,
        to.width,
        part,
        parts,
        ZERO,
    )


@jit_inner
def subtract_front_update(to, columns, part, parts, overwrite):
    """Subtract the product of a panel's rows below from the update.

    Args:
        to: front of a supernode, whose update is changed.
        columns: number of columns of the update without its right-hand side, in whole tiles.
        part, parts: which part of the rows is processed, and number of parts.
        overwrite: 1 if the update is not yet defined and counts as zero, else 0.
    """
    for first in range(0, to.width, PANEL_DEPTH):
        left, depth = to.panel_offset + first * to.stride, _block_end(to, first) - first
        _subtract_lower_product(
            to.panels,
            left,
            to.stride,
            depth,
            to.below_offset,
            to.update_buffer,
            to.update_offset,
            to.update_stride,
            ZERO,
            columns,
            part,
            parts,
            overwrite if first == 0 else ZERO,
        )


@jit_inner
def _block_end(to, first):
    """Return the end of the panel block that begins at a column."""
    return min(first + PANEL_DEPTH, to.width)


@jit_inner
def _diagonal_end(to, end):
    """Return the end of the rows that contain the diagonal of a panel block."""
    return min(round_up_rows_inner(end), to.stride)


@jit_inner
def _part_height(rows, parts):
    """Return the height of the row blocks into which rows are divided for several parts."""
    if parts == 1:
        return ROW_BLOCK_HEIGHT
    return min(ROW_BLOCK_HEIGHT, max(_MIN_PART_HEIGHT, round_up_rows_inner(rows // (2 * parts))))


@jit_inner
def _solve_tile(to, at, triangle, strips, columns):
    """Call `solve_tile_triangle` for six or three columns."""
    if columns == 6:
        solve_tile_triangle(to.panels, at, to.stride, triangle, strips, 6)
    else:
        solve_tile_triangle(to.panels, at, to.stride, triangle, strips, 3)


@jit_inner
def _subtract_lower_product(panels, left, stride, depth, head, target, to, size, first, end, part, parts, overwrite):
    """Subtract the lower triangle of L L' from columns of a matrix.

    L: columns of the panel; head: offset of the rows that are multiplied; first, end: range of the matrix columns;
    overwrite: whether the matrix counts as zero.
    """
    begin = first // TILE_ROWS * TILE_ROWS
    height = _part_height(size - begin, parts)
    for row in range(begin + part * height, size, parts * height):
        stop = min(row + height, size)
        for tile in range(first, min(end, stop), TILE_COLUMNS):
            above = max(row, tile // TILE_ROWS * TILE_ROWS)
            place, strips = to + tile * size + above, (stop - above) // TILE_ROWS
            _subtract_tile(
                panels,
                left + head,
                above,
                tile,
                stride,
                depth,
                target,
                place,
                size,
                strips,
                overwrite,
                min(TILE_COLUMNS, end - tile),
            )


@jit_inner
def _subtract_tile(panels, left, row, top, stride, depth, target, to, size, strips, overwrite, columns):
    """Call `subtract_tile_product` for six or three columns."""
    if columns == 6:
        subtract_tile_product(panels, left + row, left + top, stride, depth, target, to, size, strips, overwrite, 6)
    else:
        subtract_tile_product(panels, left + row, left + top, stride, depth, target, to, size, strips, overwrite, 3)
