"""Partial factorisation of a frontal matrix: elimination of its columns, and the remaining update.

    L_JJ L_JJ' = F_JJ,   L_BJ = F_BJ L_JJ^-T,   update: F_BB - L_BJ L_BJ'

Columns are processed from left to right, one tile at a time. The product of the columns to the left is subtracted, then
the tile is divided by its own triangle. Blocks of DEPTH columns and HEIGHT rows keep the factors of the
products in cache. The products of an entry are subtracted in the order of columns, whatever these two sizes are.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import inner
from solvers.vectors.block import ROWS, TILE, divide, factorise_corner, subtract_product

DEPTH, HEIGHT = 192, 128
"""Columns and rows of a panel that are multiplied together: whole tiles and whole vectors, 192 KiB."""

_NO_DIGITS = 4.0 * np.finfo(np.float64).eps
"""Pivots below this fraction of the matrix entry are round-off."""


class Dense(NamedTuple):
    """Frontal matrix of a supernode.

    Attributes:
        own: number of columns in vertices.
        head: offset of the rows below in a panel column.
        stride: entries from one panel column to the next.
        panels: memory of the panels.
        base: first entry of the panel.
        update: memory of the parent's update.
        begin: first entry of the update.
        size: entries from one update column to the next.
    """

    own: int
    head: int
    stride: int
    panels: NDArray[np.float64]
    base: int
    update: NDArray[np.float64]
    begin: int
    size: int


def whole(rows: Any) -> Any:
    """Return the number of rows, rounded up to whole vectors."""
    return (rows + ROWS - 1) // ROWS * ROWS


rows_of = inner(whole)


@inner
def eliminate(fronts, s, values, panels, stride, least, triangles):
    """Factorise the panel of a supernode; return False if a pivot is not positive.

    Args:
        fronts: structure of the factor.
        s: index of the supernode.
        values: matrix blocks (b, 3, 3), for the scale of the pivots.
        panels: panels, updated.
        stride: entries from one panel column to the next.
        least, triangles: scratch.
    """
    base, width = fronts.panel[s], 3 * fronts.own[s]
    for first in range(0, width, DEPTH):
        end = min(first + DEPTH, width)
        left = base + first * stride
        row, stop = first, min(rows_of(end), stride)  # the triangle of these columns, and then the rows below
        while row < stride:
            for tile in range(first, end, TILE):
                columns, triangle = min(TILE, end - tile), triangles[(tile - first) // TILE]
                above = max(row, tile // ROWS * ROWS)
                column, strips = base + tile * stride, (stop - above) // ROWS
                _subtract(
                    panels, left, above, tile, stride, tile - first, panels, column + above, stride, strips, columns
                )
                if row == first:
                    corner = column + tile
                    for j in range(columns):
                        v = fronts.members[fronts.start[s] + (tile + j) // 3]
                        least[j] = _NO_DIGITS * values[fronts.diagonal[v], j % 3, j % 3]
                    if columns == 6:
                        positive = factorise_corner(panels, corner, stride, least, triangle, 6)
                    else:
                        positive = factorise_corner(panels, corner, stride, least, triangle, 3)
                    if not positive:
                        return False
                if columns == 6:
                    divide(panels, column + above, stride, triangle, strips, 6)
                else:
                    divide(panels, column + above, stride, triangle, strips, 3)
                if row == first:
                    for j in range(columns):
                        panels[column + j * stride + tile + j] = triangle[j, j]
            row, stop = stop, min(stop + HEIGHT, stride)
        _product(panels, left, stride, end - first, 0, panels, base, stride, end, width)
    return True


@inner
def update(to, columns):
    """Subtract the product of a panel's rows below from the update."""
    for first in range(0, 3 * to.own, DEPTH):
        left, depth = to.base + first * to.stride, min(DEPTH, 3 * to.own - first)
        _product(to.panels, left, to.stride, depth, to.head, to.update, to.begin, to.size, 0, columns)


@inner
def _product(panels, left, stride, depth, head, target, to, size, first, end):
    """Subtract the lower triangle of the product of panel columns with themselves from columns of a matrix.

    head: offset of the rows that are multiplied; first, end: range of the matrix columns.
    """
    for row in range(first // ROWS * ROWS, size, HEIGHT):
        stop = min(row + HEIGHT, size)
        for tile in range(first, min(end, stop), TILE):
            above = max(row, tile // ROWS * ROWS)
            place, strips = to + tile * size + above, (stop - above) // ROWS
            _subtract(
                panels, left + head, above, tile, stride, depth, target, place, size, strips, min(TILE, end - tile)
            )


@inner
def _subtract(panels, left, row, top, stride, depth, target, to, size, strips, columns):
    """Call `subtract_product` for six or three columns."""
    if columns == 6:
        subtract_product(panels, left + row, left + top, stride, depth, target, to, size, strips, 6)
    else:
        subtract_product(panels, left + row, left + top, stride, depth, target, to, size, strips, 3)
