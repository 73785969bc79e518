"""The matrix of a Hessian: 3 x 3 blocks between free vertices, their positions per energy, and the factorisation.

The pattern covers springs, projective energies and elements, which are known before the first step. If another energy
needs more blocks, a step extends the pattern (`solvers.core.pairs_matrix`). The last extended one is cached for
steps that need exactly that pattern, so that a result depends on its problem only, not on earlier ones.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array

from solvers import matrices
from solvers.kernels import forms, hessian
from solvers.kernels.forms import Form
from solvers.kernels.objective import Terms
from solvers.linear.block import BlockCholesky
from solvers.problem import System

Indices = NDArray[np.int64]


class Matrix:
    """A matrix of 3 x 3 blocks between free vertices."""

    def __init__(self, system: System, terms: Terms, form: Form | None, number: Indices, graph: csr_array) -> None:
        """Analyse a block pattern.

        Args:
            system: the system.
            terms: objective terms.
            form: quadratic form of the system, or None.
            number: index of each vertex among the free ones (n,), or -1.
            graph: pattern of the blocks (f, f), sorted, with a diagonal.
        """
        self.graph, self._number, self._size = graph, number, len(system.free)
        self._terms, self._form = terms, form
        self.values = np.empty((graph.nnz, 3, 3))
        self.factor = BlockCholesky(graph)
        self.places = hessian.Places.of(system, terms.edges, graph)
        rows = np.repeat(np.arange(len(graph.indptr) - 1), np.diff(graph.indptr))
        self._keys = rows * self._size + graph.indices
        self.diagonal = self.entries(*np.tile(np.arange(3 * len(system.free)), (2, 1)))
        self._elements: dict[int, tuple[Indices, Indices]] = {}

    @classmethod
    def of(
        cls,
        system: System,
        terms: Terms,
        form: Form | None,
        number: Indices,
        graph: csr_array,
        i: Indices,
        j: Indices,
    ) -> Matrix:
        """Return a matrix with the blocks of a graph and additional ones.

        The latter are between vertices i and j, in both directions, where both are free.
        """
        i, j = i[(i >= 0) & (j >= 0)], j[(i >= 0) & (j >= 0)]
        ones = np.ones(2 * len(i))
        more = csr_array(coo_array((ones, (np.append(i, j), np.append(j, i))), shape=graph.shape))
        return cls(system, terms, form, number, matrices.without_zeros(abs(graph) + more))

    @property
    def blocks(self) -> tuple[Indices, Indices]:
        """Rows and columns of all blocks."""
        return self._keys // self._size, self._keys % self._size

    def has(self, i: Indices, j: Indices) -> bool:
        """Return whether the matrix has the blocks (i, j)."""
        keys = i * self._size + j
        at = np.minimum(np.searchsorted(self._keys, keys), len(self._keys) - 1)
        return bool((self._keys[at] == keys).all())

    def needs(self, i: Indices, j: Indices, base: Matrix) -> bool:
        """Return whether the matrix has exactly the blocks of another one, (i, j) and (j, i)."""
        size = self._size
        return len(np.unique(np.concatenate([base._keys, i * size + j, j * size + i]))) == len(self._keys)

    def entries(self, rows: Indices, columns: Indices) -> Indices:
        """Return the indices of the entries (rows, columns) within the flat values."""
        block = np.searchsorted(self._keys, rows // 3 * self._size + columns // 3)
        return 9 * block + 3 * (rows % 3) + columns % 3

    def of_elements(self, energy: int, vertices: Indices) -> Indices:
        """Return the block index of each vertex pair of an energy's elements (m, k), as (m, k^2); -1 if not free.

        They are cached for the same array of vertices. Raises LookupError if a block is missing.
        """
        if not self.holds(energy, vertices):
            raise LookupError("the matrix has no place for some blocks of these elements")
        return self._elements[energy][1]

    def holds(self, energy: int, vertices: Indices) -> bool:
        """Return whether the matrix has all blocks of an energy's elements."""
        known = self._elements.get(energy)
        if known is not None and known[0] is vertices:
            return True
        (m, k), graph = vertices.shape, self.graph
        if k == 1:
            self._elements[energy] = vertices, self.places.diagonal[vertices]
            return True
        out = np.empty((m, k * k), np.int64)
        if not hessian.locate(self._number, graph.indptr, graph.indices, np.ascontiguousarray(vertices), out):
            return False
        self._elements[energy] = vertices, out
        return True

    def _between(self, i: Indices, j: Indices) -> Indices:
        """Return the blocks between vertices i and j, of one shape; -1 if one is not free."""
        i, j = self._number[i], self._number[j]
        return np.where((i >= 0) & (j >= 0), np.searchsorted(self._keys, i * self._size + j), -1)

    @cached_property
    def constant(self) -> NDArray[np.float64]:
        """Blocks of inertia, penalty pins and the form, (b, 3, 3) [N/m]."""
        out = np.empty_like(self.values)
        hessian.hold(self._terms, self.places, out)
        if self._form is not None:
            i, j = self._form.pairs.T
            across = np.column_stack([self._between(i, j), self._between(j, i)])
            forms.add_blocks(self._form, self.places.diagonal, across, out)
        return out
