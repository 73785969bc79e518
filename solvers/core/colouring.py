"""Colours for Gauss-Seidel methods: what has one colour does not touch, so its order does not matter.

Springs touch where they share a vertex, vertices where they share a spring. Each takes the first colour that is free
(greedy, by number): of springs no more than twice the largest degree, of vertices no more than the most neighbours
and one. All that depends on the colours alone, and not on the order within one, can be done at the same time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from solvers.kernels.colouring import first_fit
from solvers.matrices import signed_incidence_matrix_sparse


@dataclass(frozen=True, eq=False)
class Colouring:
    """order: the items by colour, and by number within one; start (colours + 1,): where each colour begins in it."""

    order: NDArray[np.int64]
    start: NDArray[np.int64]

    @property
    def colours(self) -> int:
        """How many there are."""
        return len(self.start) - 1


def of_springs(edges: NDArray[np.int64], n: int) -> Colouring:
    """Colours of springs (m, 2) over n vertices; no two of a colour share a vertex."""
    A = signed_incidence_matrix_sparse(edges, n)
    return _coloured(A, csr_array(A.T))


def of_vertices(edges: NDArray[np.int64], n: int) -> Colouring:
    """Colours of n vertices; no two of a colour share one of the springs (m, 2)."""
    A = signed_incidence_matrix_sparse(edges, n)
    return _coloured(csr_array(A.T), A)


def _coloured(groups: csr_array, items: csr_array) -> Colouring:
    """Colours of the rows of `groups`; those with an entry in one column touch. items: the transpose."""
    for matrix in (groups, items):
        matrix.sort_indices()
    count = len(groups.indptr) - 1
    colour, taken = np.zeros(count, np.int64), np.full(count, -1)
    pointers, columns, back, rows = (
        np.asarray(x, np.int64) for x in (groups.indptr, groups.indices, items.indptr, items.indices)
    )
    first_fit(pointers, columns, back, rows, colour, taken)
    start = np.concatenate([[0], np.cumsum(np.bincount(colour))]) if count else np.zeros(1, np.int64)
    return Colouring(np.argsort(colour, kind="stable"), start)
