"""Newton's method with predicted tensions (Tournier et al. 2015, "Stable Constrained Dynamics").

    H(t) = M/dt^2 + sum_e k nn' + t_e/l_e (I - nn'),   (H(t) + s M/dt^2) d = -grad g(p)
    t_e <- k_e (l_e + n (A d)_e - r_e)

`solvers.methods.hybrid` gives the motivation. If H(t) is not positive definite, a step along unstable
modes is longer the closer s is to the smallest value that has a factor (More and Sorensen 1983). So a smaller s is
tried after each step that allows it. The ratio of reduction is squared if there was a factor; otherwise its square root
is taken. So s approaches the smallest value in a few steps, and then tracks it.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from solvers.core.descent import Metric, Point, dot, search
from solvers.core.objective import Hessian, StepObjective
from solvers.core.saddles import aside
from solvers.kernels.line_search import falls
from solvers.problem import Positions

_KEPT = 0.25
"""The quadratic model counts as accurate if a full step decreases the objective by this fraction of the linear
prediction; for a quadratic function the fraction is one half."""

_QUADRATIC = 0.1
"""Near a minimum a Newton step leaves at most this fraction of the slope."""

_LEAST, _MOST, _APART = 0.1, 10.0, 4.0
"""Smallest and largest multiple of the inertia that is added, if any, and the initial ratio of its reduction."""


class Relaxing(Protocol):
    """The data of the method for one system: diagonals of the inertia and of Q, (3f,) [N/m]."""

    metric: Metric
    inertia: NDArray[np.float64]
    diagonal: NDArray[np.float64]

    def relaxed(self, step: StepObjective, p: Positions) -> Point:
        """Return the point after local relaxation of p, which removes the second-order stretch of a step."""
        ...


class Predicting:
    """Newton's method with predicted tensions in one solve."""

    def __init__(self, method: Relaxing, step: StepObjective, origin: Point) -> None:
        """Create the state with the point from which the first step starts."""
        self._method, self._step = method, step
        self._origin: Point | None = origin
        self._tension = np.zeros(len(step.whole.springs.stiffness))
        self._shift, self._apart, self._slope, self._bold = np.inf, _APART, -np.inf, False

    def begin(self, at: Point) -> tuple[Point, float, bool]:
        """Return a lower point by the true tensions, the decrease [J], and whether it lies off a saddle point."""
        step = self._step
        hessian = step.hessian(at.positions)
        descent = hessian.solve_anew(at.gradient, 0.0)
        if descent is None:
            return at, 0.0, False
        self._slope = -dot(at.gradient, descent)
        following = search(step, at, -descent) or at
        self._bold = gained(step, at, following) > -_KEPT * self._slope
        beside = aside(step, following, hessian, self._method.diagonal)
        following = beside or following
        if self._bold:
            self._origin, self._tension = None, step.tensions(following.positions, np.zeros_like(descent))
        return following, gained(step, at, following), beside is not None

    def next(self, point: Point) -> tuple[Point, float, bool]:
        """Return a lower point or the same one, the decrease [J], and whether to continue with the exact Hessian."""
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
        self._bold = kept or self._shift == np.inf
        self._tension += length * (predicted - self._tension)
        gain = gained(step, point, following)
        if gain == 0.0:
            return point, 0.0, at is point
        return following, gain, self._shift == 0.0 and kept and slope >= _QUADRATIC * before

    def _solved(self, hessian: Hessian, b: Positions) -> Positions | None:
        """Solve with the regularised Hessian.

        The shift is reduced if the model was accurate in the previous step, and increased while there is no factor.
        """
        if self._bold and self._shift > 0.0:
            less = min(self._shift / self._apart, _MOST)
            less = less if less >= _LEAST else 0.0
            solution = self._shifted(hessian, b, less)
            if solution is not None:
                self._shift, self._apart = less, min(_APART, self._apart**2)
                return solution
            self._apart = self._apart**0.5 if self._shift < np.inf else _APART
        while (solution := self._shifted(hessian, b, self._shift)) is None and self._shift < np.inf:
            self._shift, self._apart = max(_LEAST, _APART * self._shift), _APART
            self._shift = self._shift if self._shift <= _MOST else np.inf
        return solution

    def _shifted(self, hessian: Hessian, b: Positions, shift: float) -> Positions | None:
        """Solve with a multiple of the inertia added; an infinite one drops negative transverse parts instead."""
        keep, by = (1.0, shift) if shift < np.inf else (0.0, 0.0)
        return hessian.solve_anew(b, keep, by * self._method.inertia, self._tension)

    def _along(self, at: Point, direction: Positions, slope: float) -> tuple[float, Point | None, bool]:
        """Return the step size, the new point, and whether the decrease agrees with the model."""
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


def gained(step: StepObjective, before: Point, after: Point) -> float:
    """Return the decrease of the objective [J]; 0 if it increases or the decrease is below round-off."""
    rise, noise = step.rise(before.positions, after.positions)
    return -rise if -rise > noise else 0.0
