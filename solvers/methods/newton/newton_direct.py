"""Newton's method with the exact Hessian and a direct factorisation.

Source: Nocedal and Wright 2006, section 3.4.

    p <- p - t (H + E)^-1 grad g(p)

The Hessian of compressed springs may be indefinite. It remains exact wherever it has a Cholesky factor, which preserves
quadratic convergence. Where it has none, an increasing part of the springs' negative lateral stiffness is removed, and
finally a multiple of the diagonal of Q is added. Other rules modify the eigenvalues of elements (`indefinite_strategy`,
`springbench.solvers.methods.newton.hessian_regularisation`); clamping all of them (Teran et al. 2005) converges
linearly. Where the slope is small, none of these rules applies: the exact Hessian distinguishes a minimum from a
saddle. From a stationary point whose exact Hessian has no factor, the method escapes
(`springbench.solvers.methods.newton.negative_curvature`).

With active contacts, an iteration converges friction and may consist of several steps
(`springbench.solvers.methods.newton.friction_gauss_seidel`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.contact.half_space.vertex_contact import is_vertex_contact
from springbench.solvers.iteration.descent_method import (
    CompiledDescentState,
    CompiledMethod,
    DescentPoint,
    PreparedDescent,
    ResidualMetric,
    backtracking_line_search,
    inner_product,
)
from springbench.solvers.iteration.idle_contact import skip_idle_contact
from springbench.solvers.iteration.iterative_solver import SolverState
from springbench.solvers.iteration.solver_info import Citation, SolverInfo
from springbench.solvers.jit.typed_kernel import TypedKernel
from springbench.solvers.kernels.iteration_loop import REASON_ITERATIONS, RESIDUAL_EACH, LoopLimits, check_residual
from springbench.solvers.linalg.cholesky.block_cholesky import BlockCholesky
from springbench.solvers.methods.newton.hessian_regularisation import (
    REGULARISATION_RULES,
    SHIFT_SCHEDULE,
    ContactScheduleRule,
    IndefiniteStrategy,
    RegularisationRule,
    ShiftScheduleRule,
)
from springbench.solvers.methods.newton.negative_curvature import escape_saddle, is_positive_definite
from springbench.solvers.methods.newton.newton_kernel import NEWTON_PROGRESS_DTYPE, NewtonArrays, run_exact_steps
from springbench.solvers.model.barrier_energy import is_barrier_energy
from springbench.solvers.model.step_problem import Positions, PreparedSolver, StepProblem, System, Unsupported
from springbench.solvers.objective.fixed_objective import FixedObjective
from springbench.solvers.objective.step_objective import StepObjective

if TYPE_CHECKING:
    from springbench.solvers.methods.newton.friction_gauss_seidel import FrictionGaussSeidel

_SADDLE_SLOPE_RATIO = 1e-12
"""Fraction of the steepest slope of a solve below which an exact Hessian without a factor indicates a saddle."""


@dataclass(frozen=True)
class NewtonSolver:
    """Newton's method; at convergence or stagnation, negative curvature is at the level of round-off.

    Args:
        indefinite_strategy: modification of indefinite Hessians (`hessian_regularisation`).
    """

    is_minimiser: ClassVar[bool] = True
    is_monotone: ClassVar[bool] = True
    solver_info: ClassVar[SolverInfo] = SolverInfo(
        "Newton",
        Citation("Nocedal, Jorge and Wright, Stephen J.", 2006, "Numerical Optimization", "10.1007/978-0-387-40065-5"),
        is_family_default=True,
        supports_error_control=True,
        formula="p⁺ = p − t (H + E)⁻¹ ∇g",
        cost="1 factorisation of 3 × 3 blocks",
    )

    indefinite_strategy: IndefiniteStrategy = "shift-schedule"

    def prepare(self, system: System) -> PreparedSolver:
        """Prepare the method for a system.

        Raises:
            NotPositiveDefinite: if the system leaves some positions undetermined.
            Unsupported: if Q does not fit in memory, and for energies without an element-wise form that
                `indefinite_strategy` requires.
        """
        metric, objective = ResidualMetric(system), FixedObjective(system)
        whole = {
            type(system.energies[k]).__name__
            for k in objective.other_energy_indices
            if not is_barrier_energy(system.energies[k])
        }
        if whole and self.indefinite_strategy != "shift-schedule":
            raise Unsupported(
                f"newton, indefinite_strategy: {self.indefinite_strategy}: changes second derivatives element by "
                f"element, and there are none of {', '.join(sorted(whole))}; take indefinite_strategy: shift-schedule"
            )
        factor = objective.hessian_matrix.factor
        facts = metric.stats | {"nnz_hessian_factor": float(factor.nonzeros)}
        choice = f"a factor of the Hessian with {factor.nonzeros:,} entries; residuals by {metric.description}"
        choice += objective.interpreted_energies
        method = NewtonIteration(metric, self.indefinite_strategy)
        found = PreparedExactNewton(objective, metric, method, choice, facts)
        return skip_idle_contact(found, system, lambda: replace(found, fixed_objective=objective.ignore_barriers()))


class PreparedExactNewton(PreparedDescent):
    """Newton's method after the setup for a system.

    Iterations are compiled where all energies are springs and quadratic forms, and their elements are not projected.
    """

    method: NewtonIteration

    @cached_property
    def compiled_method(self) -> CompiledMethod | None:
        """The compiled iterations, or None if they are not supported."""
        supported = self.method.regularises_by_schedule
        arrays = build_newton_arrays(self.metric, self.fixed_objective) if supported else None
        if arrays is None:
            return None
        return CompiledMethod(TypedKernel(run_exact_steps), arrays, 0, NEWTON_PROGRESS_DTYPE)

    def init_state(self, problem: StepProblem, initial_guess: Positions) -> SolverState:
        """Start a solve.

        Args:
            problem: the step.
            initial_guess: positions (n, 3) [m], which are not modified.
        """
        factor = self.fixed_objective.hessian_matrix.factor
        if self.compiled_method is None or factor.num_threads > 1:
            return super().init_state(problem, initial_guess)
        return _CompiledNewtonState(
            self.compiled_method, self.method, factor, *self._build_step(problem, initial_guess)
        )


def build_newton_arrays(metric: ResidualMetric, objective: FixedObjective) -> NewtonArrays | None:
    """Build the arrays of compiled iterations, or return None if they are not supported.

    Args:
        metric: norm of residuals.
        objective: objective of the system, whose Hessian's values and factor are overwritten in each iteration.
    """
    search = metric.build_search_arrays(objective)
    if search is None:
        return None
    matrix, system = objective.hessian_matrix, metric.system
    blocks = matrix.block_indices, matrix.constant_blocks, np.empty(0), matrix.values
    scratch = np.empty((len(system.free_vertices), 3)), np.zeros((system.num_vertices, 3))
    return NewtonArrays(search, *blocks, matrix.factor.kernel_factor, *scratch)


class _CompiledNewtonState(CompiledDescentState):
    """The state of a solve with compiled iterations where the exact Hessian has a factor."""

    def __init__(
        self,
        compiled: CompiledMethod,
        method: NewtonIteration,
        factor: BlockCholesky,
        step: StepObjective,
        start: DescentPoint,
    ) -> None:
        super().__init__(compiled, step, start)
        self._method, self._factor = method, factor

    def run_iterations(self, limits: LoopLimits) -> tuple[int, float, int]:
        """Iterate up to the limits; return count, residual and reason."""
        count, residual, ended = self._run_exact_steps(limits)
        while self.progress["failed_supernode"][0] >= 0 and self._take_regularised_step():
            count += 1
            if limits.residual_mode == RESIDUAL_EACH:
                residual = self.residual()
                ended = check_residual(residual, limits)
                if ended != REASON_ITERATIONS:
                    break
            more, residual, ended = self._run_exact_steps(limits._replace(max_iterations=limits.max_iterations - count))
            count += more
        return count, residual, ended

    def _run_exact_steps(self, limits: LoopLimits) -> tuple[int, float, int]:
        """Iterate as long as the exact Hessian has a factor; return count, residual and reason."""
        found, now = super().run_iterations(limits), self.progress[0]
        self._factor.count_factorisations(int(now["num_factorisations"]), int(now["failed_supernode"]))
        return found

    def _take_regularised_step(self) -> bool:
        """Do a step where the exact Hessian has no factor; return whether the positions changed."""
        at, progress = DescentPoint(self.positions, self.gradient), self.progress
        steepest = float(progress["steepest_slope"][0])
        found, progress["steepest_slope"] = self._method.next_point(self._step, at, steepest, ShiftScheduleRule(1))
        if found.is_stalled:
            progress["is_stalled"] = 1
            return False
        self.positions[:], self.gradient[:] = found.positions, found.gradient
        progress["has_residual"] = 0
        return True

    def can_terminate(self) -> bool:
        """Return whether the iterate may be a minimum if it is stationary."""
        return self._method.can_terminate(self._step, DescentPoint(self.positions, self.gradient))


class NewtonIteration:
    """The iteration of Newton's method for one system.

    Attributes:
        regularises_by_schedule: whether Hessians without a factor are changed by the shift schedule.
    """

    can_identify_saddles: ClassVar[bool] = True

    def __init__(
        self,
        metric: ResidualMetric,
        indefinite: IndefiniteStrategy = "shift-schedule",
        *,
        has_local_roundoff: bool = False,
    ) -> None:
        """Create the iteration.

        Args:
            metric: norm of residuals.
            indefinite: name of the regularisation.
            has_local_roundoff: whether round-off is determined by connected components. If the total decrease of a
                step is round-off, the components move whose decrease is not, e.g. those near the origin. The line
                search also uses the slope along the rounded displacement.
        """
        self._has_local_roundoff = has_local_roundoff
        self._metric, self._modification_rule = metric, REGULARISATION_RULES[indefinite]
        self.regularises_by_schedule = indefinite == "shift-schedule"
        self._system_diagonal: NDArray[np.float64] = np.repeat(metric.free_diagonal, 3)
        self._friction_search = make_friction_search(metric)

    def iterate_points(self, step: StepObjective, start: DescentPoint) -> Iterator[DescentPoint]:
        """Yield the points after `start`.

        Args:
            step: objective of the step.
            start: first point, which is not yielded; friction is relaxed there.
        """
        point, steepest, rule = start, 0.0, self._modification_rule()
        if step.barrier_energies and type(rule) is ShiftScheduleRule:
            rule = ContactScheduleRule()
        if self._friction_search and step.has_contact_elements:
            point = self._friction_search.relax_initial_point(step, point)
        while not point.is_stalled:
            point, steepest = self.next_point(step, point, steepest, rule)
            yield point

    def can_terminate(self, step: StepObjective, at: DescentPoint) -> bool:
        """Return whether a stationary point is a minimum, as far as the method can determine.

        Args:
            step: objective of the step.
            at: stationary point, whose exact Hessian is factorised.
        """
        return is_positive_definite(step, at.positions)

    def iteration_phases(self, step: StepObjective, at: DescentPoint) -> dict[str, Callable[[], object]]:
        """Return the gradient, the Hessian with its factorisation, and a solve as callables.

        Args:
            step: objective of the step.
            at: point at which the phases are evaluated.
        """
        hessian, (keep, by) = (
            step.hessian(at.positions),
            SHIFT_SCHEDULE[-1],
        )  # any other may have no factor to solve with
        hessian.factorise(keep, by * self._system_diagonal)
        return {
            "gradient": lambda: step.gradient(at.positions),
            "factor": lambda: hessian.factorise(keep, by * self._system_diagonal),
            "solve": lambda: hessian.solve(at.gradient),
        }

    def next_point(
        self, step: StepObjective, at: DescentPoint, steepest: float, rule: RegularisationRule
    ) -> tuple[DescentPoint, float]:
        """Return the next point and the steepest slope so far [J].

        Args:
            step: the objective.
            at: current point.
            steepest: steepest slope of the solve before this step [J].
            rule: regularisation in the solve.
        """
        hessian = step.hessian(at.positions)
        level = rule.factorise_hessian(hessian, at, self._system_diagonal)
        if level is None:
            return at._replace(is_stalled=True), steepest
        direction = -hessian.solve(at.gradient)
        slope: float | None = inner_product(at.gradient, direction)
        fall = -slope
        steepest = max(fall, steepest)
        known = fall > self._metric.energy_roundoff(at.positions)
        if not known and self._has_local_roundoff:
            falls = -np.einsum("ij,ij->i", at.gradient, direction)
            is_significant = self._metric.significant_vertices(at.positions, falls)
            known, direction = bool(is_significant.any()), np.where(is_significant[:, None], direction, 0.0)
            slope = None
        slight = fall <= _SADDLE_SLOPE_RATIO * steepest
        if level > 0 and (slight or not known) and type(rule) is not ShiftScheduleRule:
            return self.next_point(step, at, steepest, ShiftScheduleRule())
        found = None
        if known and not (slight and level > 0):
            found = self._search_direction(step, at, direction, slope, level == 0)
        if found is None and level > 0:
            found = escape_saddle(step, at, hessian, self._system_diagonal) or (
                self._backtrack(step, at, direction, slope) if known else None
            )
        if found is not None:
            rule.record_step(step, hessian, at, found)
        return found or at._replace(is_stalled=True), steepest

    def _search_direction(
        self, step: StepObjective, at: DescentPoint, direction: Positions, slope: float | None, exact: bool
    ) -> DescentPoint | None:
        """Return a lower point along a direction, or None; `exact` means an unmodified Hessian."""
        if self._friction_search is None or not exact or not step.has_contact_elements:
            return self._backtrack(step, at, direction, slope)
        return self._friction_search.watchdog_search(
            step, at, direction, lambda point: self._exact_newton_direction(step, point)
        )

    def _backtrack(
        self, step: StepObjective, at: DescentPoint, direction: Positions, slope: float | None
    ) -> DescentPoint | None:
        return backtracking_line_search(step, at, direction, uses_rounded_slope=self._has_local_roundoff, slope=slope)

    @staticmethod
    def _exact_newton_direction(step: StepObjective, at: DescentPoint) -> Positions | None:
        """Return the direction of the exact Hessian, None if it is not positive definite."""
        hessian = step.hessian(at.positions)
        return -hessian.solve(at.gradient) if hessian.factorise() else None


def make_friction_search(metric: ResidualMetric) -> FrictionGaussSeidel | None:
    """Return the friction search of Newton's methods; None without contact, and with surface contact."""
    energies = metric.system.energies
    if not any(is_vertex_contact(energy) for energy in energies) or any(
        is_barrier_energy(energy) for energy in energies
    ):
        return None  # its sweeps are not limited to collision-free displacements
    from springbench.solvers.methods.newton.friction_gauss_seidel import FrictionGaussSeidel

    return FrictionGaussSeidel(metric)
