"""Quadratic energies: nothing to project, and all of them but a constant force is in Q.

    E(p) = sum_e w_e/2 |(A p)_e - d_e|^2,   grad E = A'W (A p - d)

Linear damping of A v is one of them: since the unknown moves with the velocity rate (x - origin), the force
-A'C A v is the gradient for W = C rate and d = A origin.
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

    A: (m, n), sparse; weight: w (m,) [N/m] in the unit of A squared, not negative; d: (m, 3) [m] in the unit of A.
    """

    A: scipy.sparse.csr_array
    weight: NDArray[np.float64]
    d: Positions

    def value(self, p: Positions) -> float:
        """The energy [J] at p, shape (n, 3)."""
        away = self.A @ p - self.d
        return 0.5 * float(self.weight @ np.einsum("ij,ij->i", away, away))

    def add_gradient(self, p: Positions, out: Positions) -> None:
        """Add the gradient [N], shape (n, 3), to `out`."""
        out += self._pulled(self.A @ p - self.d)

    def add_absolute_terms(self, p: Positions, out: NDArray[np.float64]) -> None:
        """Add |A|'W (|A| |p| + |d|) [N] to `out` (n,) (`solvers.round_off`)."""
        size = abs(self.A)
        out += size.T @ (self.weight * (size @ np.linalg.norm(p, axis=1) + np.linalg.norm(self.d, axis=1)))

    def add_projection(self, p: Positions, out: Positions) -> None:
        """Add A'W d [N], shape (n, 3), the same for any p, to `out`."""
        out += self._pulled(self.d)

    def _pulled(self, x: Positions) -> Positions:
        """A'W x, (n, 3), of x (m, 3)."""
        return self.A.T @ (self.weight[:, None] * x)

    def stiffness_matrix(self, n: int) -> scipy.sparse.csr_array:
        """A'WA [N/m], shape (n, n)."""
        return without_zeros(self.A.T @ diagonal(self.weight) @ self.A)

    def hessian(self, p: Positions) -> scipy.sparse.csr_array:
        """The Hessian [N/m], shape (3n, 3n), the same for any p."""
        return without_zeros(
            scipy.sparse.csr_array(scipy.sparse.kron(self.stiffness_matrix(len(p)), np.eye(3), format="csr"))
        )


@dataclass(frozen=True, eq=False)
class Viscous(Quadratic):
    """Linear damping of A v.

    weight: c (m,) [N s/m] as made, which is c rate [N/m] at a rate of 1/s, and c rate once a step has begun.
    """

    @classmethod
    def of(cls, A: scipy.sparse.csr_array, damping: NDArray[np.float64]) -> Viscous:
        """Damping of A v, A: (m, n), with coefficients c (m,) [N s/m]; rows without damping are left out."""
        damped = np.flatnonzero(damping)
        return cls(scipy.sparse.csr_array(A[damped]), damping[damped], np.zeros((len(damped), 3)))

    @classmethod
    def of_vertices(cls, damping: NDArray[np.float64]) -> Viscous:
        """Damping of each vertex's velocity, c (n,) [N s/m]."""
        return cls.of(diagonal(np.ones(len(damping))), damping)

    def begin_step(self, start: Start) -> Viscous:
        """The energy of a step."""
        return replace(self, weight=start.rate * self.weight, d=self.A @ start.origin)


def drag_of_vertices(energy: Energy) -> NDArray[np.float64] | None:
    """The coefficients c (n,) [N s/m] of an energy that damps each vertex by itself, None of any other."""
    if isinstance(energy, Viscous) and (np.diff(energy.A.indptr) == 1).all():
        return energy.A.power(2).T @ energy.weight
    return None


class AirDrag(Viscous):
    """Drag of each vertex, in proportion to its velocity."""


class EtherDrag(Viscous):
    """Drag of each vertex, in proportion to its mass and its velocity."""


class RayleighDamping(Viscous):
    """The part of Rayleigh damping that is in proportion to masses, or to the matrix of a quadratic energy."""
