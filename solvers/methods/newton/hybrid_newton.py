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

L-BFGS runs first, with a factor of Q in float32: its iterations are limited by memory bandwidth, and its directions
need no more digits. One step with the true tensions follows when L-BFGS converges slowly, or when the remaining
decrease is so small that a saddle is as likely as a minimum. If the curvature there is negative, the step leaves along
that direction: symmetric initial guesses lead to saddles, near which all methods are slow. If the objective decreased
as the quadratic model predicted, these tensions become the prediction. Then the method with the larger decrease per
cost in its last run continues. The exact method takes over once the unmodified Hessian is positive definite and the
slope decreases as in the quadratic convergence of Newton's method. The start is the better of the initial guess and
the inertial prediction.

With active contacts the exact method does all iterations. Contact is not part of Q, so L-BFGS would restart at each
newly active vertex, and the contact stiffness is beyond what tensions predict. L-BFGS ignores self-contact: if the
displacement of a round is not collision-free, or ends with active contacts, the round is discarded and the exact method
continues.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.iteration.descent_method import (
    DescentPoint,
    PreparedDescent,
    ResidualMetric,
    has_active_barrier,
    pick_lower_start,
)
from springbench.solvers.iteration.solver_info import Citation, SolverInfo
from springbench.solvers.kernels.iteration_loop import REASON_STALLED, RESIDUAL_NEVER, LoopLimits, iteration_limit
from springbench.solvers.linalg.cholesky.symbolic_factorisation import cache_symbolic_analysis
from springbench.solvers.methods.local_global.accelerated_local_global import AcceleratedState
from springbench.solvers.methods.newton.newton_direct import NewtonIteration
from springbench.solvers.methods.newton.predicted_tension import PredictedTensionNewton, objective_decrease
from springbench.solvers.methods.quasi_newton.lbfgs import Lbfgs
from springbench.solvers.methods.quasi_newton.windowed_acceleration import PreparedAccelerated
from springbench.solvers.model.barrier_energy import without_barriers
from springbench.solvers.model.step_problem import Positions, System
from springbench.solvers.objective.fixed_objective import FixedObjective
from springbench.solvers.objective.step_objective import StepObjective

_ROUND_ITERATIONS, _FIRST_ROUNDS = 10, ((2, 2, 3, 3), (5, 5))
"""Iterations per round of L-BFGS, and between the iterates of the first rounds: an easy step needs few iterations, of
which at most a third are then superfluous."""

_PROBE_ITERATIONS, _RELAXATION_ITERATIONS = 4, 5
"""Iterations before the suitability of L-BFGS is assessed, and L-BFGS iterations after a Newton step."""

_FAST_RESIDUAL_RATIO = 0.5
"""Largest ratio of residuals after the very first iterations at which L-BFGS is considered suitable."""

_SLOW_DECREASE_RATIO = 0.7
"""Convergence counts as slow, and a Newton step is tried, if a round still decreases the objective by more than this
fraction of the decrease of the previous round."""

_NEGLIGIBLE_DECREASE = 2e-6
"""Fraction of the decrease since the start: a round below it leaves about a millionth, to a saddle or a minimum."""

_FLOPS_PER_ENTRY = 270.0
"""Flops of a factorisation that cost as much time as one entry of Q's factor in a round of L-BFGS; both were measured
with all overheads."""


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

    def prepare(self, system: System) -> PreparedDescent:
        """Prepare the method for a system.

        Raises:
            NotPositiveDefinite: if the system leaves some positions undetermined.
            Unsupported: if Q does not fit in memory.
        """
        with cache_symbolic_analysis():
            metric, objective = ResidualMetric(system), FixedObjective(system)
            lbfgs = Lbfgs(precision="float32").prepare_with_factor(without_barriers(system))
            method, factor = HybridIteration(objective, metric, lbfgs), objective.hessian_matrix.factor
        facts = metric.stats | {"nnz_hessian_factor": float(factor.nonzeros)}
        choice = f"a factor of the Hessian with {factor.nonzeros:,} entries; for L-BFGS, {lbfgs.description}"
        choice += objective.interpreted_energies
        return PreparedDescent(objective, metric, method, choice, facts)


