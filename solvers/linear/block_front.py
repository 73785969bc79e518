"""A front of a multifrontal factorisation by itself: the elimination of its columns, and the update that is left.

    L_JJ L_JJ' = F_JJ,   L_BJ = F_BJ L_JJ^-T,   update: F_BB - L_BJ L_BJ'

Columns go from left to right, a tile at a time: the product of the columns to the left is subtracted, then the tile is
divided by its own triangle. They are taken DEPTH at a time and rows HEIGHT at a time, so that what is multiplied again
and again stays in the caches; an entry's products are subtracted in the order of columns, whatever these two are.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import inner
from solvers.vectors.block import ROWS, TILE, divide, factorise_corner, subtract_product

DEPTH, HEIGHT = 192, 128
"""Columns and rows of a panel that are multiplied together: whole tiles, and whole vectors; 192 KiB."""

_NO_DIGITS = 4.0 * np.finfo(np.float64).eps
"""A pivot this small beside its entry of the matrix is round-off."""


class Dense(NamedTuple):
    """The front of a supernode: own columns of vertices in panels, from base on, `stride` numbers each, rows below from
    `head` on; the update of its parent, from begin on, in columns of `size`."""

    own: int
    head: int
    stride: int
    panels: NDArray[np.float64]
    base: int
    update: NDArray[np.float64]
    begin: int
    size: int


def whole(rows: Any) -> Any:
    """The rows of so many whole vectors as hold these."""
    return (rows + ROWS - 1) // ROWS * ROWS


rows_of = inner(whole)


@inner
def eliminate(fronts, s, values, panels, stride, least, triangles):
    """Factorise the panel of a supernode; False at a pivot that is not positive."""
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
    """Subtract from columns of a matrix, from a first one to an end, what is on and below its diagonal of the product
    of so many columns of a panel with themselves, whose rows begin at `head`."""
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
    """`subtract_product`, for six columns or three."""
    if columns == 6:
        subtract_product(panels, left + row, left + top, stride, depth, target, to, size, strips, 6)
    else:
        subtract_product(panels, left + row, left + top, stride, depth, target, to, size, strips, 3)
