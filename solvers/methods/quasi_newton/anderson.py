"""Anderson acceleration of local-global with an energy safeguard.

Peng, Deng, Zhang, Geng, Qin, Liu 2018, "Anderson Acceleration for Geometry Optimization and Physics Simulation";
Anderson 1965.

    p_(k+1) = LG(p_k) - sum_j theta_j (LG(p_(j+1)) - LG(p_j)),   theta = argmin |F_k - sum_j theta_j (F_(j+1) - F_j)|_Q

with F = LG(p) - p over the most recent iterations. Residuals are compared in the norm of Q, in which F is the gradient
and the inner products are by-products of the iteration. An iterate that does not lower the objective is replaced by
the plain LG(p_k), whose residual is added to the history.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from springbench.solvers.iteration.solver_info import Citation, SolverInfo
from springbench.solvers.kernels.acceleration_coefficients import ANDERSON_RULE
from springbench.solvers.methods.local_global.accelerated_local_global import AccelerationScheme
from springbench.solvers.methods.quasi_newton.windowed_acceleration import (
    WindowedAcceleration,
    prepare_accelerated,
)
from springbench.solvers.model.step_problem import PreparedSolver, System


@dataclass(frozen=True)
class Anderson(WindowedAcceleration):
    """Anderson acceleration.

    Args:
        history_size: number of differences of the most recent iterations to store.
        linear_solver: solver of Q x = b.
        precision: floating-point type of its stored entries.
    """

    solver_info: ClassVar[SolverInfo] = SolverInfo(
        "accelerated local-global",
        Citation(
            "Peng, Yue and Deng, Bailin and Zhang, Juyong and Geng, Fanyu and Qin, Wenjie and Liu, Ligang",
            2018,
            "Anderson acceleration for geometry optimization and physics simulation",
            "10.1145/3197517.3201290",
        ),
        formula="p⁺ = LG(p) − Σ θⱼ ΔLGⱼ, θ by least squares",
        cost="1 solve, 1 pass, dot products",
    )

    def prepare(self, system: System) -> PreparedSolver:
        """Prepare the method for a system.

        Raises:
            Unsupported: if an energy is neither projective nor contact.
            NotPositiveDefinite: if the system leaves some positions undetermined.
        """
        return prepare_accelerated(
            system,
            AccelerationScheme("anderson", ANDERSON_RULE, self.history_size, 0, True),
            self.linear_solver,
            self.precision,
        )