class HybridIteration:
    """The iteration for one system: a round of L-BFGS, or a step of one of the Newton methods."""

    def __init__(self, objective: FixedObjective, metric: ResidualMetric, lbfgs: PreparedAccelerated) -> None:
        self.metric, self._newton, self._lbfgs = metric, NewtonIteration(metric), lbfgs
        self.system_diagonal: NDArray[np.float64] = np.repeat(metric.free_diagonal, 3)
        self.inertia_diagonal: NDArray[np.float64] = np.repeat(
            objective.system.inertia_diagonal[objective.system.free_vertices], 3
        )
        factor = objective.hessian_matrix.factor
        self._newton_step_cost = 9.0 * max(1.0, factor.flops) / (_FLOPS_PER_ENTRY * max(1, factor.nonzeros))

    def iterate_points(self, step: StepObjective, start: DescentPoint) -> Iterator[DescentPoint]:
        """Yield the points after `start`; restarts after an escape from a saddle."""
        point = pick_lower_start(step, start)
        while not point.is_stalled:
            for following in (
                ()
                if step.has_contact_elements or has_active_barrier(step, point.positions)
                else self._iterate_approach(step, point)
            ):
                if not _is_collision_free(step, point, following):
                    break
                point = following
                yield point
            for following in self._newton.iterate_points(step, point):
                point = following
                yield point
                if point.is_past_saddle:
                    break

    def _iterate_approach(self, step: StepObjective, start: DescentPoint) -> Iterator[DescentPoint]:
        """Yield the points after `start`, until the exact method becomes faster."""
        point, rounds = start, iter(_FIRST_ROUNDS)
        predicting: PredictedTensionNewton | None = None
        run: AcceleratedState | None = self._start_lbfgs(step, point.positions)
        before, done = run.residual(), 0
        gain, newton_gain, fallen = np.inf, 0.0, 0.0
        ended = unsuited = False
        while not ended:
            if gain > newton_gain:
                last, began = gain, point
                if run is None:
                    run, fallen = self._start_lbfgs(step, point.positions), 0.0
                for count in next(rounds, (_ROUND_ITERATIONS,)):
                    _, residual, verdict = run.run_iterations(iteration_limit(count))
                    point, done = _current_point(run), done + count
                    yield point
                    ended = verdict == REASON_STALLED or residual**2 <= self.metric.energy_roundoff(point.positions)
                    unsuited = done == _PROBE_ITERATIONS and residual > _FAST_RESIDUAL_RATIO * before
                    if ended or unsuited:
                        break
                gain, fallen = (
                    run.objective_decrease - fallen or objective_decrease(step, began, point),
                    run.objective_decrease,
                )
                if unsuited:
                    predicting, gain = PredictedTensionNewton(self, step, start), 0.0
                little = _NEGLIGIBLE_DECREASE * fallen if predicting is None else 0.0
                if newton_gain == 0.0 and (gain <= little or gain > _SLOW_DECREASE_RATIO * last or unsuited):
                    newton_gain = np.inf
            else:
                run = None
                if predicting is None:
                    predicting = PredictedTensionNewton(self, step, start)
                    following, fall, curvature = predicting.compute_first_step(point)
                    gain = np.inf if curvature else gain
                    fall = 0.0 if curvature else fall
                else:
                    following, fall, ended = predicting.compute_next_step(point)
                newton_gain = fall / self._newton_step_cost
                gain = gain or newton_gain
                if following is not point:
                    point = following
                    yield point

    def _start_lbfgs(self, step: StepObjective, p: Positions) -> AcceleratedState:
        """Start L-BFGS at p, without surface contact."""
        problem = step.problem
        if step.barrier_energies:
            problem = replace(problem, system=without_barriers(problem.system))
        return self._lbfgs.init_state(problem, p)

    def can_terminate(self, step: StepObjective, at: DescentPoint) -> bool:
        """Return whether the stationary point `at` is a minimum, as far as the method can determine."""
        return self._newton.can_terminate(step, at)

    def iteration_phases(self, step: StepObjective, at: DescentPoint) -> dict[str, Callable[[], object]]:
        """Return the phases of Newton's method, and a round of L-BFGS, as callables."""
        return self._newton.iteration_phases(step, at) | {"lbfgs": lambda: self.relax_point(step, at.positions)}

    def relax_point(self, step: StepObjective, p: Positions) -> DescentPoint:
        """Return the point after a few iterations of L-BFGS from p."""
        run = self._start_lbfgs(step, p)
        run.run_iterations(LoopLimits(_RELAXATION_ITERATIONS, 0.0, 0.0, RESIDUAL_NEVER))
        return _current_point(run)


def _is_collision_free(step: StepObjective, before: DescentPoint, after: DescentPoint) -> bool:
    """Return whether the displacement between two points is collision-free and ends without active contacts."""
    if not step.barrier_energies:
        return True
    way = after.positions - before.positions
    return step.max_step_size(before.positions, way) == 1.0 and not has_active_barrier(step, after.positions)


def _current_point(run: AcceleratedState) -> DescentPoint:
    return DescentPoint(run.positions.copy(), run.gradient())
