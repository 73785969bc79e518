"""Newton-CG: inexact Newton method with preconditioned conjugate gradients (Dembo and Steihaug 1983).

    H d = -g to |H d + g| <= eta |g|,   |r|^2 = r' Q^-1 r,   eta = .9 (|g| / |g previous|)^2  Eisenstat and Walker 1996

For springs Q majorises H, so the eigenvalues of Q^-1 H are at most 1. Conjugate gradients stop at a direction of
negative curvature with their current iterate. If that is the first direction, d is -Q^-1 g, a local-global iteration.

`springbench.solvers.iteration.preconditioners` documents the other preconditioners, and the matrix that replaces Q with
active contacts. An iteration converges friction, and may consist of several steps, as in Newton's method.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
from springbench.solvers.iteration.descent_method import (
    CompiledDescentState,
    CompiledMethod,
    DescentPoint,
    PreparedDescent,
    ResidualMetric,
    backtracking_line_search,
    inner_product,
)
from springbench.solvers.iteration.device_interface import PrecisionOptions
from springbench.solvers.iteration.idle_contact import skip_idle_contact
from springbench.solvers.iteration.iterative_solver import SolverState
from springbench.solvers.iteration.preconditioners import (
    Preconditioner,
    PreconditionerName,
    ScaledPreconditioner,
    build_preconditioner,
)
from springbench.solvers.iteration.solver_info import Citation, SolverInfo
from springbench.solvers.jit.typed_kernel import TypedKernel
from springbench.solvers.linalg.cholesky.supernodal_cholesky import SupernodalCholesky, embed_factor
from springbench.solvers.linalg.krylov import NEGATIVE_CURVATURE, ConjugateGradientIteration
from springbench.solvers.methods.newton.newton_cg_kernel import (
    MAX_CG_ITERATIONS,
    MAX_ETA,
    MIN_ETA,
    NEWTON_CG_PROGRESS_DTYPE,
    NewtonCGArrays,
    NewtonEquation,
    run_newton_cg,
    solve_direction,
    update_eta,
)
from springbench.solvers.methods.newton.newton_direct import make_friction_search
from springbench.solvers.model.step_problem import Positions, PreparedSolver, StepProblem, System
from springbench.solvers.objective.fixed_objective import FixedObjective
from springbench.solvers.objective.step_objective import Hessian, StepObjective

_MAX_ETA_IN_CONTACT = 1e-4
"""Upper bound of eta with active contacts: sticking friction acts within 1e-8 m, and a direction with a small error on
that scale leads to where another quadratic model is valid."""


@dataclass(frozen=True)
class NewtonCG(PrecisionOptions):
    """Newton's method without a factorisation of the Hessian; needs as much memory as local-global.

    Args:
        preconditioner: of conjugate gradients (`springbench.solvers.iteration.preconditioners`); a device supports
            schwarz only.
    """

    omitted_defaults: ClassVar[frozenset[str]] = PrecisionOptions.omitted_defaults | {"preconditioner"}

    is_minimiser: ClassVar[bool] = True
    is_monotone: ClassVar[bool] = True
    solver_info: ClassVar[SolverInfo] = SolverInfo(
        "Newton",
        Citation(
            "Dembo, Ron S. and Steihaug, Trond",
            1983,
            "Truncated-Newton algorithms for large-scale unconstrained optimization",
            "10.1007/BF02592055",
        ),
        formula="p⁺ = p − t H⁻¹ ∇g by preconditioned CG",
        cost="several solves and products with H",
    )

    preconditioner: PreconditionerName = "cholesky"

    def prepare(self, system: System) -> PreparedSolver:
        """Prepare the method for a system.

        Raises:
            NotPositiveDefinite: if the system leaves some positions undetermined.
            Unsupported: if Q does not fit in memory, and for block preconditioners with energies without elements.
        """
        if self.device == "cuda":
            from springbench.solvers.cuda.cuda_device import require_device  # imported only for a device

            require_device("newton-cg")
            from springbench.solvers.methods.newton.device_newton_cg import prepare_newton_cg

            return prepare_newton_cg(
                system, self.preconditioner, self.real_dtype, (MAX_ETA, MIN_ETA), MAX_CG_ITERATIONS
            )
        metric = ResidualMetric(system)
        objective = FixedObjective(system)
        method = TruncatedNewtonIteration(metric, objective, self.preconditioner)
        found = PreparedTruncatedNewton(
            objective, metric, method, metric.description + objective.interpreted_energies, metric.stats
        )
        return skip_idle_contact(found, system, lambda: replace(found, fixed_objective=objective.ignore_barriers()))


class TruncatedNewtonIteration:
    """The iteration for one system; `compiled_cg` is the fused CG kernel, None if unavailable."""

    can_identify_saddles: ClassVar[bool] = False

    def __init__(
        self, metric: ResidualMetric, objective: FixedObjective, preconditioner: PreconditionerName = "cholesky"
    ) -> None:
        self._metric, self._linearise_at = metric, build_preconditioner(preconditioner, metric, objective, "newton-cg")
        factor = metric.supernodal_factor if preconditioner == "cholesky" else None
        self.compiled_cg = _CompiledCG(metric.system, factor) if factor else None
        self._friction_search = make_friction_search(metric)

    def iterate_points(self, step: StepObjective, start: DescentPoint) -> Iterator[DescentPoint]:
        """Yield the points after `start`.

        Args:
            step: objective of the step.
            start: first point, which is not yielded; friction is relaxed there.
        """
        loose = _MAX_ETA_IN_CONTACT if step.has_contact_elements else MAX_ETA
        point, eta = (
            self._friction_search.relax_initial_point(step, start)
            if self._friction_search and step.has_contact_elements
            else start,
            loose,
        )
        hessian, solve = self._linearise_at(step, point.positions)
        descent = solve(point.gradient)
        while not point.is_stalled:
            found = None
            if inner_product(point.gradient, descent) > self._metric.energy_roundoff(point.positions):
                direction = self._compute_direction(step, hessian, solve, point, descent, eta)
                found = self._search_direction(step, point, direction, eta) or backtracking_line_search(
                    step, point, -descent
                )
            if found is None:
                yield point._replace(is_stalled=True)
                return
            hessian, solve = self._linearise_at(step, found.positions)
            before, descent = inner_product(point.gradient, descent), solve(found.gradient)
            eta = update_eta(eta, inner_product(found.gradient, descent), before, loose)
            point = found
            yield point

    def _search_direction(
        self, step: StepObjective, at: DescentPoint, direction: Positions, eta: float
    ) -> DescentPoint | None:
        """Return a lower point along a direction, or None."""
        if self._friction_search is None or not step.has_contact_elements:
            return backtracking_line_search(step, at, direction)

        def compute_direction_at(point: DescentPoint) -> Positions:
            hessian, solve = self._linearise_at(step, point.positions)
            return self._compute_direction(step, hessian, solve, point, solve(point.gradient), eta)

        return self._friction_search.watchdog_search(step, at, direction, compute_direction_at)

    def can_terminate(self, step: StepObjective, at: DescentPoint) -> bool:
        """Return True: without a factor, definiteness is unknown.

        Args:
            step, at: not used.
        """
        return True

    def iteration_phases(self, step: StepObjective, at: DescentPoint) -> dict[str, Callable[[], object]]:
        """Return the gradient, a product with the Hessian and the preconditioner as callables.

        Args:
            step: objective of the step.
            at: point at which the phases are evaluated.
        """
        hessian, solve = self._linearise_at(step, at.positions)
        return {
            "gradient": lambda: step.gradient(at.positions),
            "product": lambda: hessian.matvec(at.gradient),
            "solve": lambda: solve(at.gradient),
        }

    def _compute_direction(
        self,
        step: StepObjective,
        hessian: Hessian,
        solve: Preconditioner,
        at: DescentPoint,
        descent: Positions,
        eta: float,
    ) -> Positions:
        """Solve H d = -g approximately; `descent` is the preconditioned gradient."""
        if self.compiled_cg and not step.other_energies:
            return self.compiled_cg.compute_direction(hessian, solve, at, descent, eta)
        product = inner_product(at.gradient, descent)
        newton = _NewtonSystemCG(hessian, solve, at.gradient, descent, eta**2 * product)
        count, ended = newton.run_iterations(product, MAX_CG_ITERATIONS)
        return newton.search_direction if ended == NEGATIVE_CURVATURE and count == 0 else newton.solution


class _NewtonSystemCG(ConjugateGradientIteration):
    """Conjugate gradients for H d = -g.

    Args:
        hessian: H.
        solve: the preconditioner.
        gradient: g (n, 3).
        descent: the preconditioned gradient.
        limit: tolerance of r'z [J].
    """

    def __init__(
        self, hessian: Hessian, solve: Preconditioner, gradient: Positions, descent: Positions, limit: float
    ) -> None:
        self._hessian, self._solve, self._limit = hessian, solve, limit
        self.solution, self.search_direction, self._residual, self._preconditioned_residual = (
            np.zeros_like(descent),
            np.zeros_like(descent),
            -gradient,
            -descent,
        )

    def update_direction(self, product: float, previous_product: float) -> float:
        """Update the search direction p; return p'Ap."""
        self.search_direction *= product / previous_product
        self.search_direction += self._preconditioned_residual
        self._product = self._hessian.matvec(self.search_direction)
        return inner_product(self.search_direction, self._product)

    def update_iterate(self, product: float, curvature: float) -> float:
        """Update the iterate, r and z; return r'z."""
        length = product / curvature
        self.solution += length * self.search_direction
        self._residual -= length * self._product
        self._preconditioned_residual = self._solve(self._residual)
        return inner_product(self._residual, self._preconditioned_residual)

    def is_convex(self, curvature: float) -> bool:
        """Return whether the curvature along p is positive."""
        return not curvature <= 0.0

    def is_converged(self, product: float) -> bool:
        """Return whether r'z has reached the tolerance."""
        return product <= self._limit


