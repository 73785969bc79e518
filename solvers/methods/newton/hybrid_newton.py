"""Hybrid of L-BFGS and Newton's method with predicted tensions, which ends with Newton's method.

    H(t) = M/dt^2 + sum_e k nn' + t_e/l_e (I - nn'),   d = -H(t)^-1 grad g(p),   t_e <- k_e (l_e + n (A d)_e - r_e)

Stiff springs hardly change their lengths between the start and the end of a step. During the iterations they do, and
their tensions k (l - r) then exceed the true ones by orders of magnitude. In the exact Hessian these tensions make
springs stiff against bending, or unstable, although they are neither. Here tensions are separate unknowns. Newton's
method on the optimality conditions of both (primal-dual, as in interior-point methods: Nocedal and Wright 2006,
chapter 19; tensions carried across iterations stabilise stiff springs in Tournier et al. 2015, "Stable Constrained
Dynamics") reduces to a Hessian with predicted tensions, which allows correspondingly longer steps. The second-order
stretch of such a step is local: a few iterations of L-BFGS remove it. The first prediction starts from smooth
positions at the end of the previous step. If H(t) has no Cholesky factor, the smallest multiple of inertia that yields
one is added: along unstable directions the step is longer, the closer that multiple is to the minimum (More and
Sorensen 1983).

L-BFGS runs first. If the factor of Q exceeds the cache, it is in float32, unless Q is so stiff that its directions
would have no digit: the iterations are then limited by memory bandwidth, and directions need no more digits. The start
is the better of the initial guess and the inertial prediction.

One rule decides which of the three methods continues: that with the largest decrease of the objective per cost in its
last steps. A method that was not yet measured is credited with the decrease that L-BFGS leaves, extrapolated from its
last two groups of iterations (`springbench.solvers.kernels.descent_rounds`). The exact Hessian is tried first. If it
has no Cholesky factor, predicted tensions follow, and the exact method is tried again after a cost that doubles with
each attempt that decreases the objective less than the others did meanwhile. If the Hessian of a step of the exact
method is unmodified and the decrease agrees with the quadratic model, the next step is predicted to gain more than any
other method, and the exact method continues until a step does not agree. An indefinite Hessian gets the smallest
multiple of inertia that has a factor (`springbench.solvers.methods.newton.inertia_shift`), or loses negative stiffness
(`springbench.solvers.methods.newton.hessian_regularisation`), whichever decreased the objective more per factorisation
when last used. Costs are counted, not measured by a clock: in groups of L-BFGS iterations, from the numbers of springs,
entries and operations of the factors and from the factorisations made. So equal solves make equal decisions and have
bitwise equal results, on any machine and under any load. `Solution.solver_phases` explains them.

If a point that satisfies the tolerance has an indefinite Hessian, the step leaves along a direction of negative
curvature: symmetric initial guesses lead to saddles.

With active contacts the exact method does all iterations. Contact is not part of Q, so L-BFGS would restart at each
newly active vertex, and the contact stiffness is beyond what tensions predict. L-BFGS ignores self-contact: if the
displacement of a round is not collision-free, or ends with active contacts, the round is discarded and the exact method
continues.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, cast

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.contact.half_space.vertex_contact import without_vertex_contact
from springbench.solvers.iteration.descent_method import (
    DescentPoint,
    PreparedDescent,
    ResidualMetric,
    has_active_barrier,
    lower_start_positions,
)
from springbench.solvers.iteration.idle_contact import skip_idle_contact
from springbench.solvers.iteration.iterative_solver import SolverState
from springbench.solvers.iteration.saddle_check import SaddleCheck
from springbench.solvers.iteration.solver_info import Citation, SolverInfo
from springbench.solvers.kernels.descent_rounds import GROUP_ITERATIONS, init_rounds
from springbench.solvers.kernels.iteration_loop import (
    RESIDUAL_NEVER,
    LoopLimits,
)
from springbench.solvers.linalg.cholesky.symbolic_factorisation import cache_symbolic_analysis
from springbench.solvers.methods.local_global.accelerated_local_global import AcceleratedState
from springbench.solvers.methods.newton.hybrid_choice import (
    NO_GRADIENT,
    MethodChoice,
    SolveControl,
    compute_current_point,
)
from springbench.solvers.methods.newton.hybrid_state import HybridState, LbfgsFirstState
from springbench.solvers.methods.newton.newton_direct import NewtonIteration
from springbench.solvers.methods.quasi_newton.lbfgs import Lbfgs
from springbench.solvers.methods.quasi_newton.windowed_acceleration import (
    CompiledAccelerationState,
    PreparedAccelerated,
)
from springbench.solvers.model.barrier_energy import ignore_barriers, without_barriers
from springbench.solvers.model.step_problem import Positions, PreparedSolver, StepProblem, System
from springbench.solvers.objective.fixed_objective import FixedObjective
from springbench.solvers.objective.step_objective import StepObjective

_RELAXATION_ITERATIONS = 5
"""L-BFGS iterations after a Newton step with predicted tensions."""

_CACHED_ENTRIES = 2**15
"""Entries of a factor of Q that fit in a core's second-level cache, 256 KiB: there float64 costs as much as float32,
and the residuals of L-BFGS are exact."""

_FLOAT32_CONDITION = 0.1 / float(np.finfo(np.float32).eps)
"""Largest condition number of Q, relative to the inertia, at which float32 leaves directions a digit."""


_LBFGS_NANOSECONDS, _NEWTON_NANOSECONDS = (1e3, 17.0, 2.0), (2e5, 0.023, 20.0)
"""Costs of an L-BFGS iteration (constant, per spring, per entry of the factor) and of a Newton step (constant, per
flop, per entry), fitted to 16 scenes of 6 to 4096 vertices on one core with AVX-512; their ratio alone matters."""

_RESIDUAL_COST, _COLLISION_CHECK_COST = 0.1, 20.0
"""Costs of a residual and of a check for collisions, in iterations of L-BFGS: 0.04 to 0.3 on 15 scenes of 9 to 4096
vertices, and 10 to 100 on folded cloths of 85 to 396 vertices."""


@dataclass(frozen=True)
class HybridNewton:
    """L-BFGS far from the minimum, then Newton's method with predicted tensions, then Newton's method."""

    is_minimiser: ClassVar[bool] = True
    is_monotone: ClassVar[bool] = True
    solver_info: ClassVar[SolverInfo] = SolverInfo(
        "hybrid",
        Citation(
            "Tournier, Maxime and Nesme, Matthieu and Gilles, Benjamin and Faure, François",
            2015,
            "Stable constrained dynamics",
            "10.1145/2766969",
        ),
        is_family_default=True,
        formula="L-BFGS, then Newton with predicted tensions",
        cost="1 L-BFGS iteration or 1 Newton step",
    )

    def prepare(self, system: System) -> PreparedSolver:
        """Prepare the method for a system.

        Raises:
            NotPositiveDefinite: if the system leaves some positions undetermined.
            Unsupported: if Q does not fit in memory.
        """
        with cache_symbolic_analysis():
            metric, objective = ResidualMetric(system), FixedObjective(system)
            is_double = metric.stats.get("nnz_factor", np.inf) <= _CACHED_ENTRIES or _needs_double_precision(metric)
            lbfgs = Lbfgs(precision="float64" if is_double else "float32").prepare_without_barriers(system)
            method, factor = HybridIteration(objective, metric, lbfgs, is_double), objective.hessian_matrix.factor
        facts = metric.stats | {"nnz_hessian_factor": float(factor.nonzeros)}
        choice = f"a factor of the Hessian with {factor.nonzeros:,} entries; for L-BFGS, {lbfgs.description}"
        choice += objective.interpreted_energies
        found = PreparedHybrid(objective, metric, method, choice, facts)

        def ignore_contact() -> PreparedHybrid:
            alone = objective.ignore_barriers()
            return replace(found, fixed_objective=alone, method=HybridIteration(alone, metric, lbfgs, is_double))

        return skip_idle_contact(found, system, ignore_contact)


def _needs_double_precision(metric: ResidualMetric) -> bool:
    """Return whether float32 leaves directions Q^-1 g without a digit.

    No eigenvalue of Q relative to the inertia exceeds twice the largest ratio of their diagonals, as Q is diagonally
    dominant.
    """
    system = metric.system
    inertia = system.inertia_diagonal[system.free_vertices]
    return bool((2.0 * metric.free_diagonal > _FLOAT32_CONDITION * inertia).any())


class PreparedHybrid(PreparedDescent):
    """The hybrid after the setup for a system."""

    @property
    def hybrid_iteration(self) -> HybridIteration:
        """The method."""
        return cast(HybridIteration, self.method)

    @cached_property
    def saddle_check(self) -> SaddleCheck:
        """The check for saddles, whose bound makes factorisations unnecessary."""
        return SaddleCheck(self.fixed_objective)

    def init_state(self, problem: StepProblem, initial_guess: Positions) -> SolverState:
        """Start a solve from an initial guess.

        Args:
            problem: step whose objective is minimised.
            initial_guess: positions (n, 3) [m], not modified.
        """
        starts_lower = self.hybrid_iteration.starts_lower
        return (LbfgsFirstState if starts_lower else HybridState)(self, problem, initial_guess)

    def residual_at(self, problem: StepProblem, p: Positions) -> float:
        """Return the residual [J^(1/2)], by L-BFGS if its residuals are those of the metric.

        Args:
            problem: step whose objective is minimised.
            p: positions (n, 3) [m].
        """
        lbfgs = self.hybrid_iteration.exact_lbfgs
        return lbfgs.residual_at(ignore_barriers(problem), p) if lbfgs else super().residual_at(problem, p)


class HybridIteration:
    """The iteration for one system.

    An iteration is a round of L-BFGS, or a step of one of the Newton methods.

    Attributes:
        metric: norm of residuals.
        newton: the exact method.
        factor: factor of the Hessian.
        exact_lbfgs: L-BFGS, if its residuals are those of the metric; else None.
        starts_lower: whether L-BFGS itself starts at the lower one of the initial guess and the inertial prediction.
        newton_cost: cost of a Newton step, in groups of L-BFGS iterations.
    """

    identifies_saddles: ClassVar[bool] = True

    def __init__(
        self, objective: FixedObjective, metric: ResidualMetric, lbfgs: PreparedAccelerated, is_double: bool
    ) -> None:
        self.metric, self._lbfgs = metric, lbfgs
        self.newton = NewtonIteration(metric, has_local_roundoff=True)
        self.system_diagonal: NDArray[np.float64] = np.repeat(metric.free_diagonal, 3)
        self.inertia_diagonal: NDArray[np.float64] = np.repeat(
            objective.system.inertia_diagonal[objective.system.free_vertices], 3
        )
        self.factor = factor = objective.hessian_matrix.factor
        self._system_has_barriers = without_barriers(objective.system) is not objective.system
        is_exact = is_double and not objective.has_barriers
        is_exact = is_exact and objective.system is without_vertex_contact(objective.system)
        self.exact_lbfgs = lbfgs if is_exact else None
        is_projective = objective.projective_indices.issuperset(objective.element_energy_indices)
        self.starts_lower = is_exact and is_projective and lbfgs.can_start_lower
        constant, per_spring, per_entry = _LBFGS_NANOSECONDS
        springs, entries = len(objective.springs.stiffness), lbfgs.stats.get("nnz_factor", 0.0)
        lbfgs_cost = GROUP_ITERATIONS * (constant + per_spring * springs + per_entry * entries)
        constant, per_flop, per_entry = _NEWTON_NANOSECONDS
        self.newton_cost = (constant + per_flop * factor.flops + per_entry * factor.nonzeros) / lbfgs_cost
        self._check_cost = _COLLISION_CHECK_COST if objective.has_barriers else _RESIDUAL_COST

    def init_rounds(self) -> NDArray[Any]:
        """Return the state of the rounds of a solve."""
        return init_rounds(self.newton_cost, self._check_cost)

    def round_off(self, p: Positions) -> float:
        """Return the residual [J^(1/2)] that rounded positions p (n, 3) [m] leave."""
        return self.metric.energy_roundoff(p) ** 0.5

    def iterate_points(self, step: StepObjective, start: DescentPoint) -> Iterator[DescentPoint]:
        """Yield the points after `start`.

        Args:
            step: objective of the step.
            start: first point, of which only the positions are used.
        """
        return self.iterate_from(step, start.positions, SolveControl())

    def iterate_from(self, step: StepObjective, p: Positions, control: SolveControl) -> Iterator[DescentPoint]:
        """Yield the points after the positions p; restart after an escape from a saddle.

        Args:
            step: objective of the step.
            p: positions (n, 3) [m]; the inertial prediction replaces them if it is lower.
            control: limits of the next iterations, read for each point; counts and costs are recorded there.
        """
        yield from self.continue_from(step, DescentPoint(lower_start_positions(step, p), NO_GRADIENT), control)

    def continue_from(
        self, step: StepObjective, start: DescentPoint, control: SolveControl, method_choice: MethodChoice | None = None
    ) -> Iterator[DescentPoint]:
        """Yield the points after a point; restart after an escape from a saddle.

        Args:
            step: objective of the step.
            start: point from which the iteration continues, of which only the positions are used.
            control: as in `iterate_from`.
            method_choice: choice between the methods that continues from there; a new one is started if omitted.
        """
        p, point = start.positions, start if method_choice else None
        while point is None or not point.is_stalled:
            if not (step.has_contact_elements or has_active_barrier(step, p)):
                method_choice = method_choice or MethodChoice(
                    self, step, p, self.start_lbfgs(step, p), control, self.init_rounds()
                )
                points, method_choice = method_choice.iterate_points(), None
                for following in points:
                    if not _is_collision_free(step, p, following.positions):
                        break
                    p, point = following.positions, following
                    yield point
                    if point.is_past_saddle:
                        break
                if point and (point.is_past_saddle or point.is_stalled):
                    continue
            before = self.factor.num_factorisations
            for following in self.newton.iterate_points(step, point or DescentPoint(p, step.gradient(p))):
                moved, done = following.positions is not p, self.factor.num_factorisations
                control.add_phase("newton", int(moved), done - before)
                p, point, before = following.positions, following, done
                yield point
                if point.is_past_saddle:
                    break

    def start_lbfgs(self, step: StepObjective, p: Positions) -> AcceleratedState:
        """Start L-BFGS, without surface contact.

        Args:
            step: objective of the step, whose barrier energies are ignored.
            p: initial guess (n, 3) [m].
        """
        return self._lbfgs.init_state(self._without_barriers(step.problem), p)

    def start_lower(self, problem: StepProblem, guess: Positions, *, measures_guess: bool) -> CompiledAccelerationState:
        """Start L-BFGS at the lower one of the guess and the inertial prediction, if `starts_lower`.

        Args:
            problem: step whose objective is minimised.
            guess: initial guess (n, 3) [m].
            measures_guess: whether the residual at the guess is needed.
        """
        return self._lbfgs.init_lower_state(self._without_barriers(problem), guess, measures_guess=measures_guess)

    def _without_barriers(self, problem: StepProblem) -> StepProblem:
        return ignore_barriers(problem) if self._system_has_barriers else problem

    def can_terminate(self, step: StepObjective, at: DescentPoint) -> bool:
        """Return whether a stationary point is a minimum, as far as the method can determine.

        Args:
            step: objective of the step.
            at: stationary point, whose exact Hessian is factorised.
        """
        return self.newton.can_terminate(step, at)

    def iteration_phases(self, step: StepObjective, at: DescentPoint) -> dict[str, Callable[[], object]]:
        """Return the phases of Newton's method, and a round of L-BFGS, as callables.

        Args:
            step: objective of the step.
            at: point at which the phases are evaluated.
        """
        return self.newton.iteration_phases(step, at) | {"lbfgs": lambda: self.relax_point(step, at.positions)}

    def relax_point(self, step: StepObjective, p: Positions) -> DescentPoint:
        """Return the point after a few iterations of L-BFGS.

        Args:
            step: objective of the step, whose barrier energies are ignored.
            p: positions (n, 3) [m] from which L-BFGS starts.
        """
        run = self.start_lbfgs(step, p)
        run.run_iterations(LoopLimits(_RELAXATION_ITERATIONS, 0.0, 0.0, RESIDUAL_NEVER))
        return compute_current_point(run)


def _is_collision_free(step: StepObjective, before: Positions, after: Positions) -> bool:
    """Return whether the displacement between positions (n, 3) is collision-free and ends without active contacts."""
    if not step.barrier_energies:
        return True
    return step.max_step_size(before, after - before) == 1.0 and not has_active_barrier(step, after)
