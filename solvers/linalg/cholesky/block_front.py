"""Partial factorisation of a frontal matrix: elimination of its columns, and the remaining update.

    L_JJ L_JJ' = F_JJ,   L_BJ = F_BJ L_JJ^-T,   update: F_BB - L_BJ L_BJ'

Columns are processed from left to right, one tile at a time. The product of the columns to the left is subtracted, then
the tile is divided by its own triangle. Blocks of PANEL_DEPTH columns and ROW_BLOCK_HEIGHT rows keep the factors of the
products in cache. The products of an entry are subtracted in the order of columns, whatever these two sizes are.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import jit_inner
from springbench.solvers.simd.front_tiles import (
    TILE_COLUMNS,
    TILE_ROWS,
    factorise_tile,
    solve_tile_triangle,
    subtract_tile_product,
)

PANEL_DEPTH, ROW_BLOCK_HEIGHT = 192, 128
"""Columns and rows of a panel that are multiplied together: whole tiles and whole vectors, 192 KiB."""

_PIVOT_ROUNDOFF = 4.0 * np.finfo(np.float64).eps
"""Pivots below this fraction of the matrix entry are round-off."""


class DenseFront(NamedTuple):
    """Frontal matrix of a supernode.

    Attributes:
        num_columns: number of columns in vertices.
        below_offset: offset of the rows below in a panel column.
        stride: entries from one panel column to the next.
        panels: memory of the panels.
        panel_offset: first entry of the panel.
        update_buffer: memory of the parent's update.
        update_offset: first entry of the update.
        update_stride: entries from one update column to the next.
    """

    num_columns: int
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


round_up_rows_inner = jit_inner(round_up_rows)


@jit_inner
def eliminate_front(fronts, supernode, values, panels, stride, min_pivots, triangles):
    """Factorise the panel of a supernode; return False if a pivot is not positive.

    Args:
        fronts: structure of the factor.
        supernode: index of the supernode.
        values: matrix blocks (b, 3, 3), for the scale of the pivots.
        panels: panels, updated.
        stride: entries from one panel column to the next.
        min_pivots, triangles: scratch.
    """
    base, width = fronts.panel_start[supernode], 3 * fronts.num_columns[supernode]
    for first in range(0, width, PANEL_DEPTH):
        end = min(first + PANEL_DEPTH, width)
        left = base + first * stride
        row, stop = (
            first,
            min(round_up_rows_inner(end), stride),
        )  # the triangle of these columns, and then the rows below
        while row < stride:
            for tile in range(first, end, TILE_COLUMNS):
                columns, triangle = min(TILE_COLUMNS, end - tile), triangles[(tile - first) // TILE_COLUMNS]
                above = max(row, tile // TILE_ROWS * TILE_ROWS)
                column, strips = base + tile * stride, (stop - above) // TILE_ROWS
                _subtract_tile(
                    panels, left, above, tile, stride, tile - first, panels, column + above, stride, strips, columns
                )
                if row == first:
                    corner = column + tile
                    for j in range(columns):
                        v = fronts.member_vertices[fronts.member_start[supernode] + (tile + j) // 3]
                        min_pivots[j] = _PIVOT_ROUNDOFF * values[fronts.diagonal_block[v], j % 3, j % 3]
                    if columns == 6:
                        positive = factorise_tile(panels, corner, stride, min_pivots, triangle, 6)
                    else:
                        positive = factorise_tile(panels, corner, stride, min_pivots, triangle, 3)
                    if not positive:
                        return False
                if columns == 6:
                    solve_tile_triangle(panels, column + above, stride, triangle, strips, 6)
                else:
                    solve_tile_triangle(panels, column + above, stride, triangle, strips, 3)
                if row == first:
                    for j in range(columns):
                        panels[column + j * stride + tile + j] = triangle[j, j]
            row, stop = stop, min(stop + ROW_BLOCK_HEIGHT, stride)
        _subtract_lower_product(panels, left, stride, end - first, 0, panels, base, stride, end, width)
    return True


@jit_inner
def subtract_front_update(to, columns):
    """Subtract the product of a panel's rows below from the update."""
    for first in range(0, 3 * to.num_columns, PANEL_DEPTH):
        left, depth = to.panel_offset + first * to.stride, min(PANEL_DEPTH, 3 * to.num_columns - first)
        _subtract_lower_product(
            to.panels,
            left,
            to.stride,
            depth,
            to.below_offset,
            to.update_buffer,
            to.update_offset,
            to.update_stride,
            0,
            columns,
        )


@jit_inner
def _subtract_lower_product(panels, left, stride, depth, head, target, to, size, first, end):
    """Subtract the lower triangle of the product of panel columns with themselves from columns of a matrix.

    head: offset of the rows that are multiplied; first, end: range of the matrix columns.
    """
    for row in range(first // TILE_ROWS * TILE_ROWS, size, ROW_BLOCK_HEIGHT):
        stop = min(row + ROW_BLOCK_HEIGHT, size)
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
                min(TILE_COLUMNS, end - tile),
            )


@jit_inner
def _subtract_tile(panels, left, row, top, stride, depth, target, to, size, strips, columns):
    """Call `subtract_tile_product` for six or three columns."""
    if columns == 6:
        subtract_tile_product(panels, left + row, left + top, stride, depth, target, to, size, strips, 6)
    else:
        subtract_tile_product(panels, left + row, left + top, stride, depth, target, to, size, strips, 3)
