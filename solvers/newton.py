"""Newton's method with the exact Hessian and a direct factorisation (Nocedal and Wright 2006, section 3.4).

    p <- p - t (H + E)^-1 grad g(p)

The Hessian of compressed springs may be indefinite. It is left exact wherever it has a Cholesky factor, which keeps the
convergence quadratic; where it has none, as little as will do is taken from the springs' negative lateral parts, and in
the end a multiple of the diagonal of Q is added. Clamping those parts everywhere (Teran et al. 2005) would converge
linearly; and the less is taken, the faster a saddle's surroundings are left. A point where the gradient vanishes but
the exact Hessian has no factor is left too (`solvers.saddles`). A factor serves for more than one step, as long as the
objective falls as the slope promises (Shamanskii 1967): a solve costs a fifth of it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.descent import Metric, Point, PreparedDescent, dot, search
from solvers.objective import Hessian, Objective, StepObjective
from solvers.problem import System
from solvers.saddles import certified, leave

_LEVELS = ((1.0, 0.0), *((1.0 - 4.0**-k, 0.0) for k in range(8, -1, -1)), *((0.0, 10.0**k) for k in range(-4, 9, 2)))
"""What is kept of negative lateral parts, and what multiple of Q's diagonal is added: the exact Hessian first, then
from the level before the last one that it took, the first that factorises."""

_AGAIN = 2
"""More steps by the same factor, at most."""

_KEPT = 0.25
"""Of the decrease that the slope promises, what such a step must bring; half of it is what a quadratic keeps."""

_SLIGHT = 1e-12
"""Of the steepest slope of a solve, what tells of a saddle where the exact Hessian has no factor."""


class _Past(NamedTuple):
    """level: the first to be tried where the exact Hessian has no factor; steepest: slope so far [J]."""

    level: int = 5
    steepest: float = 0.0


@dataclass(frozen=True)
class Newton:
    """Newton's method. Where it ends by a close tolerance, or stalls, no curvature is negative but by round-off."""

    minimises: ClassVar[bool] = True
    descends: ClassVar[bool] = True

    def prepare(self, system: System) -> PreparedDescent:
        """Raises NotPositiveDefinite where nothing determines some positions, Unsupported where Q fits nowhere."""
        metric, objective = Metric(system), Objective(system)
        factor = objective.matrix.factor
        facts = metric.facts | {"nnz_hessian_factor": float(factor.nonzeros)}
        choice = f"a factor of the Hessian with {factor.nonzeros:,} entries; residuals by {metric.choice}"
        return PreparedDescent(objective, metric, NewtonMethod(metric), choice, facts)


class NewtonMethod:
    """The iteration of Newton's method for one system."""

    def __init__(self, metric: Metric) -> None:
        self._metric = metric
        self._diagonal: NDArray[np.float64] = np.repeat(metric.diagonal, 3)

    def points(self, step: StepObjective, start: Point) -> Iterator[Point]:
        """The points after `start`."""
        point, past = start, _Past()
        while not point.stalled:
            point, past = self._next(step, point, past)
            yield point

    def certifies(self, step: StepObjective, at: Point) -> bool:
        """See Method."""
        return certified(step, at.positions)

    def phases(self, step: StepObjective, at: Point) -> dict[str, Callable[[], object]]:
        """The gradient, the Hessian with its factorisation, and a solve with it."""
        hessian, (keep, by) = step.hessian(at.positions), _LEVELS[-1]  # any other may have no factor to solve with
        hessian.factorise(keep, by * self._diagonal)
        return {
            "gradient": lambda: step.gradient(at.positions),
            "factor": lambda: hessian.factorise(keep, by * self._diagonal),
            "solve": lambda: hessian.solve(at.gradient),
        }

    def _next(self, step: StepObjective, at: Point, past: _Past) -> tuple[Point, _Past]:
        """The point after `at`, and what is to be known then."""
        hessian = step.hessian(at.positions)
        levels = (0, *range(past.level, len(_LEVELS)))
        level = next((k for k in levels if hessian.factorise(_LEVELS[k][0], _LEVELS[k][1] * self._diagonal)), None)
        if level is None:
            return at._replace(stalled=True), past
        direction = -hessian.solve(at.gradient)
        fall = -dot(at.gradient, direction)
        now = _Past(max(1, level - 1) if level else past.level, max(fall, past.steepest))
        known = fall > self._metric.round_off(at.positions)
        slight = fall <= _SLIGHT * now.steepest
        found = search(step, at, direction) if known and not (slight and level > 0) else None
        if found is None and level > 0:
            found = leave(step, at, hessian, self._diagonal) or (search(step, at, direction) if known else None)
        if found is None:
            return at._replace(stalled=True), now
        return found if found.left else self._again(step, found, hessian), now

    def _again(self, step: StepObjective, at: Point, hessian: Hessian) -> Point:
        """Where more steps by the same factor lead."""
        for _ in range(_AGAIN):
            direction = -hessian.solve(at.gradient)
            slope = dot(at.gradient, direction)
            p = step.placed(at.positions + direction)
            if not (-slope > self._metric.round_off(p) and step.rise(at.positions, p)[0] <= _KEPT * slope):
                break
            at = Point(p, step.gradient(p))
        return at