class _CompiledCG:
    """Conjugate gradients in one kernel, for springs, quadratic forms and elements."""

    def __init__(self, system: System, factor: SupernodalCholesky) -> None:
        self._thread_count, self._exact_pins = factor.choose_num_threads, system.pins.vertices[system.pins.exact_mask]
        self._factor = embed_factor(factor, system.free_vertices)
        self._scratch = np.zeros((4, system.num_vertices, 3))
        self._solve_usual = TypedKernel(solve_direction)

    def compute_direction(
        self, hessian: Hessian, solve: Preconditioner, at: DescentPoint, descent: Positions, eta: float
    ) -> Positions:
        """Solve H d = -g approximately; `descent` is the preconditioned gradient."""
        d = np.empty_like(descent)
        shrunk = solve.inverse_scaling if isinstance(solve, ScaledPreconditioner) else None
        solving = self._factor, self._thread_count(), self._exact_pins, shrunk
        newton = NewtonEquation(hessian.kernel_arguments, *solving, d, *self._scratch)
        is_usual = shrunk is None and newton.num_threads is None and not hessian.element_hessians
        solve_equation = self._solve_usual.call if is_usual else solve_direction
        gradient = np.ascontiguousarray(at.gradient)
        solve_equation(newton, gradient, np.ascontiguousarray(descent), eta, MAX_CG_ITERATIONS)
        return d


