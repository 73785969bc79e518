"""Packed Hessian blocks of collisions of two to four vertices.

The blocks are symmetric. Each row is stored up to the end of its own vertex's diagonal block: row a of vertex i has
3 (i + 1) numbers, and follows the rows above it.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array

from solvers.compiling import inner, kernel
from solvers.problem import Positions

Array = NDArray[np.float64]

NUMBERS = 90
"""Number of stored entries of a collision of four vertices."""


class Room:
    """Array memory that is reused once the last array is no longer referenced.

    The system clears each page of new memory, which takes as long as to compute the entries.
    """

    def __init__(self) -> None:
        self._memory = np.empty(0)
        self._held: Callable[[], Array | None] = lambda: None

    def take(self, many: int) -> Array:
        """Return an array (many,). References to views of it do not prevent its reuse."""
        if len(self._memory) < many or self._held() is not None:
            self._memory = np.empty(many)
        out = self._memory[:many]
        self._held = weakref.ref(out)
        return out


class Blocks(NamedTuple):
    """Packed symmetric blocks.

    Attributes:
        vertices: (a, 4); -1 for none and for those of obstacles.
        starts: first entry of each block, and the end of the last one, (a + 1,).
        packed: rows [N/m] of consecutive blocks, up to the last vertex of each collision.
    """

    vertices: NDArray[np.int64]
    starts: NDArray[np.int64]
    packed: Array

    @classmethod
    def whole(cls, vertices: NDArray[np.int64], values: Array) -> Blocks:
        """Build packed blocks from symmetric blocks (a, 12, 12) of vertices (a, 4)."""
        row, column = np.nonzero(np.arange(12) // 3 <= np.arange(12)[:, None] // 3)
        return cls(vertices, NUMBERS * np.arange(len(vertices) + 1), np.ravel(values[:, row, column]))

    @property
    def values(self) -> Array:
        """Dense blocks (a, 12, 12), with zeros for missing vertices."""
        out = np.zeros((len(self.vertices), 12, 12))
        spread(self.starts, self.packed, out)
        return out

    def of(self, values: Array) -> Blocks:
        """Return blocks of the same vertices with other values (a, 12, 12)."""
        return Blocks.whole(self.vertices, values)

    def followed(self, other: Blocks) -> Blocks:
        """Return these blocks followed by others."""
        end = self.starts[-1]
        starts, packed = np.append(self.starts, end + other.starts[1:]), np.append(self.packed[:end], other.packed)
        return Blocks(np.concatenate([self.vertices, other.vertices]), starts, packed)

    def matrix(self, n: int) -> csr_array:
        """Return the sum of all blocks as a sparse matrix (3n, 3n) [N/m]."""
        values = self.values.ravel()
        at = (3 * self.vertices[:, :, None] + np.arange(3)).reshape(-1, 12)
        rows, columns = np.repeat(at, 12, axis=1).ravel(), np.tile(at, 12).ravel()
        own = (rows >= 0) & (columns >= 0)
        return csr_array(coo_array((values[own], (rows[own], columns[own])), shape=(3 * n, 3 * n)))

    def add_product(self, x: Positions, out: Positions) -> None:
        """Add the product with x (n, 3) to `out` (n, 3)."""
        multiply(*self, x, out)

    def add(self, places: NDArray[np.int64], values: Array) -> None:
        """Add the blocks to `values` (b, 3, 3), at block indices (a, 16); -1 for none."""
        scatter(self.starts, self.packed, places, values)


@inner
def row(i, a):
    """Return the offset of row a of vertex i."""
    return 9 * i * (i + 1) // 2 + 3 * a * (i + 1)


@inner
def count(numbers):
    """Return the number of vertices of a block with n entries."""
    return 4 if numbers == NUMBERS else 3 if numbers == 54 else 2


@kernel
def scatter(starts, packed, places, values):
    """Add packed blocks to `values` (b, 3, 3), at block indices (a, 16); -1 for none."""
    for k in range(len(places)):
        add_at(packed[starts[k] : starts[k + 1]], places[k], values)


@inner
def add_at(H, places, values):
    """Add one packed block H to `values` (b, 3, 3), at block indices (16,); -1 for none."""
    for i in range(count(len(H))):
        for j in range(i + 1):
            at, across = places[4 * i + j], places[4 * j + i]
            if at < 0:
                continue
            for a in range(3):
                begin = row(i, a) + 3 * j
                for b in range(3):
                    values[at, a, b] += H[begin + b]
            if i == j:
                continue
            for a in range(3):
                begin = row(i, a) + 3 * j
                for b in range(3):
                    values[across, b, a] += H[begin + b]


@kernel
def spread(starts, packed, out):
    """Write packed blocks to the leading parts of dense blocks `out` (a, 12, 12)."""
    for k in range(len(out)):
        H = packed[starts[k] : starts[k + 1]]
        for i in range(count(len(H))):
            for a in range(3):
                for j in range(3 * i + 3):
                    out[k, 3 * i + a, j] = H[row(i, a) + j]
                    out[k, j, 3 * i + a] = H[row(i, a) + j]


@kernel
def multiply(vertices, starts, packed, x, out):
    """Add the product of packed blocks with x to `out`.

    Args:
        vertices: vertices of each block (a, 4); -1 where they do not move.
        starts: first entry of each block (a + 1,).
        packed: entries of the blocks.
        x: vectors (n, 3).
        out: product (n, 3), updated.
    """
    for k in range(len(vertices)):
        H = packed[starts[k] : starts[k + 1]]
        for i in range(count(len(H))):
            for j in range(i + 1):
                v, w = vertices[k, i], vertices[k, j]
                if v < 0 or w < 0:
                    continue
                for a in range(3):
                    for b in range(3):
                        h = H[row(i, a) + 3 * j + b]
                        out[v, a] += h * x[w, b]
                        if i != j:
                            out[w, b] += h * x[v, a]
