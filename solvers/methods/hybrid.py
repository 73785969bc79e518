"""A hybrid: L-BFGS and Newton's method with predicted tensions in turns, Newton's method in the end.

    H(t) = M/dt^2 + sum_e k nn' + t_e/l_e (I - nn'),   d = -H(t)^-1 grad g(p),   t_e <- k_e (l_e + n (A d)_e - r_e)

Stiff springs hardly change their lengths, but on the way to the minimum they do, and their tensions k (l - r) then are
larger than the true ones by orders of magnitude. In the exact Hessian they make springs stiff against bending, or
unstable, where they are neither. Here tensions are unknowns of their own. Newton's method on the optimality conditions
of both (primal-dual, as in interior point methods: Nocedal and Wright 2006, chapter 19; tensions that outlive an
iteration stabilise stiff springs in Tournier et al. 2015, "Stable Constrained Dynamics") comes down to a Hessian with
predicted tensions, and its steps are longer by as much. What such a step stretches at second order is local: a few
iterations of L-BFGS take it back. The first one starts where the step before ended, from smooth positions.

L-BFGS comes first, over a factor of Q in float32: it is the memory that its iterations wait for, and its directions
need no more digits. Once it gets slow, whichever brought the greater descent for its cost the last time goes on. The
exact method takes over when the Hessian is positive definite as it is and the slope falls as it does where Newton's
method converges quadratically. The start is the lower one of first guess and free fall.

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

from solvers.about import About, Reference
from solvers.core.acceleration import Accelerating
from solvers.core.bounds import without_bounded
from solvers.core.descent import Metric, Point, PreparedDescent, dot, lower, near, search
from solvers.core.fixed_objective import Objective
from solvers.core.objective import Hessian, StepObjective
from solvers.kernels.line_search import falls
from solvers.kernels.loop import NEVER, STALLED, Limits, at_most
from solvers.methods.lbfgs import Lbfgs
from solvers.methods.newton import NewtonMethod
from solvers.methods.quasi_newton import PreparedAccelerated
from solvers.problem import Positions, System

_PROBE, _ROUND, _RELAXED = 4, 10, 5
"""Iterations of L-BFGS at the very first, in a round (the first one's are among them), and after a Newton step."""

_QUICK = 0.5
"""The part of the residual that the very first iterations leave at most where L-BFGS suits a problem."""

_SLOW = 0.8
"""Convergence counts as slow, and a Newton step is tried, where a round still lowers the objective by more than this
part of what the round before it did."""

_KEPT = 0.25
"""The quadratic model counts as right where a full step lowers the objective by this part of what the slope alone
promises; of a quadratic function it is one half."""

_QUADRATIC = 0.1
"""Near a minimum a step of Newton's method leaves at most this part of the slope."""

_LEVELS = ((1.0, 0.0), (1.0, 0.1), (1.0, 1.0), (1.0, 10.0), (0.0, 0.0))
"""What is kept of negative lateral parts, and what multiple of inertia is added. The last one is positive definite."""

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
        metric, objective = Metric(system), Objective(system)
        lbfgs = Lbfgs(precision="float32").by_factor(without_bounded(system))
        method = HybridMethod(objective, metric, lbfgs)
        factor = objective.matrix.factor
        facts = metric.facts | {"nnz_hessian_factor": float(factor.nonzeros)}
        choice = f"a factor of the Hessian with {factor.nonzeros:,} entries; for L-BFGS, {lbfgs.choice}"
        choice += objective.interpreted
        return PreparedDescent(objective, metric, method, choice, facts)


class HybridMethod:
    """The iteration for one system: a round of L-BFGS, or a step of one of Newton's methods."""

    def __init__(self, objective: Objective, metric: Metric, lbfgs: PreparedAccelerated) -> None:
        self.metric, self._newton, self._lbfgs = metric, NewtonMethod(metric), lbfgs
        self.inertia = np.repeat(objective.system.inertia[objective.system.free], 3)
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
        point = start
        predicting = _Predicting(self, step, start)
        run: Accelerating | None = self._begun(step, point.positions)
        before = run.residual()
        _, residual, _ = run.iterate(at_most(_PROBE))
        gain, newton_gain = (np.inf, 0.0) if residual <= _QUICK * before else (0.0, np.inf)
        iterations, fallen, ended = _ROUND - _PROBE, 0.0, False
        while not ended:
            if gain > newton_gain:
                if run is None:
                    run, fallen = self._begun(step, point.positions), 0.0
                _, residual, verdict = run.iterate(at_most(iterations))
                following, iterations = _reached(run), _ROUND
                ended = verdict == STALLED or residual**2 <= self.metric.round_off(following.positions)
                last, gain, fallen = gain, run.fallen - fallen or _gain(step, point, following), run.fallen
                if newton_gain == 0.0 and (gain == 0.0 or gain > _SLOW * last):
                    newton_gain = np.inf
            else:
                run = None
                following, fall, ended = predicting.next(point)
                newton_gain = fall / self._cost
                gain = gain or newton_gain  # until it is known
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


class _Predicting:
    """Newton's method with predicted tensions, in one solve."""

    def __init__(self, method: HybridMethod, step: StepObjective, origin: Point) -> None:
        """origin: where the first step starts."""
        self._method, self._step = method, step
        self._origin: Point | None = origin
        self._tension = np.zeros(len(step.whole.springs.stiffness))
        self._level, self._slope, self._bold = len(_LEVELS), -np.inf, True

    def next(self, point: Point) -> tuple[Point, float, bool]:
        """A lower point, or the same one; by how much [J]; whether the exact method does better from there."""
        step, at = self._step, self._origin or point
        self._origin = None
        hessian = step.hessian(at.positions)
        descent = self._solved(hessian, at.gradient)
        if descent is None:
            return point, 0.0, True
        direction = -descent
        slope, before = dot(at.gradient, direction), self._slope
        self._slope = slope
        if not -slope > self._method.metric.round_off(at.positions):
            return point, 0.0, True
        predicted = step.tensions(at.positions, direction)
        length, following, kept = self._along(at, direction, slope)
        if following is None:
            return point, 0.0, True
        self._bold = kept
        self._tension += length * (predicted - self._tension)
        gain = _gain(step, point, following)
        if gain == 0.0:
            return point, 0.0, at is point
        return following, gain, self._level == 0 and kept and slope >= _QUADRATIC * before

    def _solved(self, hessian: Hessian, b: Positions) -> Positions | None:
        """The product of b and the inverse on the first level that has one, from that before the last one's on."""
        for level in range(max(0, self._level - self._bold), len(_LEVELS)):
            keep, by = _LEVELS[level]
            solution = hessian.solve_anew(b, keep, by * self._method.inertia, self._tension)
            if solution is not None:
                self._level = level
                return solution
        return None

    def _along(self, at: Point, direction: Positions, slope: float) -> tuple[float, Point | None, bool]:
        """How much of the direction is gone, to where, and whether the objective falls as its model promises."""
        step = self._step
        p = step.placed(at.positions + direction)
        if step.rise(at.positions, p)[0] <= _KEPT * slope:
            return 1.0, Point(p, step.gradient(p)), True
        relaxed = self._method.relaxed(step, p)
        if falls(step.rise(at.positions, relaxed.positions)[0], 1.0, slope, 0.0):
            return 1.0, relaxed, False
        found = search(step, at, direction)
        if found is None:
            return 0.0, None, False
        length = dot(found.positions - at.positions, direction) / dot(direction, direction)
        return length, self._method.relaxed(step, found.positions), False


def _gain(step: StepObjective, before: Point, after: Point) -> float:
    """By how much the objective falls [J], 0 where it rises or round-off hides it."""
    rise, noise = step.rise(before.positions, after.positions)
    return -rise if -rise > noise else 0.0


def _clear(step: StepObjective, before: Point, after: Point) -> bool:
    """Whether the way between two points is free, and nothing is in range at its end."""
    if not step.bounded:
        return True
    way = after.positions - before.positions
    return step.reach(before.positions, way) == 1.0 and not near(step, after.positions)


def _reached(run: Accelerating) -> Point:
    return Point(run.positions.copy(), run.gradient())
