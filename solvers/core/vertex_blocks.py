"""The free vertices by colour, in packets, for methods that move one vertex after another.

No two vertices of a colour share a spring, a pair of a form, or an element. Rows are the free vertices by colour, then
the pinned ones, then two padding rows of the packets.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.core import colouring, vertex_terms
from solvers.core.parts import Parts
from solvers.core.vertex_elements import Beside
from solvers.kernels.springs import Bundles
from solvers.problem import System
from solvers.vectors.springs import LANES


class VertexBlocks(NamedTuple):
    """The rows, packets and majorants of a system.

    Attributes:
        row: row of each vertex (n,).
        free: number of free rows.
        bundles: packets of the free rows, by colour.
        first: first packet of each colour (colours + 1,).
        held: stiffness [N/m] of inertia and pins of each row (n + 2,).
        majorant: that plus the stiffness of springs and elements (n + 2,) [N/m]; 1 for padding.
    """

    row: NDArray[np.int64]
    free: int
    bundles: Bundles
    first: NDArray[np.int64]
    held: NDArray[np.float64]
    majorant: NDArray[np.float64]

    @property
    def colours(self) -> int:
        """Number of colours."""
        return len(self.first) - 1

    @classmethod
    def of(cls, system: System, parts: Parts, beside: Beside) -> VertexBlocks:
        """Build the rows of a system from the decomposition of its energies."""
        n = system.vertices
        coloured = colouring.of_vertices(np.concatenate([parts.whole.edges, beside.pairs()]), n)
        colour = np.empty(n, np.int64)
        colour[coloured.order] = np.repeat(np.arange(coloured.colours), np.diff(coloured.start))
        pinned = system.pins.vertices[system.pins.exact]
        order = coloured.order[~np.isin(coloured.order, pinned)]
        row = np.empty(n, np.int64)
        row[order], row[pinned] = np.arange(len(order)), np.arange(len(order), n)
        colour[pinned] = -1
        bundles, first = Bundles.of(parts.whole, row, colour, coloured.colours, n, n + 1)
        held, majorant = np.zeros(n + 2), np.ones(n + 2)
        held[: len(order)] = majorant[: len(order)] = (vertex_terms.held(system) + parts.held)[order]
        majorant[: len(order)] += beside.diagonal()[order]
        ends = np.repeat(bundles.own.reshape(-1, LANES), np.diff(bundles.start), axis=0)
        np.add.at(majorant, ends.ravel() // 4, bundles.each()[1])
        return cls(row, len(order), bundles, first, held, majorant)