class PreparedTruncatedNewton(PreparedDescent):
    """Newton-CG after the setup for a system.

    Iterations are compiled for springs and quadratic forms, with the factor of Q as preconditioner.
    """

    method: TruncatedNewtonIteration

    @cached_property
    def compiled_method(self) -> CompiledMethod | None:
        """The compiled iterations, or None if they are not supported."""
        search = self.metric.build_search_arrays(self.fixed_objective) if self.method.compiled_cg else None
        if search is None:
            return None
        linear = np.empty((len(search.objective_terms.stiffness), 4))
        hessian = search.objective_terms, linear, search.quadratic_form, None, None
        solving = search.residual_norm.factor, None, self.fixed_objective.exact_pins, None
        vectors = np.zeros((5, self.metric.system.num_vertices, 3))
        arrays = NewtonCGArrays(search, linear, NewtonEquation(hessian, *solving, *vectors))
        return CompiledMethod(TypedKernel(run_newton_cg), arrays, 1, NEWTON_CG_PROGRESS_DTYPE)

    def init_state(self, problem: StepProblem, initial_guess: Positions) -> SolverState:
        """Start a solve.

        Args:
            problem: the step.
            initial_guess: positions (n, 3) [m], which are not modified.
        """
        if self.compiled_method is None or self.metric.is_threaded:
            return super().init_state(problem, initial_guess)
        return CompiledDescentState(self.compiled_method, *self._build_step(problem, initial_guess))
