"""Chebyshev semi-iterative acceleration of local-global.

Wang 2015, "A Chebyshev Semi-Iterative Approach for Accelerating Projective and Position-Based Dynamics"; Golub and
Varga 1961.

    p_(k+1) = omega_(k+1) (gamma (LG(p_k) - p_k) + p_k - p_(k-1)) + p_(k-1)
    omega_1 = 1,   omega_2 = 2 / (2 - sigma^2),   omega_(k+1) = 4 / (4 - sigma^2 omega_k)

The plain iteration multiplies errors by I - Q^-1 H, whose eigenvalues lie in [0, rho], because Q majorises the
Hessian H. The polynomials are therefore those of [0, rho] instead of Wang's [-rho, rho]: gamma = 2 / (2 - rho) and
sigma = rho / (2 - rho).

rho is estimated during the iteration (Hageman and Young 1981, chapters 5 and 6). The first estimate is the ratio of two
residuals of the plain iteration. If the residuals then decrease more slowly than the polynomial of the current rho
predicts, an eigenvalue lies beyond rho. It is computed from the ratio of the actual and the predicted decrease, and a
new polynomial starts. An iterate that would raise the objective is replaced by the plain LG(p_k), and a new polynomial
starts there too.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from springbench.solvers.iteration.solver_info import Citation, SolverInfo
from springbench.solvers.kernels.acceleration_coefficients import CHEBYSHEV_RULE
from springbench.solvers.linalg.solver_selection import LinearSolverName, Precision
from springbench.solvers.methods.local_global.accelerated_local_global import AccelerationScheme
from springbench.solvers.methods.quasi_newton.windowed_acceleration import prepare_accelerated
from springbench.solvers.model.step_problem import PreparedSolver, System


@dataclass(frozen=True)
class Chebyshev:
    """Chebyshev acceleration.

    Args:
        linear_solver: solver of Q x = b.
        precision: floating-point type of its stored entries.
    """

    is_minimiser: ClassVar[bool] = True
    is_monotone: ClassVar[bool] = True
    solver_info: ClassVar[SolverInfo] = SolverInfo(
        "accelerated local-global",
        Citation(
            "Wang, Huamin",
            2015,
            "A Chebyshev semi-iterative approach for accelerating projective and position-based dynamics",
            "10.1145/2816795.2818063",
        ),
        formula="p⁺ = ω (LG(p) − p⁻) + p⁻",
        cost="1 solve, 1 pass",
    )

    linear_solver: LinearSolverName = "auto"
    precision: Precision = "float64"

    def prepare(self, system: System) -> PreparedSolver:
        """Prepare the method for a system.

        Raises:
            Unsupported: if an energy is neither projective nor contact.
            NotPositiveDefinite: if the system leaves some positions undetermined.
        """
        return prepare_accelerated(
            system, AccelerationScheme("chebyshev", CHEBYSHEV_RULE, 1, 0, True), self.linear_solver, self.precision
        )
