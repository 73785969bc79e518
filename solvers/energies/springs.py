"""Linear springs (Liu et al. 2013, eq. 7 to 9).

    E(p) = sum_e k_e/2 (|v_e| - r_e)^2,   v = A p,   grad E = A'K (v - d),   d_e = r_e v_e / |v_e|

A spring of zero length has no direction. It takes that of its rest shape, and a fixed one if that has none
either: one convention in the energy's gradient and in every solver, so the same step follows from both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array, coo_array, csr_array

from solvers.matrices import diagonal, signed_incidence_matrix_sparse, without_zeros
from solvers.problem import Positions

TINY = 1e-140
"""Lengths [m] up to this one count as zero: their squares underflow."""


@dataclass(frozen=True, eq=False)
class Springs:
    """Springs between pairs of vertices.

    edges: (m, 2); stiffness: k (m,) [N/m], not negative; rest_length: r (m,) [m], not negative;
    rest_direction: (m, 3), unit vectors that springs of zero length take.
    """

    edges: NDArray[np.int64]
    stiffness: NDArray[np.float64]
    rest_length: NDArray[np.float64]
    rest_direction: NDArray[np.float64]

    @classmethod
    def at_rest(cls, rest: Positions, edges: NDArray[np.int64], stiffness: NDArray[np.float64]) -> Springs:
        """Springs whose rest shape is `rest`, (n, 3) [m], with stiffness (m,) [N/m]."""
        i, j = edges.T
        v = rest[i] - rest[j]
        r = np.linalg.norm(v, axis=1)
        fixed = np.broadcast_to([1.0, 0.0, 0.0], v.shape)
        direction = np.where(r[:, None] > TINY, v / np.maximum(r, TINY)[:, None], fixed)
        return cls(edges, stiffness, r, direction)

    @classmethod
    def joined(cls, parts: Sequence[Springs]) -> Springs:
        """All springs of the parts as one energy, in their order; none at all for no parts."""
        if len(parts) == 1:
            return parts[0]
        none = cls(np.empty((0, 2), np.int64), np.empty(0), np.empty(0), np.empty((0, 3)))
        fields = zip(*((s.edges, s.stiffness, s.rest_length, s.rest_direction) for s in (none, *parts)), strict=True)
        return cls(*(np.concatenate(arrays) for arrays in fields))

    @cached_property
    def _incidence(self) -> tuple[csr_array, csr_array]:
        """A over as many vertices as the springs name, and A'K."""
        A = signed_incidence_matrix_sparse(self.edges, self._named)
        return A, csr_array(A.T @ diagonal(self.stiffness))

    @property
    def _named(self) -> int:
        return int(self.edges.max(initial=-1)) + 1

    def lengths(self, p: Positions) -> NDArray[np.float64]:
        """The length of each spring [m] at p (n, 3), shape (m,)."""
        return _lengths(self._along(p))

    def _along(self, p: Positions) -> Positions:
        """v = A p, (m, 3)."""
        return self._incidence[0] @ p[: self._named]

    def _vectors(self, p: Positions) -> tuple[Positions, NDArray[np.float64], Positions]:
        """v = A p (m, 3), the lengths |v| (m,) and the unit directions (m, 3)."""
        v = self._along(p)
        length = _lengths(v)
        unit = v / np.maximum(length, TINY)[:, None]
        zero = length <= TINY
        unit[zero] = self.rest_direction[zero]
        return v, length, unit

    def value(self, p: Positions) -> float:
        """The elastic energy [J] at p, shape (n, 3)."""
        return 0.5 * float(self.stiffness @ (self.lengths(p) - self.rest_length) ** 2)

    def add_gradient(self, p: Positions, out: Positions) -> None:
        """Add the gradient A'K (A p - d) [N], shape (n, 3), to `out`."""
        v, _, unit = self._vectors(p)
        _, AtK = self._incidence
        out[: self._named] += AtK @ (v - self.rest_length[:, None] * unit)

    def add_projection(self, p: Positions, out: Positions) -> None:
        """The local step: add A'K d(p) [N], shape (n, 3), to `out`."""
        _, _, unit = self._vectors(p)
        _, AtK = self._incidence
        out[: self._named] += AtK @ (self.rest_length[:, None] * unit)

    def stiffness_matrix(self, n: int) -> csr_array:
        """A'KA [N/m], shape (n, n), its share of Q."""
        A = signed_incidence_matrix_sparse(self.edges, n)
        return without_zeros(A.T @ diagonal(self.stiffness) @ A)

    def hessian(self, p: Positions) -> csr_array:
        """The Hessian [N/m], shape (3n, 3n): k (nn' + (1 - r/l)(I - nn')) a spring, n its direction, l its length.

        A spring of zero length and positive rest length has no lateral curvature; it is given none.
        """
        _, length, unit = self._vectors(p)
        ratio = np.divide(self.rest_length, length, out=np.ones_like(length), where=length > TINY)
        lateral = np.where(self.rest_length == 0.0, 1.0, 1.0 - ratio)
        nn = unit[:, :, None] * unit[:, None, :]
        H = self.stiffness[:, None, None] * (nn + lateral[:, None, None] * (np.eye(3) - nn))
        n, (i, j) = len(p), self.edges.T
        rows, columns = np.concatenate([i, j, i, j]), np.concatenate([i, j, j, i])
        blocks = np.concatenate([H, H, -H, -H])
        order = np.lexsort((columns, rows))
        counts = np.bincount(rows, minlength=n)
        indptr = np.concatenate([[0], np.cumsum(counts)])
        full = bsr_array((blocks[order], columns[order], indptr), shape=(3 * n, 3 * n))
        return without_zeros(csr_array(coo_array(full)))


def _lengths(v: Positions) -> NDArray[np.float64]:
    return np.sqrt(np.einsum("ij,ij->i", v, v))
