"""Second derivatives of pairs of four vertices."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import kernel
from solvers.problem import Positions

Array = NDArray[np.float64]


class Blocks(NamedTuple):
    """The second derivatives of pairs that are in range. vertices (a, 4), -1 for those of obstacles; values
    (a, 12, 12) [N/m]."""

    vertices: NDArray[np.int64]
    values: Array

    def of(self, values: Array) -> Blocks:
        """The same pairs with other values."""
        return self._replace(values=values)

    def add_product(self, x: Positions, out: Positions) -> None:
        """Add their product with x (n, 3) to `out`."""
        multiply(self.vertices, self.values, x, out)

    def add(self, places: NDArray[np.int64], values: Array) -> None:
        """Add them to blocks (b, 3, 3), at places (a, 16); -1 for none."""
        scatter(self.values, places, values)


@kernel
def scatter(blocks, places, values):
    """Add blocks (a, 12, 12) to `values` (b, 3, 3), at places (a, 16); -1 for none."""
    for k in range(len(blocks)):
        for i in range(4):
            for j in range(4):
                at = places[k, 4 * i + j]
                if at >= 0:
                    for a in range(3):
                        for b in range(3):
                            values[at, a, b] += blocks[k, 3 * i + a, 3 * j + b]


@kernel
def multiply(vertices, blocks, x, out):
    """Add the product of blocks (a, 12, 12) with x (n, 3) to `out`; vertices: -1 for those that do not move."""
    for k in range(len(blocks)):
        for i in range(12):
            if vertices[k, i // 3] < 0:
                continue
            total = 0.0
            for j in range(12):
                if vertices[k, j // 3] >= 0:
                    total += blocks[k, i, j] * x[vertices[k, j // 3], j % 3]
            out[vertices[k, i // 3], i % 3] += total
