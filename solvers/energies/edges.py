"""What energies along pairs of vertices share: v = A p, forces A'f, the share A'KA of Q, and 3 x 3 blocks."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy
from numpy.typing import NDArray

from solvers.matrices import diagonal, signed_incidence_matrix_sparse, without_zeros
from solvers.problem import Positions

TINY = 1e-140
"""Lengths [m] up to this one count as zero: their squares underflow."""


@dataclass(frozen=True, eq=False)
class Edges:
    """Pairs of vertices.

    edges: (m, 2); stiffness: k (m,) [N/m], not negative.
    """

    edges: NDArray[np.int64]
    stiffness: NDArray[np.float64]

    def lengths(self, p: Positions) -> NDArray[np.float64]:
        """The length of each edge [m] at p (n, 3), shape (m,)."""
        return lengths(self._along(p))

    def stiffness_matrix(self, n: int) -> scipy.sparse.csr_array:
        """A'KA [N/m], shape (n, n), its share of Q."""
        A = signed_incidence_matrix_sparse(self.edges, n)
        return without_zeros(A.T @ diagonal(self.stiffness) @ A)

    @property
    def _named(self) -> int:
        return int(self.edges.max(initial=-1)) + 1

    @cached_property
    def _incidence(self) -> tuple[scipy.sparse.csr_array, scipy.sparse.csr_array]:
        """A over as many vertices as the edges name, and A'K."""
        A = signed_incidence_matrix_sparse(self.edges, self._named)
        return A, scipy.sparse.csr_array(A.T @ diagonal(self.stiffness))

    def _along(self, p: Positions) -> Positions:
        """v = A p, (m, 3)."""
        return self._incidence[0] @ p[: self._named]

    def _add(self, x: Positions, out: Positions) -> None:
        """Add A'K x to `out`, x: (m, 3)."""
        out[: self._named] += self._incidence[1] @ x

    def _add_absolute(self, terms: NDArray[np.float64], out: NDArray[np.float64]) -> None:
        """Add k times the terms (m,) [m] of each edge to `out` (n,) at both of its ends; a self-loop has none."""
        (i, j), terms = self.edges.T, self.stiffness * terms
        terms = np.where(i != j, terms, 0.0)
        for end in (i, j):
            out += np.bincount(end, terms, minlength=len(out))

    def _reach(self, p: Positions) -> NDArray[np.float64]:
        """|p_i| + |p_j| of each edge (m,) [m]: what the rounding of its ends is in proportion to."""
        size = lengths(p)
        return size[self.edges[:, 0]] + size[self.edges[:, 1]]

    def _blocks(
        self, lateral: NDArray[np.float64], unit: Positions, n: int, along: float | NDArray = 1.0
    ) -> scipy.sparse.csr_array:
        """The Hessian (3n, 3n) of edges that resist by k (along nn' + lateral (I - nn')), n their unit directions."""
        nn = unit[:, :, None] * unit[:, None, :]
        full = np.reshape(along, (-1, 1, 1)) * nn + lateral[:, None, None] * (np.eye(3) - nn)
        H, (i, j) = self.stiffness[:, None, None] * full, self.edges.T
        rows, columns = np.concatenate([i, j, i, j]), np.concatenate([i, j, j, i])
        blocks = np.concatenate([H, H, -H, -H])
        order = np.lexsort((columns, rows))
        indptr = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=n))])
        whole = scipy.sparse.bsr_array((blocks[order], columns[order], indptr), shape=(3 * n, 3 * n))
        return without_zeros(scipy.sparse.csr_array(scipy.sparse.coo_array(whole)))


def lengths(v: Positions) -> NDArray[np.float64]:
    """|v| of each row, (m,)."""
    return np.sqrt(np.einsum("ij,ij->i", v, v))


def directions(v: Positions, fallback: Positions) -> tuple[NDArray[np.float64], Positions]:
    """|v| (m,) and v/|v| (m, 3) of each row; a row of zero length takes its fallback."""
    length = lengths(v)
    unit = v / np.maximum(length, TINY)[:, None]
    zero = length <= TINY
    unit[zero] = fallback[zero]
    return length, unit


def rest_directions(rest: Positions, edges: NDArray[np.int64]) -> tuple[NDArray[np.float64], Positions]:
    """The rest lengths (m,) [m] and directions (m, 3); edges of zero length take the first coordinate's."""
    i, j = edges.T
    v = rest[i] - rest[j]
    return directions(v, np.tile([1.0, 0.0, 0.0], (len(v), 1)))
