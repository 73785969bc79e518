"""The free vertices by colour, in bundles, for methods that move one after another.

No two vertices of a colour are joined by a spring, a form or an element. Rows are the free vertices by colour, then the
pinned ones, then two that fill up bundles.
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
    """row (n,): where each vertex is; free: how many rows are unknowns; bundles: of these, by colour; first (colours +
    1,): the first bundle of each; held, majorant (n + 2,) [N/m]: of each row, what inertia and pins hold it with, and
    that with the stiffness of its springs and elements, 1 where nothing is."""

    row: NDArray[np.int64]
    free: int
    bundles: Bundles
    first: NDArray[np.int64]
    held: NDArray[np.float64]
    majorant: NDArray[np.float64]

    @property
    def colours(self) -> int:
        """How many there are."""
        return len(self.first) - 1

    @classmethod
    def of(cls, system: System, parts: Parts, beside: Beside) -> VertexBlocks:
        """Those of a system whose energies are these."""
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
