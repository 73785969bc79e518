"""Quadratic energies, which are in Q except for a constant force and need no projection.

    E(p) = sum_e w_e/2 |(A p)_e - d_e|^2,   grad E = A'W (A p - d)

They include linear damping of A v: since the stage moves with the velocity velocity_rate (x - velocity_origin), the
force -A'C A v is the gradient for W = C velocity_rate and d = A velocity_origin.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import scipy
from numpy.typing import NDArray
from springbench.solvers.model.step_problem import Energy, Positions, StepStart
from springbench.solvers.model.system_matrix_assembly import diagonal_matrix, drop_zeros


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
        """Add the gradient A'W (A p - d) to `out`.

        Args:
            p: positions (n, 3) [m].
            out: sum of gradients (n, 3) [N], updated.
        """
        out += self._weighted_transpose(self.A @ p - self.d)

    def add_absolute_terms(self, p: Positions, out: NDArray[np.float64]) -> None:
        """Add |A|'W (|A| |p| + |d|) [N] to `out` (`rounding_bound`).

        Args:
            p: positions (n, 3) [m].
            out: sum of absolute terms (n,) [N], updated.
        """
        size = abs(self.A)
        out += size.T @ (self.weight * (size @ np.linalg.norm(p, axis=1) + np.linalg.norm(self.d, axis=1)))

    def add_projection(self, p: Positions, out: Positions) -> None:
        """Add A'W d to `out`.

        Args:
            p: positions (n, 3) [m], not used, because d does not depend on them.
            out: right-hand side (n, 3) [N], updated.
        """
        out += self._weighted_transpose(self.d)

    def _weighted_transpose(self, x: Positions) -> Positions:
        """Return A'W x, (n, 3), of x (m, 3)."""
        return self.A.T @ (self.weight[:, None] * x)

    def stiffness_matrix(self, n: int) -> scipy.sparse.csr_array:
        """Return A'WA [N/m], shape (n, n)."""
        return drop_zeros(self.A.T @ diagonal_matrix(self.weight) @ self.A)

    def hessian(self, p: Positions) -> scipy.sparse.csr_array:
        """Return the Hessian [N/m], shape (3n, 3n), which does not depend on p."""
        return drop_zeros(
            scipy.sparse.csr_array(scipy.sparse.kron(self.stiffness_matrix(len(p)), np.eye(3), format="csr"))
        )


@dataclass(frozen=True, eq=False)
class ViscousDamping(Quadratic):
    """Linear damping of A v.

    The weight is c (m,) [N s/m] initially, i.e. c velocity_rate [N/m] at a rate of 1/s, and c velocity_rate in a step.
    """

    is_dissipative: ClassVar[bool] = True
    """Whether the gradient is a damping force, which stores no energy."""

    @classmethod
    def from_operator(cls, A: scipy.sparse.csr_array, damping: NDArray[np.float64]) -> ViscousDamping:
        """Return damping of A v.

        Undamped rows are omitted.

        Args:
            A: sparse matrix (m, n).
            damping: coefficients c (m,) [N s/m] divided by the unit of A squared.
        """
        damped = np.flatnonzero(damping)
        return cls(scipy.sparse.csr_array(A[damped]), damping[damped], np.zeros((len(damped), 3)))

    @classmethod
    def from_vertices(cls, damping: NDArray[np.float64]) -> ViscousDamping:
        """Return damping of each vertex's velocity, c (n,) [N s/m]."""
        return cls.from_operator(diagonal_matrix(np.ones(len(damping))), damping)

    def begin_step(self, start: StepStart) -> ViscousDamping:
        """Return the energy of a step."""
        return replace(self, weight=start.velocity_rate * self.weight, d=self.A @ start.velocity_origin)


def drag_of_vertices(energy: Energy) -> NDArray[np.float64] | None:
    """Return the coefficients c (n,) [N s/m] of an energy that damps single vertices; None for other energies."""
    if isinstance(energy, ViscousDamping) and (np.diff(energy.A.indptr) == 1).all():
        return energy.A.power(2).T @ energy.weight
    return None


class AirDrag(ViscousDamping):
    """Drag of each vertex, proportional to its velocity."""


class EtherDrag(ViscousDamping):
    """Drag of each vertex, proportional to its mass and its velocity."""


class RayleighDamping(ViscousDamping):
    """The part of Rayleigh damping proportional to the masses, or to a quadratic energy's matrix."""
