"""Newton's method with predicted tensions (Tournier et al. 2015, "Stable Constrained Dynamics").

    H(t) = M/dt^2 + sum_e k nn' + t_e/l_e (I - nn'),   (H(t) + s M/dt^2) d = -grad g(p)
    t_e <- k_e (l_e + n (A d)_e - r_e)

`solvers.methods.hybrid` tells why. Where H(t) is not positive definite, a step along what is unstable is the longer the
nearer s is to the least that leaves a factor (More and Sorensen 1983). So after each step that may be bolder a smaller
s is tried. How many times smaller it is, is squared where there was a factor, and where not its root is taken, so that
s comes near to the least in a few steps, and follows it.
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
"""The quadratic model counts as right where a full step lowers the objective by this part of what the slope alone
promises; of a quadratic function it is one half."""

_QUADRATIC = 0.1
"""Near a minimum a step of Newton's method leaves at most this part of the slope."""

_LEAST, _MOST, _APART = 0.1, 10.0, 4.0
"""The multiples of inertia that are added, if any, and how many times smaller the next one is at first."""


class Relaxing(Protocol):
    """What a system's method knows. inertia, diagonal: of that and of Q, (3f,) [N/m]."""

    metric: Metric
    inertia: NDArray[np.float64]
    diagonal: NDArray[np.float64]

    def relaxed(self, step: StepObjective, p: Positions) -> Point:
        """Where what is local leads from p: what a step stretches at second order is taken back."""
        ...


class Predicting:
    """Newton's method with predicted tensions, in one solve."""

    def __init__(self, method: Relaxing, step: StepObjective, origin: Point) -> None:
        """origin: where the first step starts."""
        self._method, self._step = method, step
        self._origin: Point | None = origin
        self._tension = np.zeros(len(step.whole.springs.stiffness))
        self._shift, self._apart, self._slope, self._bold = np.inf, _APART, -np.inf, False

    def begin(self, at: Point) -> tuple[Point, float, bool]:
        """A point that is lower, if there is one, by the true tensions; by how much [J]; whether it lies aside."""
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
        self._bold = kept or self._shift == np.inf
        self._tension += length * (predicted - self._tension)
        gain = gained(step, point, following)
        if gain == 0.0:
            return point, 0.0, at is point
        return following, gain, self._shift == 0.0 and kept and slope >= _QUADRATIC * before

    def _solved(self, hessian: Hessian, b: Positions) -> Positions | None:
        """The product of b and the inverse, with less added than the last time where the model was right then, and
        more where there is no factor."""
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
        """The same with a multiple of inertia; with negative lateral parts left out where that is infinite."""
        keep, by = (1.0, shift) if shift < np.inf else (0.0, 0.0)
        return hessian.solve_anew(b, keep, by * self._method.inertia, self._tension)

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


def gained(step: StepObjective, before: Point, after: Point) -> float:
    """By how much the objective falls [J], 0 where it rises or round-off hides it."""
    rise, noise = step.rise(before.positions, after.positions)
    return -rise if -rise > noise else 0.0
