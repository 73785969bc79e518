"""Shared parts of energies along vertex pairs.

They are the edge vectors v = A p, the forces A'f, the matrix A'KA, and Hessians of 3 x 3 blocks.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy
from numpy.typing import NDArray
from springbench.solvers.model.step_problem import Positions
from springbench.solvers.model.system_matrix_assembly import (
    compute_row_starts,
    diagonal_matrix,
    drop_zeros,
    signed_incidence_matrix_sparse,
)

ZERO_LENGTH = 1e-140
"""Lengths [m] up to this value count as zero, because their squares underflow."""


@dataclass(frozen=True, eq=False)
class EdgeEnergy:
    """An energy along pairs of vertices.

    Attributes:
        edges: (m, 2).
        stiffness: k (m,) [N/m], not negative.
    """

    edges: NDArray[np.int64]
    stiffness: NDArray[np.float64]

    def edge_lengths(self, p: Positions) -> NDArray[np.float64]:
        """Return the length of each edge [m] at p (n, 3), shape (m,)."""
        return _row_norms(self._edge_vectors(p))

    def stiffness_matrix(self, n: int) -> scipy.sparse.csr_array:
        """Return A'KA [N/m], shape (n, n), the contribution to Q."""
        A = signed_incidence_matrix_sparse(self.edges, n)
        return drop_zeros(A.T @ diagonal_matrix(self.stiffness) @ A)

    @property
    def _num_vertices(self) -> int:
        return int(self.edges.max(initial=-1)) + 1

    @cached_property
    def _incidence(self) -> tuple[scipy.sparse.csr_array, scipy.sparse.csr_array]:
        """A over the vertices up to the last one with an edge, and A'K."""
        A = signed_incidence_matrix_sparse(self.edges, self._num_vertices)
        return A, scipy.sparse.csr_array(A.T @ diagonal_matrix(self.stiffness))

    def _edge_vectors(self, p: Positions) -> Positions:
        """Return v = A p, (m, 3)."""
        return self._incidence[0] @ p[: self._num_vertices]

    def _scatter_forces(self, x: Positions, out: Positions) -> None:
        """Add A'K x to `out`, x: (m, 3)."""
        out[: self._num_vertices] += self._incidence[1] @ x

    def _scatter_absolute_terms(self, terms: NDArray[np.float64], out: NDArray[np.float64]) -> None:
        """Add k times the terms (m,) [m] of edges to `out` (n,) at both ends, except for self-loops."""
        (i, j), terms = self.edges.T, self.stiffness * terms
        terms = np.where(i != j, terms, 0.0)
        for end in (i, j):
            out += np.bincount(end, terms, minlength=len(out))

    def _endpoint_norms(self, p: Positions) -> NDArray[np.float64]:
        """Return |p_i| + |p_j| of each edge (m,) [m], which scales the rounding error of its ends."""
        size = _row_norms(p)
        return size[self.edges[:, 0]] + size[self.edges[:, 1]]

    def _block_hessian(
        self, lateral: NDArray[np.float64], unit: Positions, n: int, along: float | NDArray = 1.0
    ) -> scipy.sparse.csr_array:
        """Return the Hessian (3n, 3n) of edges with blocks k (along nn' + lateral (I - nn')), n unit directions."""
        nn = unit[:, :, None] * unit[:, None, :]
        full = np.reshape(along, (-1, 1, 1)) * nn + lateral[:, None, None] * (np.eye(3) - nn)
        H, (i, j) = self.stiffness[:, None, None] * full, self.edges.T
        rows, columns = np.concatenate([i, j, i, j]), np.concatenate([i, j, j, i])
        blocks = np.concatenate([H, H, -H, -H])
        order = np.lexsort((columns, rows))
        whole = scipy.sparse.bsr_array(
            (blocks[order], columns[order], compute_row_starts(rows, n)), shape=(3 * n, 3 * n)
        )
        return drop_zeros(scipy.sparse.csr_array(scipy.sparse.coo_array(whole)))


def _row_norms(v: Positions) -> NDArray[np.float64]:
    """Return |v| of each row, (m,)."""
    return np.sqrt(np.einsum("ij,ij->i", v, v))


def vertex_pair_keys(edges: NDArray[np.int64], num_vertices: int) -> NDArray[np.int64]:
    """Return one number for the vertices of each edge, the same for both directions.

    Args:
        edges: vertex pairs (m, 2).
        num_vertices: bound above all vertex indices; keys of different sets compare only with the same bound.

    Returns:
        Keys (m,).
    """
    return num_vertices * edges.min(axis=1, initial=num_vertices) + edges.max(axis=1, initial=0)


def unit_directions(v: Positions, fallback: Positions) -> tuple[NDArray[np.float64], Positions]:
    """Return the length and the unit vector of each row.

    Args:
        v: vectors (m, 3) [m].
        fallback: unit vectors (m, 3) of rows of zero length.

    Returns:
        |v| (m,) [m], and v/|v| (m, 3).
    """
    length = _row_norms(v)
    unit = v / np.maximum(length, ZERO_LENGTH)[:, None]
    zero = length <= ZERO_LENGTH
    unit[zero] = fallback[zero]
    return length, unit


def rest_directions(rest: Positions, edges: NDArray[np.int64]) -> tuple[NDArray[np.float64], Positions]:
    """Return the lengths and directions of edges at rest.

    Edges of zero length get the first axis.

    Args:
        rest: rest positions (n, 3) [m].
        edges: vertex pairs (m, 2).

    Returns:
        Rest lengths (m,) [m], and unit vectors (m, 3) from second to first end.
    """
    i, j = edges.T
    v = rest[i] - rest[j]
    return unit_directions(v, np.tile([1.0, 0.0, 0.0], (len(v), 1)))
