"""Linearised implicit Euler (Baraff and Witkin 1998): one factorisation per step, no iteration.

    (M/dt^2 + D/dt + K) (x - p) = f(p) + M v/dt,    K and D the derivatives of the forces at the start p

This is the first Newton step on the objective g from the start of the frame: (H + E) (x - p) = -grad g(p). Most cloth
codes use it. It has the order of the integrator that defines the step, 1 with implicit Euler and 2 with BDF2 (Choi and
Ko 2002) and midpoint. The accuracy of a step cannot be controlled: where springs rotate far in one step, x is far from
the minimum. E is zero wherever H has a Cholesky factor. Where compressed springs leave it none, part of their negative
lateral stiffness is removed, and if necessary all of it (`springbench.solvers.methods.newton.hessian_regularisation`);
Choi and Ko always remove all of it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.contact.half_space.vertex_contact import is_vertex_contact
from springbench.solvers.iteration.iterative_solver import IterativeSolver, SolverState
from springbench.solvers.iteration.solver_info import Citation, SolverInfo
from springbench.solvers.methods.newton.hessian_regularisation import explain_missing_factor, factorise_shifted
from springbench.solvers.methods.time_stepping.explicit_forces import SingleIterateState
from springbench.solvers.model import system_matrix_assembly
from springbench.solvers.model.barrier_energy import is_barrier_energy
from springbench.solvers.model.step_problem import (
    NotPositiveDefinite,
    Positions,
    ProjectiveEnergy,
    ResidualIterate,
    StepProblem,
    System,
    Unsupported,
)
from springbench.solvers.objective.fixed_objective import FixedObjective
from springbench.solvers.objective.step_objective import StepObjective


@dataclass(frozen=True)
class BaraffWitkin:
    """Linearised implicit Euler: one iterate, independent of stop rule and initial guess."""

    is_minimiser: ClassVar[bool] = False
    is_monotone: ClassVar[bool] = False
    solver_info: ClassVar[SolverInfo] = SolverInfo(
        "linearly implicit",
        Citation("Baraff, David and Witkin, Andrew", 1998, "Large steps in cloth simulation", "10.1145/280814.280821"),
        is_family_default=True,
        formula="p⁺ = p − H⁻¹ ∇g, once per step",
        cost="1 factorisation, 1 solve",
    )

    def prepare(self, system: System) -> PreparedBaraffWitkin:
        """Prepare the method for a system.

        Raises:
            Unsupported: for contact, which starts and ends within a step, and for integrators with several stages,
                which require solved stages.
        """
        if system.velocity_factor is not None:
            raise Unsupported(
                "baraff-witkin: linearises a single stage per step, and this integrator requires solved stages; "
                "use implicit-euler, bdf2 or midpoint, or a Rosenbrock method: ros2, ros3p, rodas"
            )
        if met := next((e for e in system.energies if is_vertex_contact(e) or is_barrier_energy(e)), None):
            raise Unsupported(
                f"baraff-witkin: linearises at the step's start, where contacts that begin in the step are unknown; "
                f"the scene has {type(met).__name__}; take a solver that minimises"
            )
        objective = FixedObjective(system)
        Q = system_matrix_assembly.assemble_system_matrix(
            system, [e for e in system.energies if isinstance(e, ProjectiveEnergy)]
        )
        factor = objective.hessian_matrix.factor
        choice = f"a factor of the Hessian with {factor.nonzeros:,} entries{objective.interpreted_energies}"
        facts = {"nnz_hessian_factor": float(factor.nonzeros)}
        diagonal: NDArray[np.float64] = np.repeat(np.asarray(Q.diagonal(), np.float64)[system.free_vertices], 3)
        return PreparedBaraffWitkin(objective, diagonal, choice, facts)


@dataclass(frozen=True, eq=False)
class PreparedBaraffWitkin(IterativeSolver):
    """Linearised implicit Euler, prepared for a system.

    `system_diagonal` is the diagonal of the free part of Q (3 f,) [N/m].
    """

    residual_iterate: ClassVar[ResidualIterate] = "none"

    fixed_objective: FixedObjective
    system_diagonal: NDArray[np.float64]
    description: str
    stats: dict[str, float] = field(default_factory=dict[str, float])

    def init_state(self, problem: StepProblem, initial_guess: Positions) -> SolverState:
        """Start a solve whose only iteration is the whole step.

        Args:
            problem: step whose objective is linearised at the current positions.
            initial_guess: not used.

        Raises:
            NotPositiveDefinite: if no modification of the Hessian has a Cholesky factor.
        """
        step = StepObjective(self.fixed_objective, problem)
        p = step.apply_exact_pins(problem.current_positions)
        hessian = step.hessian(p)
        if factorise_shifted(hessian, self.system_diagonal) is None:
            cause = explain_missing_factor(hessian, "the diagonal of Q")
            raise NotPositiveDefinite(f"at the start of the step {cause}")
        return SingleIterateState(step.apply_exact_pins(p - hessian.solve(step.gradient(p))), None)
