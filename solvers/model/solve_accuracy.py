"""Accuracy of the global step Q p = b with a factor in floating point.

    |dp| <= eps cond |p|,   cond <= 2 max_i Q_ii / (Q 1)_i    over the free rows and columns, scaled by D = diag(Q 1)

A solve by Cholesky factors has a relative error of about eps times the condition number (Higham 2002, Accuracy and
Stability of Numerical Algorithms, sections 10.1 and 14.1). The rows of the matrix of springs have entries of one sign
off the diagonal, and their sums (Q 1)_i are the inertia, the weight of a penalty pin and the stiffness towards exact
pins. By Gershgorin's theorem the eigenvalues of D^-1 Q are then between 1 and 2 max_i Q_ii / (Q 1)_i - 1: the condition
number is large where a vertex with little inertia has stiff springs and no pin near it. Bending and attachments have
entries of both signs, for which this is an estimate.

The error is relative to the coordinates, and matters in comparison with the length of a spring: the digits that remain
are -log10(eps cond |p| / length). The bound is about 20 times the error of usual meshes.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import floor, log10

import numpy as np
import scipy
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.step_problem import Positions, ProjectiveEnergy, System
from springbench.solvers.model.system_matrix_assembly import add_stiffness_shares, compute_anchor_diagonal


def diagonal_dominance_ratio(Q: scipy.sparse.csr_array) -> float:
    """Return max_i Q_ii / (Q 1)_i; infinite if a row sum is zero or round-off.

    Args:
        Q: free rows and columns of a system matrix (f, f).
    """
    sums, diagonal = Q.sum(axis=1), Q.diagonal()
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        found = np.where(sums > 0.0, diagonal / np.maximum(sums, 0.0), np.inf)
    return float(found.max(initial=1.0))


def relative_solve_error(ratio: float, precision: str = "float64") -> float:
    """Return the bound of the relative error of a solve.

    Args:
        ratio: result of `diagonal_dominance_ratio`.
        precision: floating-point type of the factor.
    """
    return 2.0 * float(np.finfo(precision).eps) * ratio


@dataclass(frozen=True, slots=True)
class SolveAccuracy:
    """Accuracy of solves for positions, or for corrections by a rounded factor.

    Attributes:
        condition: bound of the condition number.
        max_coordinate: largest coordinate [m].
        spring_length: median rest length of the springs [m]; infinite without springs.
        trace: trace of the free part of the matrix [N/m].
        precision: floating-point type of the factor.
    """

    condition: float
    max_coordinate: float
    spring_length: float
    trace: float
    precision: str

    @classmethod
    def from_system(cls, system: System, p: Positions, precision: str = "float64") -> SolveAccuracy | None:
        """Estimate the accuracy of solves at positions p (n, 3) [m].

        Args:
            system: the system, of which the projective energies count.
            p: positions (n, 3) [m].
            precision: floating-point type of the factor.

        Returns:
            The estimate; None if a free vertex has neither mass nor a pin, where the bound is infinite and states
            nothing.
        """
        free = system.free_vertices
        if not (len(free) and compute_anchor_diagonal(system)[free].all()):
            return None
        Q = add_stiffness_shares(system, [one for one in system.energies if isinstance(one, ProjectiveEnergy)])
        inner = scipy.sparse.csr_array(Q[free][:, free])
        lengths = Springs.from_parts([one for one in system.energies if isinstance(one, Springs)]).rest_length
        lengths = lengths[lengths > 0.0]
        return cls(
            2.0 * diagonal_dominance_ratio(inner),
            float(np.abs(p).max(initial=0.0)),
            float(np.median(lengths)) if len(lengths) else np.inf,
            float(inner.diagonal().sum()),
            precision,
        )

    @property
    def relative_error(self) -> float:
        """Bound of the relative error of a solve."""
        return relative_solve_error(0.5 * self.condition, self.precision)

    @property
    def num_digits(self) -> float:
        """Least number of digits of a spring's length, or of a correction, after rounding."""
        reach = self.max_coordinate / self.spring_length if self.precision == "float64" else 1.0
        error = self.relative_error * reach
        return max(-log10(error), 0.0) if error > 0.0 else np.inf

    def explains_residual(self, residual: float) -> bool:
        """Return whether rounding errors may be as large as a residual [J^(1/2)].

        Corrections by a factor of low precision may be wrong altogether if they have no digit.
        """
        if self.precision != "float64":
            return self.num_digits < 1.0
        return residual <= self.relative_error * self.max_coordinate * self.trace**0.5

    def __str__(self) -> str:
        """Return the cause of rounding errors, and the digits that remain."""
        digits = floor(min(self.num_digits, 15.0))
        certain = f"only about {digits} digit{'s are' if digits > 1 else ' is'}" if digits else "no digit is"
        limit = f"up to {self.condition:.0e}" if self.condition < np.inf else "without a bound"
        cause = f"entries of the system matrix have mixed scales (condition number {limit})"
        if self.precision != "float64":
            return f"{cause}, and {certain} certain in a correction by a factor in {self.precision}"
        return (
            f"{cause} and coordinates reach {self.max_coordinate:.2g} m, so that {certain} certain in positions from "
            "solves in float64, relative to a spring's length"
        )
