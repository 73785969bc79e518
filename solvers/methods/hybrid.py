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

from solvers.about import About, Reference
from solvers.core.acceleration import Accelerating
from solvers.core.bounds import without_bounded
from solvers.core.descent import Metric, Point, PreparedDescent, lower, near
from solvers.core.fixed_objective import Objective
from solvers.core.objective import StepObjective
from solvers.core.predicting import Predicting, gained
from solvers.kernels.loop import NEVER, STALLED, Limits, at_most
from solvers.linear.symbolic import analysed_once
from solvers.methods.lbfgs import Lbfgs
from solvers.methods.newton import NewtonMethod
from solvers.methods.quasi_newton import PreparedAccelerated
from solvers.problem import Positions, System

_ROUND, _FIRST = 10, ((2, 2, 3, 3), (5, 5))
"""Iterations per round of L-BFGS, and between the iterates of the first rounds: an easy step needs few iterations, of
which at most a third are then superfluous."""

_PROBE, _RELAXED = 4, 5
"""Iterations before the suitability of L-BFGS is assessed, and L-BFGS iterations after a Newton step."""

_QUICK = 0.5
"""Largest ratio of residuals after the very first iterations at which L-BFGS is considered suitable."""

_SLOW = 0.7
"""Convergence counts as slow, and a Newton step is tried, if a round still decreases the objective by more than this
fraction of the decrease of the previous round."""

_LITTLE = 2e-6
"""Fraction of the decrease since the start: a round below it leaves about a millionth, to a saddle or a minimum."""

_FLOPS_PER_ENTRY = 270.0
"""Flops of a factorisation that cost as much time as one entry of Q's factor in a round of L-BFGS; both were measured
with all overheads."""


@dataclass(frozen=True)
class Hybrid:
    """L-BFGS far from the minimum, then Newton's method with predicted tensions, then Newton's method."""

    minimises: ClassVar[bool] = True
    descends: ClassVar[bool] = True
    about: ClassVar[About] = About(
        "hybrid",
        Reference(
            "Tournier, Maxime and Nesme, Matthieu and Gilles, Benjamin and Faure, François",
            2015,
            "Stable constrained dynamics",
            "10.1145/2766969",
        ),
        first=True,
    )

    def prepare(self, system: System) -> PreparedDescent:
        """Prepare the method for a system.

        Raises:
            NotPositiveDefinite: if the system leaves some positions undetermined.
            Unsupported: if Q does not fit in memory.
        """
        with analysed_once():
            metric, objective = Metric(system), Objective(system)
            lbfgs = Lbfgs(precision="float32").by_factor(without_bounded(system))
            method, factor = HybridMethod(objective, metric, lbfgs), objective.matrix.factor
        facts = metric.facts | {"nnz_hessian_factor": float(factor.nonzeros)}
        choice = f"a factor of the Hessian with {factor.nonzeros:,} entries; for L-BFGS, {lbfgs.choice}"
        choice += objective.interpreted
        return PreparedDescent(objective, metric, method, choice, facts)


class HybridMethod:
    """The iteration for one system: a round of L-BFGS, or a step of one of the Newton methods."""

    def __init__(self, objective: Objective, metric: Metric, lbfgs: PreparedAccelerated) -> None:
        self.metric, self._newton, self._lbfgs = metric, NewtonMethod(metric), lbfgs
        self.diagonal: NDArray[np.float64] = np.repeat(metric.diagonal, 3)
        self.inertia: NDArray[np.float64] = np.repeat(objective.system.inertia[objective.system.free], 3)
        factor = objective.matrix.factor
        self._cost = 9.0 * max(1.0, factor.flops) / (_FLOPS_PER_ENTRY * max(1, factor.nonzeros))

    def points(self, step: StepObjective, start: Point) -> Iterator[Point]:
        """Yield the points after `start`; restarts after an escape from a saddle."""
        point = lower(step, start)
        while not point.stalled:
            for following in () if step.touched or near(step, point.positions) else self._approach(step, point):
                if not _clear(step, point, following):
                    break
                point = following
                yield point
            for following in self._newton.points(step, point):
                point = following
                yield point
                if point.left:
                    break

    def _approach(self, step: StepObjective, start: Point) -> Iterator[Point]:
        """Yield the points after `start`, until the exact method becomes faster."""
        point, rounds = start, iter(_FIRST)
        predicting: Predicting | None = None
        run: Accelerating | None = self._begun(step, point.positions)
        before, done = run.residual(), 0
        gain, newton_gain, fallen = np.inf, 0.0, 0.0
        ended = unsuited = False
        while not ended:
            if gain > newton_gain:
                last, began = gain, point
                if run is None:
                    run, fallen = self._begun(step, point.positions), 0.0
                for count in next(rounds, (_ROUND,)):
                    _, residual, verdict = run.iterate(at_most(count))
                    point, done = _reached(run), done + count
                    yield point
                    ended = verdict == STALLED or residual**2 <= self.metric.round_off(point.positions)
                    unsuited = done == _PROBE and residual > _QUICK * before
                    if ended or unsuited:
                        break
                gain, fallen = run.fallen - fallen or gained(step, began, point), run.fallen
                if unsuited:
                    predicting, gain = Predicting(self, step, start), 0.0
                little = _LITTLE * fallen if predicting is None else 0.0
                if newton_gain == 0.0 and (gain <= little or gain > _SLOW * last or unsuited):
                    newton_gain = np.inf
            else:
                run = None
                if predicting is None:
                    predicting = Predicting(self, step, start)
                    following, fall, beside = predicting.begin(point)
                    gain = np.inf if beside else gain
                    fall = 0.0 if beside else fall
                else:
                    following, fall, ended = predicting.next(point)
                newton_gain = fall / self._cost
                gain = gain or newton_gain
                if following is not point:
                    point = following
                    yield point

    def _begun(self, step: StepObjective, p: Positions) -> Accelerating:
        """Start L-BFGS at p, without surface contact."""
        problem = step.problem
        if step.bounded:
            problem = replace(problem, system=without_bounded(problem.system))
        return self._lbfgs.begin(problem, p)

    def certifies(self, step: StepObjective, at: Point) -> bool:
        """Return whether the stationary point `at` is a minimum, as far as the method can determine."""
        return self._newton.certifies(step, at)

    def phases(self, step: StepObjective, at: Point) -> dict[str, Callable[[], object]]:
        """Return the phases of Newton's method, and a round of L-BFGS, as callables."""
        return self._newton.phases(step, at) | {"lbfgs": lambda: self.relaxed(step, at.positions)}

    def relaxed(self, step: StepObjective, p: Positions) -> Point:
        """Return the point after a few iterations of L-BFGS from p."""
        run = self._begun(step, p)
        run.iterate(Limits(_RELAXED, 0.0, 0.0, NEVER))
        return _reached(run)


def _clear(step: StepObjective, before: Point, after: Point) -> bool:
    """Return whether the displacement between two points is collision-free and ends without active contacts."""
    if not step.bounded:
        return True
    way = after.positions - before.positions
    return step.reach(before.positions, way) == 1.0 and not near(step, after.positions)


def _reached(run: Accelerating) -> Point:
    return Point(run.positions.copy(), run.gradient())
