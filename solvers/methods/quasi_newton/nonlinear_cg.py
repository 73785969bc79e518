"""Nonlinear conjugate gradients, preconditioned by Q^-1, without a Hessian matrix or factorisation.

Shen et al. 2024; they precondition by the diagonal of the Hessian, as interior-point elasticity has no Q.

    d = -z + beta d_previous,   z = Q^-1 grad g,   y = g - g_previous,   w = Q^-1 y
    beta = (y z - (w y) (g d)/(d y)) / (d y)              Dai and Kou 2013
    t = -(g d)/(d H d)                                    the minimiser of the quadratic model along d

H d is a product, element by element. If d is no descent direction, or the model has negative curvature along it, d is
reset to -z: a local-global iteration. A step without sufficient decrease is halved, and the step size is
collision-free. With active surface contacts, P = S Q S replaces Q (`springbench.solvers.iteration.preconditioners`).
Contact of single vertices is not supported: it activates abruptly and friction sticks within 1e-8 m, so no quadratic
model is valid for a step along d. Landing sheets took 340 to 2,600 iterations where L-BFGS took 23 to 135.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
from springbench.solvers.contact.half_space.vertex_contact import without_vertex_contact
from springbench.solvers.iteration.descent_method import (
    CompiledDescentState,
    CompiledMethod,
    DescentPoint,
    ResidualMetric,
    backtracking_line_search,
    inner_product,
)
from springbench.solvers.iteration.idle_contact import skip_idle_contact
from springbench.solvers.iteration.iterative_solver import IterativeSolver, SolverState, compute_max_coordinate
from springbench.solvers.iteration.preconditioners import (
    PreconditionerBuilder,
    PreconditionerName,
    build_preconditioner,
)
from springbench.solvers.iteration.solver_info import Citation, SolverInfo
from springbench.solvers.jit.typed_kernel import TypedKernel
from springbench.solvers.methods.quasi_newton.nonlinear_cg_kernel import (
    CONJUGATE_PROGRESS_DTYPE,
    NonlinearCGArrays,
    run_nonlinear_cg,
)
from springbench.solvers.model.step_problem import Positions, PreparedSolver, StepProblem, System, Unsupported
from springbench.solvers.objective.fixed_objective import FixedObjective
from springbench.solvers.objective.step_objective import StepObjective


@dataclass(frozen=True)
class NonlinearCG:
    """Preconditioned nonlinear conjugate gradients for all energies; needs as much memory as local-global.

    Args:
        preconditioner: approximate inverse of the Hessian, by name (`springbench.solvers.iteration.preconditioners`).
    """

    omitted_defaults: ClassVar[frozenset[str]] = frozenset({"preconditioner"})

    is_minimiser: ClassVar[bool] = True
    is_monotone: ClassVar[bool] = True
    solver_info: ClassVar[SolverInfo] = SolverInfo(
        "accelerated local-global",
        Citation(
            "Shen, Xing and Cai, Runyuan and Bi, Mengxiao and Lv, Tangjie",
            2024,
            "Preconditioned nonlinear conjugate gradient method for real-time interior-point hyperelasticity",
            "10.1145/3641519.3657490",
        ),
        formula="d⁺ = −Q⁻¹ ∇g + β d",
        cost="1 solve, 1 pass, 1 product with H",
    )

    preconditioner: PreconditionerName = "cholesky"

    def prepare(self, system: System) -> PreparedSolver:
        """Prepare the method for a system.

        Raises:
            NotPositiveDefinite: if the system leaves some positions undetermined.
            Unsupported: for contact of single vertices, if Q does not fit in memory, and for block preconditioners with
                energies without elements.
        """
        if without_vertex_contact(system) is not system:
            raise Unsupported(
                "pncg: does not support contact of single vertices (HalfSpaceContact), for which no quadratic model is "
                "valid along a direction; use lbfgs or newton, or surface-contact"
            )
        metric, objective = ResidualMetric(system), FixedObjective(system)
        at = build_preconditioner(self.preconditioner, metric, objective, "pncg")
        found = PreparedNonlinearCG(
            metric,
            objective,
            at,
            metric.description + objective.interpreted_energies,
            metric.stats,
            self.preconditioner,
        )
        return skip_idle_contact(found, system, lambda: replace(found, fixed_objective=objective.ignore_barriers()))


@dataclass(frozen=True, eq=False)
class PreparedNonlinearCG(IterativeSolver):
    """Nonlinear conjugate gradients, prepared for a system."""

    metric: ResidualMetric
    fixed_objective: FixedObjective
    linearise_at: PreconditionerBuilder
    description: str
    stats: dict[str, float]
    preconditioner: PreconditionerName

    def init_state(self, problem: StepProblem, initial_guess: Positions) -> SolverState:
        """Start a solve from an initial guess.

        Args:
            problem: step whose objective is minimised.
            initial_guess: positions (n, 3) [m], not modified.
        """
        step = StepObjective(self.fixed_objective, problem)
        p = step.apply_exact_pins(initial_guess)
        start = DescentPoint(p, step.gradient(p))
        if self.compiled_method is None or self.metric.is_threaded:
            return _NonlinearCGState(self.metric, self.linearise_at, step, start)
        return CompiledDescentState(self.compiled_method, step, start)

    @cached_property
    def compiled_method(self) -> CompiledMethod | None:
        """The compiled iterations, or None if they are not supported."""
        search = self.metric.build_search_arrays(self.fixed_objective) if self.preconditioner == "cholesky" else None
        if search is None:
            return None
        linear = np.empty((len(search.objective_terms.stiffness), 4))
        arrays = NonlinearCGArrays(search, linear, *[np.empty_like(search.trial_positions) for _ in range(3)])
        return CompiledMethod(TypedKernel(run_nonlinear_cg), arrays, 2, CONJUGATE_PROGRESS_DTYPE)

    def residual_scale(self, problem: StepProblem) -> float:
        """Return the residual scale [J^(1/2)] for the round-off check."""
        return compute_max_coordinate(problem) * self.metric.unpinned_trace**0.5

    def iteration_phases(self, problem: StepProblem) -> dict[str, Callable[[], object]]:
        """Return the gradient, a Hessian product and the preconditioner as callables, at the initial guess."""
        step = StepObjective(self.fixed_objective, problem)
        p = step.apply_exact_pins(problem.initial_guess)
        (hessian, solve), gradient = self.linearise_at(step, p), step.gradient(p)
        return {
            "gradient": lambda: step.gradient(p),
            "product": lambda: hessian.matvec(gradient),
            "solve": lambda: solve(gradient),
        }


class _NonlinearCGState(SolverState):
    """State of an interpreted solve: the current point, and the direction that led to it."""

    def __init__(
        self, metric: ResidualMetric, linearise_at: PreconditionerBuilder, step: StepObjective, start: DescentPoint
    ) -> None:
        self._metric, self._linearise_at, self._step = metric, linearise_at, step
        self._previous_direction, self._beta = np.zeros_like(start.positions), 0.0
        self._set_point(start)

    def _set_point(self, at: DescentPoint) -> None:
        self._current_point, self.positions = at, at.positions
        self._hessian, self._solve = self._linearise_at(self._step, at.positions)
        self._z = self._solve(at.gradient)

    def step_state(self) -> bool:
        """Do one iteration; return False if round-off prevents any further change."""
        at, z = self._current_point, self._z
        if not inner_product(at.gradient, z) > self._metric.energy_roundoff(at.positions):
            return False
        direction = self._beta * self._previous_direction - z
        found = self._search_quadratic_model(direction) if self._beta else None
        if found is None:
            direction = -z
            found = self._search_quadratic_model(direction) or backtracking_line_search(self._step, at, direction)
        if found is None:
            return False
        self._set_point(found)
        y = found.gradient - at.gradient
        change = inner_product(direction, y)
        beta = (
            inner_product(y, self._z)
            - inner_product(self._z - z, y) * inner_product(found.gradient, direction) / change
            if change > 0.0
            else 0.0
        )
        self._previous_direction, self._beta = direction, beta / change if np.isfinite(beta) and change > 0.0 else 0.0
        return True

    def _search_quadratic_model(self, direction: Positions) -> DescentPoint | None:
        """Return a lower point by the quadratic model; None without descent or with negative curvature."""
        slope, curvature = (
            inner_product(self._current_point.gradient, direction),
            inner_product(direction, self._hessian.matvec(direction)),
        )
        if not (slope < 0.0 < curvature):
            return None
        return backtracking_line_search(self._step, self._current_point, direction, initial_step=-slope / curvature)

    def compute_start_residual(self) -> float:
        """Return the residual at the initial guess [J^(1/2)]."""
        return self.residual()

    def residual(self) -> float:
        """Return the residual [J^(1/2)] at the iterate."""
        gradient = self._current_point.gradient
        if self._solve == self._metric.solve:
            return self._metric.correction_norm(self._z.copy(), gradient)
        return self._metric.residual(gradient)
