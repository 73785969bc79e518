"""Quadratic energies, which are in Q except for a constant force and need no projection.

    E(p) = sum_e w_e/2 |(A p)_e - d_e|^2,   grad E = A'W (A p - d)

They include linear damping of A v: since the stage moves with the velocity rate (x - origin), the
force -A'C A v is the gradient for W = C rate and d = A origin.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from solvers.matrices import diagonal, without_zeros
from solvers.problem import Energy, Positions, Start


@dataclass(frozen=True, eq=False)
class Quadratic:
    """A sum of squares of linear functions of the positions.

    Attributes:
        A: sparse matrix (m, n).
        weight: w (m,) [N/m] divided by the unit of A squared, not negative.
        d: (m, 3) [m] times the unit of A.
    """

    A: scipy.sparse.csr_array
    weight: NDArray[np.float64]
    d: Positions

    def value(self, p: Positions) -> float:
        """Return the energy [J] at p, shape (n, 3)."""
        away = self.A @ p - self.d
        return 0.5 * float(self.weight @ np.einsum("ij,ij->i", away, away))

    def add_gradient(self, p: Positions, out: Positions) -> None:
        """Add the gradient [N], shape (n, 3), to `out`."""
        out += self._pulled(self.A @ p - self.d)

    def add_absolute_terms(self, p: Positions, out: NDArray[np.float64]) -> None:
        """Add |A|'W (|A| |p| + |d|) [N] to `out` (n,) (`rounding_bound`)."""
        size = abs(self.A)
        out += size.T @ (self.weight * (size @ np.linalg.norm(p, axis=1) + np.linalg.norm(self.d, axis=1)))

    def add_projection(self, p: Positions, out: Positions) -> None:
        """Add A'W d [N], shape (n, 3), which does not depend on p, to `out`."""
        out += self._pulled(self.d)

    def _pulled(self, x: Positions) -> Positions:
        """Return A'W x, (n, 3), of x (m, 3)."""
        return self.A.T @ (self.weight[:, None] * x)

    def stiffness_matrix(self, n: int) -> scipy.sparse.csr_array:
        """Return A'WA [N/m], shape (n, n)."""
        return without_zeros(self.A.T @ diagonal(self.weight) @ self.A)

    def hessian(self, p: Positions) -> scipy.sparse.csr_array:
        """Return the Hessian [N/m], shape (3n, 3n), which does not depend on p."""
        return without_zeros(
            scipy.sparse.csr_array(scipy.sparse.kron(self.stiffness_matrix(len(p)), np.eye(3), format="csr"))
        )


@dataclass(frozen=True, eq=False)
class Viscous(Quadratic):
    """Linear damping of A v.

    The weight is c (m,) [N s/m] initially, i.e. c rate [N/m] at a rate of 1/s, and c rate in a step.
    """

    @classmethod
    def of(cls, A: scipy.sparse.csr_array, damping: NDArray[np.float64]) -> Viscous:
        """Return damping of A v, A: (m, n), with coefficients c (m,) [N s/m].

        Undamped rows are omitted.
        """
        damped = np.flatnonzero(damping)
        return cls(scipy.sparse.csr_array(A[damped]), damping[damped], np.zeros((len(damped), 3)))

    @classmethod
    def of_vertices(cls, damping: NDArray[np.float64]) -> Viscous:
        """Return damping of each vertex's velocity, c (n,) [N s/m]."""
        return cls.of(diagonal(np.ones(len(damping))), damping)

    def begin_step(self, start: Start) -> Viscous:
        """Return the energy of a step."""
        return replace(self, weight=start.rate * self.weight, d=self.A @ start.origin)


def drag_of_vertices(energy: Energy) -> NDArray[np.float64] | None:
    """Return the coefficients c (n,) [N s/m] of an energy that damps single vertices; None for other energies."""
    if isinstance(energy, Viscous) and (np.diff(energy.A.indptr) == 1).all():
        return energy.A.power(2).T @ energy.weight
    return None


class AirDrag(Viscous):
    """Drag of each vertex, proportional to its velocity."""


class EtherDrag(Viscous):
    """Drag of each vertex, proportional to its mass and its velocity."""


class RayleighDamping(Viscous):
    """The part of Rayleigh damping proportional to the masses, or to the matrix of a quadratic energy."""
