"""Second derivatives of contacts of two to four vertices."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import inner, kernel
from solvers.problem import Positions

Array = NDArray[np.float64]


class Blocks(NamedTuple):
    """vertices (a, 4), -1 for none and for those of obstacles; packed: the blocks [N/m] one after the other, each row
    by row, of three rows for each vertex up to the last that its contact has; starts (a + 1,): where they begin."""

    vertices: NDArray[np.int64]
    starts: NDArray[np.int64]
    packed: Array

    @classmethod
    def whole(cls, vertices: NDArray[np.int64], values: Array) -> Blocks:
        """Of blocks (a, 12, 12) of vertices (a, 4)."""
        return cls(vertices, 144 * np.arange(len(vertices) + 1), np.ascontiguousarray(values).reshape(-1))

    @property
    def values(self) -> Array:
        """The blocks with zeros for vertices that are none, (a, 12, 12)."""
        out = np.zeros((len(self.vertices), 12, 12))
        spread(self.starts, self.packed, out)
        return out

    def of(self, values: Array) -> Blocks:
        """The same contacts with other values (a, 12, 12)."""
        return Blocks.whole(self.vertices, values)

    def followed(self, other: Blocks) -> Blocks:
        """These, and then others."""
        starts = np.concatenate([self.starts, self.starts[-1] + other.starts[1:]])
        return Blocks(np.concatenate([self.vertices, other.vertices]), starts, np.append(self.packed, other.packed))

    def add_product(self, x: Positions, out: Positions) -> None:
        """Add their product with x (n, 3) to `out`."""
        multiply(*self, x, out)

    def add(self, places: NDArray[np.int64], values: Array) -> None:
        """Add them to blocks (b, 3, 3), at places (a, 16); -1 for none."""
        scatter(self.starts, self.packed, places, values)


@kernel
def scatter(starts, packed, places, values):
    """Add blocks to `values` (b, 3, 3), at places (a, 16); -1 for none."""
    for k in range(len(places)):
        begin, many = starts[k], _rows_of(starts[k + 1] - starts[k])
        for i in range(many // 3):
            for j in range(many // 3):
                at = places[k, 4 * i + j]
                if at >= 0:
                    for a in range(3):
                        row = begin + (3 * i + a) * many + 3 * j
                        for b in range(3):
                            values[at, a, b] += packed[row + b]


@kernel
def spread(starts, packed, out):
    """Write blocks to the corners of `out` (a, 12, 12)."""
    for k in range(len(out)):
        many = _rows_of(starts[k + 1] - starts[k])
        for i in range(many):
            for j in range(many):
                out[k, i, j] = packed[starts[k] + i * many + j]


@kernel
def multiply(vertices, starts, packed, x, out):
    """Add the product of blocks with x (n, 3) to `out`; vertices: -1 for those that do not move."""
    for k in range(len(vertices)):
        at, many = starts[k], _rows_of(starts[k + 1] - starts[k])
        for i in range(many):
            if vertices[k, i // 3] < 0:
                continue
            total = 0.0
            for j in range(many):
                if vertices[k, j // 3] >= 0:
                    total += packed[at + i * many + j] * x[vertices[k, j // 3], j % 3]
            out[vertices[k, i // 3], i % 3] += total


@inner
def _rows_of(size):
    """The root of 36, 81 or 144."""
    return 12 if size == 144 else 9 if size == 81 else 6
