"""A sparse Cholesky factorisation of a matrix of 3 x 3 blocks, analysed once and factorised again and again.

    H x = b,   H symmetric, 3n x 3n, its blocks where a graph of n vertices has entries

The order of elimination is found on the graph, where it costs a third; the factorisation is the multifrontal one of
`solvers.linear.supernodal`. A failure is an answer here, not an error: it says that H is not positive definite.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from solvers.linear.ordering import nested_dissection
from solvers.linear.supernodal import Layout
from solvers.linear.supernodal_factor import factorise
from solvers.linear.supernodal_solve import solve
from solvers.linear.symbolic import analyse


class BlockCholesky:
    """The factorisation of H for one pattern of blocks.

    pointers (3n + 1,), columns: the CSR structure of H, whose three rows of a vertex have the same columns;
    nonzeros: of its factor, diagonal included. Factorisations and solves share their arrays: one at a time.
    """

    def __init__(self, graph: csr_array) -> None:
        """graph: (n, n), symmetric in its pattern, an entry for each block, the diagonal's included."""
        starts, neighbours = np.asarray(graph.indptr, np.int64), np.asarray(graph.indices, np.int32)
        degree = np.repeat(np.diff(starts), 3)
        self.pointers = np.concatenate([[0], np.cumsum(3 * degree)])
        within = np.arange(self.pointers[-1]) - np.repeat(self.pointers[:-1], 3 * degree)
        block = np.repeat(np.repeat(starts[:-1], 3), 3 * degree) + within // 3
        self.columns = (3 * neighbours[block] + within % 3).astype(np.int32)
        order = 3 * nested_dissection(starts, neighbours)[:, None] + np.arange(3, dtype=np.int32)
        s = analyse(self.pointers, self.columns, order.ravel())
        layout = Layout.of(s)
        self.nonzeros = s.nonzeros
        squares, panels = np.empty(layout.squares), np.empty(layout.panels)
        self._structure = (
            s.slot, s.vertex, s.parent, s.first, s.row_start, s.rows, s.sequence,
            layout.chunk_of, layout.chunks, squares, panels,
        )  # fmt: skip
        self._panels = (
            squares, panels, layout.places, layout.chunks, layout.spans, layout.by_slot, layout.by_vertex,
            np.zeros(4 * layout.rows),
        )  # fmt: skip
        self._b, self._x = np.zeros((2, len(self.pointers) - 1, 3))

    def factorise(self, values: NDArray[np.float64]) -> bool:
        """Factorise H with these entries, in the order of `columns`; False where it is not positive definite."""
        return factorise(self.pointers, self.columns, values, *self._structure) < 0

    def solve(self, b: NDArray[np.float64]) -> NDArray[np.float64]:
        """H^-1 b for b (3n,), or (3n, k) with k at most 3."""
        wide = b.reshape(len(b), -1)
        self._b[:, : wide.shape[1]] = wide
        solve(*self._panels, self._b, self._x)
        return self._x[:, : wide.shape[1]].reshape(b.shape).copy()
