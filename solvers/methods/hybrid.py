"""A hybrid: L-BFGS and Newton's method with predicted tensions in turns, Newton's method in the end.

    H(t) = M/dt^2 + sum_e k nn' + t_e/l_e (I - nn'),   d = -H(t)^-1 grad g(p),   t_e <- k_e (l_e + n (A d)_e - r_e)

Stiff springs hardly change their lengths, but on the way to the minimum they do, and their tensions k (l - r) then are
larger than the true ones by orders of magnitude. In the exact Hessian they make springs stiff against bending, or
unstable, where they are neither. Here tensions are unknowns of their own. Newton's method on the optimality conditions
of both (primal-dual, as in interior point methods: Nocedal and Wright 2006, chapter 19; tensions that outlive an
iteration stabilise stiff springs in Tournier et al. 2015, "Stable Constrained Dynamics") comes down to a Hessian with
predicted tensions, and its steps are longer by as much. What such a step stretches at second order is local: a few
iterations of L-BFGS take it back. The first one starts where the step before ended, from smooth positions. Where H(t)
has no factor a multiple of inertia is added, as small a one as leaves a factor: a step along what is unstable is the
longer the nearer that multiple is to the least (More and Sorensen 1983).

L-BFGS comes first, over a factor of Q in float32: it is the memory that its iterations wait for, and its directions
need no more digits. Once it gets slow, or has so little left that a saddle is as likely as a minimum, one step goes by
the true tensions, and aside where the curvature there is negative: symmetric starts lead to saddles, near which all
methods are slow. If the objective fell as the quadratic model promised, these tensions are the prediction. Then
whichever brought the greater descent for its cost the last time goes on. The exact method takes over when the Hessian
is positive definite as it is and the slope falls as it does where Newton's method converges quadratically. The start
is the lower one of first guess and free fall.

Where something is touched, the exact method does it all: contact is in no Q, so that L-BFGS begins anew whenever
another vertex is touched, and its stiffness is beyond what tensions predict. What a mesh may touch of itself L-BFGS is
not told of: it goes as if nothing were there, and where a round's way is not free, or ends in range of something, that
round never was and the exact method goes on.
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
"""Iterations of L-BFGS in a round, and what lies between the iterates of the first rounds: of the few that an easy step
takes a third at most is too many."""

_PROBE, _RELAXED = 4, 5
"""Iterations after which it is known whether L-BFGS suits a problem, and those after a Newton step."""

_QUICK = 0.5
"""The part of the residual that the very first iterations leave at most where L-BFGS suits a problem."""

_SLOW = 0.7
"""Convergence counts as slow, and a Newton step is tried, where a round still lowers the objective by more than this
part of what the round before it did."""

_LITTLE = 2e-6
"""Of the descent from the start: a round that brings no more leaves about a millionth, to a saddle or a minimum."""

_FLOPS_PER_ENTRY = 270.0
"""Flops of a factorisation that take as long as one entry of Q's factor takes in a round of L-BFGS, both measured with
all the work around them."""


@dataclass(frozen=True)
class Hybrid:
    """L-BFGS far from the minimum, Newton's method with predicted tensions nearer to it, Newton's method in the end."""

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
        """Raises NotPositiveDefinite where nothing determines some positions, Unsupported where Q fits nowhere."""
        with analysed_once():
            metric, objective = Metric(system), Objective(system)
            lbfgs = Lbfgs(precision="float32").by_factor(without_bounded(system))
            method, factor = HybridMethod(objective, metric, lbfgs), objective.matrix.factor
        facts = metric.facts | {"nnz_hessian_factor": float(factor.nonzeros)}
        choice = f"a factor of the Hessian with {factor.nonzeros:,} entries; for L-BFGS, {lbfgs.choice}"
        choice += objective.interpreted
        return PreparedDescent(objective, metric, method, choice, facts)


class HybridMethod:
    """The iteration for one system: a round of L-BFGS, or a step of one of Newton's methods."""

    def __init__(self, objective: Objective, metric: Metric, lbfgs: PreparedAccelerated) -> None:
        self.metric, self._newton, self._lbfgs = metric, NewtonMethod(metric), lbfgs
        self.diagonal: NDArray[np.float64] = np.repeat(metric.diagonal, 3)
        self.inertia: NDArray[np.float64] = np.repeat(objective.system.inertia[objective.system.free], 3)
        factor = objective.matrix.factor
        self._cost = 9.0 * max(1.0, factor.flops) / (_FLOPS_PER_ENTRY * max(1, factor.nonzeros))

    def points(self, step: StepObjective, start: Point) -> Iterator[Point]:
        """The points after `start`; where a saddle was left, all begins anew."""
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
        """The points after `start`, until the exact method does better."""
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
        """L-BFGS from p, which knows of nothing that a step may not pass through."""
        problem = step.problem
        if step.bounded:
            problem = replace(problem, system=without_bounded(problem.system))
        return self._lbfgs.begin(problem, p)

    def certifies(self, step: StepObjective, at: Point) -> bool:
        """See Method."""
        return self._newton.certifies(step, at)

    def phases(self, step: StepObjective, at: Point) -> dict[str, Callable[[], object]]:
        """Those of Newton's method, and a round of L-BFGS."""
        return self._newton.phases(step, at) | {"lbfgs": lambda: self.relaxed(step, at.positions)}

    def relaxed(self, step: StepObjective, p: Positions) -> Point:
        """Where some iterations of L-BFGS lead from p."""
        run = self._begun(step, p)
        run.iterate(Limits(_RELAXED, 0.0, 0.0, NEVER))
        return _reached(run)


def _clear(step: StepObjective, before: Point, after: Point) -> bool:
    """Whether the way between two points is free, and nothing is in range at its end."""
    if not step.bounded:
        return True
    way = after.positions - before.positions
    return step.reach(before.positions, way) == 1.0 and not near(step, after.positions)


def _reached(run: Accelerating) -> Point:
    return Point(run.positions.copy(), run.gradient())
