"""Newton's method with the exact Hessian and a direct factorisation (Nocedal and Wright 2006, section 3.4).

    p <- p - t (H + E)^-1 grad g(p)

The Hessian of compressed springs may be indefinite. It is left exact wherever it has a Cholesky factor, which keeps the
convergence quadratic; where it has none, more and more is taken from the springs' negative lateral parts, and in the
end a multiple of the diagonal of Q is added. Clamping those parts everywhere (Teran et al. 2005) would converge
linearly. A point where the gradient vanishes but the exact Hessian has no factor is a saddle: it is left along a
direction of negative curvature (More and Sorensen 1979), found by power iterations on (H + E)^-1 E.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from solvers.descent import Metric, Point, PreparedDescent, dot, search
from solvers.objective import Hessian, Objective, StepObjective
from solvers.problem import Positions, System

_LEVELS = ((1.0, 0.0), (0.9, 0.0), (0.5, 0.0), (0.0, 0.0), *((0.0, 10.0**k) for k in range(-4, 9, 2)))
"""What is kept of negative lateral parts, and what multiple of Q's diagonal is added: the first that factorises."""

_POWERS = 60
"""Power iterations for a direction of negative curvature. Each widens its lead, however narrow, over the rest."""


@dataclass(frozen=True)
class Newton:
    """Newton's method. Where it stalls the exact Hessian is positive definite, as far as round-off tells."""

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
        point = start
        while not point.stalled:
            point = self._next(step, point)
            yield point

    def phases(self, step: StepObjective, at: Point) -> dict[str, Callable[[], object]]:
        """The gradient, the Hessian with its factorisation, and a solve with it."""
        hessian, (keep, by) = step.hessian(at.positions), _LEVELS[-1]  # any other may have no factor to solve with
        hessian.factorise(keep, by * self._diagonal)
        return {
            "gradient": lambda: step.gradient(at.positions),
            "factor": lambda: hessian.factorise(keep, by * self._diagonal),
            "solve": lambda: hessian.solve(at.gradient),
        }

    def _next(self, step: StepObjective, at: Point) -> Point:
        hessian = step.hessian(at.positions)
        level = next((k for k, (keep, by) in enumerate(_LEVELS) if hessian.factorise(keep, by * self._diagonal)), None)
        if level is None:
            return at._replace(stalled=True)
        direction = -hessian.solve(at.gradient)
        known = -dot(at.gradient, direction) > self._metric.round_off(at.positions)
        found = search(step, at, direction) if known else None
        if found is None and level > 0:
            found = _leave_saddle(step, at, hessian)
        return found or at._replace(stalled=True)


def certified(step: StepObjective, p: Positions) -> bool:
    """Whether the exact Hessian at p (n, 3) is positive definite in floating point."""
    return step.hessian(p).factorise()


def _leave_saddle(step: StepObjective, at: Point, hessian: Hessian) -> Point | None:
    """A lower point along a direction of negative curvature; hessian: factorised as H + E; None for no such direction.

    H x = s (H + E) x has an s below zero for such a direction x, and all s are at most 1: the power iteration on
    1 - (H + E)^-1 H tends to it.
    """
    x = np.zeros_like(at.positions)
    free = step.whole.system.free
    x[free] = np.random.default_rng(0).normal(size=(len(free), 3))
    for _ in range(_POWERS):
        product = hessian.multiply(x)
        curvature = dot(x, product)
        x = x - hessian.solve(product)
        x /= np.abs(x).max(initial=0.0) or 1.0
    curvature = dot(x, hessian.multiply(x))
    if not curvature < 0.0:
        return None
    x = -x if dot(at.gradient, x) > 0.0 else x
    reach = float(np.ptp(at.positions, axis=0).max(initial=0.0)) or 1.0
    return search(step, at, x, first=reach, curvature=curvature)
