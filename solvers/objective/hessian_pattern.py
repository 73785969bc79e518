"""The matrix of a Hessian and its factorisation.

It consists of 3 x 3 blocks between free vertices. The pattern covers springs, projective energies and elements, which
are known before the first step. If another energy needs more blocks, a step extends the pattern
(`springbench.solvers.objective.step_matrix`). The last extended one is cached for steps that need exactly that pattern,
so that a result depends on its problem only, not on earlier ones. The matrices of a system share a count of
factorisations.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from springbench.solvers.kernels import quadratic_form_kernels, spring_hessian
from springbench.solvers.kernels.objective_kernels import ObjectiveTerms
from springbench.solvers.kernels.quadratic_form_kernels import QuadraticForm
from springbench.solvers.linalg.cholesky.block_cholesky import BlockCholesky, FactorisationCount
from springbench.solvers.model import system_matrix_assembly
from springbench.solvers.model.step_problem import System

IndexArray = NDArray[np.int64]


_MIN_THREADED_BLOCKS = 70_000
"""Blocks of a matrix from which a second thread pays off; to start it takes as long as writing some thousand blocks."""


class BlockMatrix:
    """A matrix of 3 x 3 blocks between free vertices."""

    def __init__(
        self,
        system: System,
        terms: ObjectiveTerms,
        quadratic_form: QuadraticForm | None,
        free_index: IndexArray,
        graph: csr_array,
        count: FactorisationCount,
    ) -> None:
        """Analyse a block pattern.

        Args:
            system: the system.
            terms: objective terms.
            quadratic_form: quadratic form of the system, or None.
            free_index: index of each vertex among the free ones (n + 1,), or -1; the last entry is -1.
            graph: pattern of the blocks (f, f), sorted, with a diagonal.
            count: the count to which its factorisations are added.
        """
        self.graph, self._free_index, self._num_free = graph, free_index, len(system.free_vertices)
        self._objective_terms, self._quadratic_form = terms, quadratic_form
        self.values = np.empty((graph.nnz, 3, 3))
        self.factor = BlockCholesky(graph, count=count)
        self.block_indices = spring_hessian.BlockIndices.from_graph(system, terms.edges, graph)
        rows = np.repeat(np.arange(len(graph.indptr) - 1), np.diff(graph.indptr))
        self._block_keys = rows * self._num_free + graph.indices
        self.diagonal_entries = self.entry_indices(*np.tile(np.arange(3 * len(system.free_vertices)), (2, 1)))
        self._row_bounds: dict[int, IndexArray] = {}
        self._element_indices: dict[int, tuple[IndexArray, IndexArray]] = {}
        self._index_memory: dict[int, IndexArray] = {}

    @property
    def num_threads(self) -> int:
        """Number of threads of an assembly: that of factorisations, or one if faster."""
        return self.factor.num_threads if len(self.values) >= _MIN_THREADED_BLOCKS else 1

    def divide_rows(self, parts: int) -> IndexArray:
        """Return ranges of rows with about equally many blocks.

        Args:
            parts: number of ranges.

        Returns:
            First vertex and first block of each range, and the ends of the last one (parts + 1, 2).
        """
        if parts not in self._row_bounds:
            starts = self.graph.indptr
            rows = np.searchsorted(starts, np.arange(parts + 1) * self.graph.nnz // parts)
            vertices = np.append(self.block_indices.free_vertices, len(self.block_indices.diagonal_block))
            self._row_bounds[parts] = np.stack([vertices[rows], starts[rows]], axis=1).astype(np.int64)
        return self._row_bounds[parts]

    @classmethod
    def from_graph(
        cls,
        system: System,
        terms: ObjectiveTerms,
        quadratic_form: QuadraticForm | None,
        free_index: IndexArray,
        graph: csr_array,
        i: IndexArray,
        j: IndexArray,
        count: FactorisationCount,
    ) -> BlockMatrix:
        """Return a matrix with the blocks of a graph and additional ones.

        Args:
            system: the system.
            terms: its springs, inertia and penalty pins.
            quadratic_form: quadratic form of the system, or None.
            free_index: index of each vertex among the free ones (n + 1,), or -1; the last entry is -1.
            graph: pattern of blocks (f, f), nonzero where the matrix has one, with a diagonal.
            i, j: ends of additional blocks (k,), by index among the free vertices; -1 for a vertex that is not free.
                Both blocks, (i, j) and (j, i), are added where both ends are free.
            count: the count to which its factorisations are added.
        """
        i, j = i[(i >= 0) & (j >= 0)], j[(i >= 0) & (j >= 0)]
        ones = np.ones(2 * len(i))
        more = csr_array(coo_array((ones, (np.append(i, j), np.append(j, i))), shape=graph.shape))
        graph = system_matrix_assembly.drop_zeros(abs(graph) + more)
        return cls(system, terms, quadratic_form, free_index, graph, count)

    @property
    def block_coordinates(self) -> tuple[IndexArray, IndexArray]:
        """Rows and columns of all blocks."""
        return self._block_keys // self._num_free, self._block_keys % self._num_free

    def has_blocks(self, i: IndexArray, j: IndexArray) -> bool:
        """Return whether the matrix has the blocks (i, j).

        Args:
            i, j: rows and columns of the blocks (k,), by index among the free vertices.
        """
        keys = i * self._num_free + j
        at = np.minimum(np.searchsorted(self._block_keys, keys), len(self._block_keys) - 1)
        return bool((self._block_keys[at] == keys).all())

    def is_exact_extension(self, i: IndexArray, j: IndexArray, base: BlockMatrix) -> bool:
        """Return whether the matrix only has the blocks of `base` and additional ones.

        The latter are (i, j) and (j, i).

        Args:
            i, j: rows and columns of additional blocks (k,), by index among the free vertices; the matrix has them all.
            base: the other matrix, whose blocks the matrix has too.
        """
        size = self._num_free
        return len(np.unique(np.concatenate([base._block_keys, i * size + j, j * size + i]))) == len(self._block_keys)

    def entry_indices(self, rows: IndexArray, columns: IndexArray) -> IndexArray:
        """Return the indices of entries within the flat values.

        Args:
            rows, columns: coordinates of the entries (k,), three for each free vertex; their blocks must exist.

        Returns:
            Indices (k,) into `values.reshape(-1)`.
        """
        block = np.searchsorted(self._block_keys, rows // 3 * self._num_free + columns // 3)
        return 9 * block + 3 * (rows % 3) + columns % 3

    def element_block_indices(self, energy: int, vertices: IndexArray) -> IndexArray:
        """Return the block index of each vertex pair of an energy's elements.

        They are cached for the same array of vertices, and overwritten for another one.

        Args:
            energy: index of the energy in the system, or -1 - k for the k-th barrier energy.
            vertices: vertices of the elements (m, k), -1 for none.

        Returns:
            Indices (m, k^2), -1 if a vertex is not free.

        Raises:
            LookupError: a block is missing.
        """
        if not self.has_element_blocks(energy, vertices):
            raise LookupError("the matrix has no place for some blocks of these elements")
        return self._element_indices[energy][1]

    def has_element_blocks(self, energy: int, vertices: IndexArray) -> bool:
        """Return whether the matrix has all blocks of an energy's elements.

        If it has, their indices are cached for `element_block_indices`.

        Args:
            energy: index of the energy in the system, or -1 - k for the k-th barrier energy.
            vertices: vertices of the elements (m, k), -1 for none.
        """
        known = self._element_indices.get(energy)
        if known is not None and known[0] is vertices:
            return True
        (m, k), graph = vertices.shape, self.graph
        if k == 1:
            self._element_indices[energy] = vertices, self.block_indices.diagonal_block[vertices]
            return True
        # Pairs differ at each point. The array of the previous indices is reused, because the operating system clears
        # each page of new memory.
        self._element_indices.pop(energy, None)
        memory = self._index_memory.get(energy)
        if memory is None or memory.shape[1] != k * k or len(memory) < m:
            memory = self._index_memory[energy] = np.empty((m + m // 4, k * k), np.int64)
        out = memory[:m]
        if not spring_hessian.locate_blocks(
            self._free_index,
            graph.indptr,
            graph.indices,
            self._transposed_blocks,
            np.ascontiguousarray(vertices),
            out,
        ):
            return False
        self._element_indices[energy] = vertices, out
        return True

    @cached_property
    def _transposed_blocks(self) -> IndexArray:
        """Index of the block (j, i) of each block (i, j), (b,)."""
        blocks = csr_array((np.arange(self.graph.nnz), self.graph.indices, self.graph.indptr), shape=self.graph.shape)
        return np.asarray(csr_array(blocks.T).data, np.int64)

    def _pair_block_indices(self, i: IndexArray, j: IndexArray) -> IndexArray:
        """Return the blocks between vertices i and j, arrays of one shape.

        A block is -1 if one of its vertices is not free.
        """
        i, j = self._free_index[i], self._free_index[j]
        return np.where((i >= 0) & (j >= 0), np.searchsorted(self._block_keys, i * self._num_free + j), -1)

    @cached_property
    def constant_blocks(self) -> NDArray[np.float64]:
        """Blocks of inertia, penalty pins and the form, (b, 3, 3) [N/m]."""
        out = np.empty_like(self.values)
        spring_hessian.write_constant_blocks(self._objective_terms, self.block_indices, out)
        if self._quadratic_form is not None:
            i, j = self._quadratic_form.pairs.T
            across = np.column_stack([self._pair_block_indices(i, j), self._pair_block_indices(j, i)])
            quadratic_form_kernels.add_quadratic_blocks(
                self._quadratic_form, self.block_indices.diagonal_block, across, out
            )
        return out
