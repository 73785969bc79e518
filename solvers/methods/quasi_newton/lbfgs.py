"""L-BFGS with the prefactored matrix Q as initial metric.

Liu, Bouaziz, Kavan 2017, "Quasi-Newton Methods for Real-Time Simulation of Hyperelastic Materials"; Nocedal 1980.

    d = -H grad g(p),   H from H0 = gamma Q^-1 and the last pairs s = p' - p, y = grad g(p') - grad g(p)

gamma = s y / y Q^-1 y of the newest pair; the paper uses 1. This choice saves a third of the iterations on stiff
cloths. With no pair the direction is that of a local-global iteration. The step size is 1 unless the objective does not
decrease sufficiently; the line search then shortens it. A pair is stored if s y > .01 y Q^-1 y: where the Hessian is
positive and below Q, s y is at least y Q^-1 y, and H stays positive definite. All energies are supported; those that
are not projective do not contribute to Q.

`preconditioner: a-jacobi` replaces Q^-1 by S, the aggregate of several Jacobi sweeps
(`springbench.solvers.methods.local_global.aggregated_jacobi`): a product with a sparse matrix, which suits a graphics
processor.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Literal

from springbench.solvers.contact.half_space.vertex_contact import without_vertex_contact
from springbench.solvers.iteration.descent_method import ResidualMetric
from springbench.solvers.iteration.iterative_solver import IterativeSolver, SolverState
from springbench.solvers.iteration.solver_info import Citation, SolverInfo
from springbench.solvers.kernels.acceleration_coefficients import LBFGS_RULE
from springbench.solvers.kernels.free_components import FreeComponents
from springbench.solvers.methods.local_global.accelerated_local_global import AccelerationScheme, InterpretedState
from springbench.solvers.methods.local_global.aggregated_jacobi import AggregatedSweeps, require_valid_sweeps
from springbench.solvers.methods.local_global.prefactored import PreparedLocalGlobal, prepare_local_global
from springbench.solvers.methods.quasi_newton.windowed_acceleration import (
    PreparedAccelerated,
    WindowedAcceleration,
    prepare_accelerated,
    prepare_without_barriers,
)
from springbench.solvers.model.barrier_energy import without_barriers
from springbench.solvers.model.step_problem import (
    Positions,
    PreparedSolver,
    ProjectiveEnergy,
    StepProblem,
    System,
    Unsupported,
)
from springbench.solvers.objective.fixed_objective import FixedObjective
from springbench.solvers.objective.step_objective import StepObjective


@dataclass(frozen=True)
class Lbfgs(WindowedAcceleration):
    """L-BFGS, preconditioned.

    Args:
        history_size: number of stored pairs, those of the most recent iterations.
        linear_solver: solver of Q x = b.
        precision: floating-point type of its stored entries.
        preconditioner: initial metric, Q^-1 or its Jacobi approximation.
        jacobi_sweeps: number of Jacobi sweeps of that approximation, 1 to 8.
    """

    omitted_defaults: ClassVar[frozenset[str]] = frozenset({"preconditioner", "jacobi_sweeps"})

    solver_info: ClassVar[SolverInfo] = SolverInfo(
        "quasi-Newton",
        Citation(
            "Liu, Tiantian and Bouaziz, Sofien and Kavan, Ladislav",
            2017,
            "Quasi-Newton methods for real-time simulation of hyperelastic materials",
            "10.1145/2990496",
        ),
        is_family_default=True,
        supports_error_control=True,
        formula="d = −H ∇g, H from γ Q⁻¹ and recent pairs",
        cost="1 solve, 1 or 2 passes",
    )

    preconditioner: Literal["cholesky", "a-jacobi"] = "cholesky"
    jacobi_sweeps: int = 2

    def __post_init__(self) -> None:
        """Raise ValueError if a parameter is out of range."""
        super().__post_init__()
        require_valid_sweeps(self.jacobi_sweeps)
        if self.preconditioner == "cholesky":
            return
        if self.linear_solver != "auto":
            raise ValueError(
                f"linear_solver: {self.linear_solver} is for `preconditioner: cholesky`; a-jacobi solves no system"
            )
        if self.precision != "float64":
            raise ValueError(f"precision: {self.precision} is for `preconditioner: cholesky`; remove it")

    def prepare(self, system: System) -> PreparedSolver:
        """Prepare the method for a system.

        Raises:
            NotPositiveDefinite: if the system leaves some positions undetermined.
            Unsupported: if Q does not fit in memory, and for contact with the Jacobi preconditioner.
        """
        if self.preconditioner == "a-jacobi" and without_barriers(without_vertex_contact(system)) is not system:
            raise Unsupported(
                "lbfgs, preconditioner: a-jacobi: its matrix is built once and does not include contact; use "
                "`preconditioner: cholesky`"
            )
        if self.preconditioner == "cholesky":
            return prepare_accelerated(system, self._acceleration_scheme, self.linear_solver, self.precision)
        words, scheme, metric = (
            f"{self.jacobi_sweeps} sweeps of Jacobi",
            self._acceleration_scheme,
            ResidualMetric(system),
        )
        energies = [energy for energy in system.energies if isinstance(energy, ProjectiveEnergy)]
        base = prepare_local_global(system, energies, lambda Q: (AggregatedSweeps(Q, self.jacobi_sweeps), words))
        return _PreparedLbfgsJacobi(base, metric, scheme, FixedObjective(system))

    def prepare_with_sweeps(self, system: System, free_components: FreeComponents) -> PreparedAccelerated:
        """Prepare rounds that alternate with sweeps, with the factor of Q and without barrier energies.

        Args:
            system: the system.
            free_components: its components whose translation only inertia resists.

        Raises:
            NotPositiveDefinite: if the system leaves some positions undetermined.
            Unsupported: if Q does not fit in memory.
        """
        from springbench.solvers.methods.quasi_newton import lbfgs_with_sweeps  # imported only for the hybrid

        return prepare_without_barriers(
            system,
            self._acceleration_scheme,
            self.linear_solver,
            self.precision,
            partial(lbfgs_with_sweeps.LbfgsSweepEngine, free_components=free_components),
        )

    @property
    def _acceleration_scheme(self) -> AccelerationScheme:
        return AccelerationScheme("lbfgs", LBFGS_RULE, self.history_size, 5, False)


class _PreparedLbfgsJacobi(IterativeSolver):
    """L-BFGS with S in place of the factor of Q, prepared.

    Residuals are measured by a separate metric.
    """

    def __init__(
        self, base: PreparedLocalGlobal, metric: ResidualMetric, scheme: AccelerationScheme, objective: FixedObjective
    ) -> None:
        self._local_global, self._metric, self._acceleration_scheme, self._fixed_objective = (
            base,
            metric,
            scheme,
            objective,
        )
        self.description = f"{base.description}; for the residual alone {metric.description}"
        self.stats = base.stats

    def init_state(self, problem: StepProblem, initial_guess: Positions) -> SolverState:
        """Start a solve from an initial guess (n, 3) [m]."""
        step = StepObjective(self._fixed_objective, problem)
        return _LbfgsJacobiState(self._metric, self._local_global, self._acceleration_scheme, step, initial_guess)

    def residual_scale(self, problem: StepProblem) -> float:
        """Return the residual scale [J^(1/2)] for the round-off check."""
        return self._local_global.residual_scale(problem)


class _LbfgsJacobiState(InterpretedState):
    """State of a solve with the Jacobi preconditioner.

    Residuals are measured with the factor of Q.
    """

    def __init__(
        self,
        metric: ResidualMetric,
        base: PreparedLocalGlobal,
        scheme: AccelerationScheme,
        step: StepObjective,
        guess: Positions,
    ) -> None:
        super().__init__(base, scheme, step, guess)
        self._metric = metric

    def residual(self) -> float:
        """Return the residual [J^(1/2)] at the iterate."""
        return self._metric.residual(self.gradient())
