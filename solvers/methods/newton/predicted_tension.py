"""Newton's method with predicted tensions (Tournier et al. 2015, "Stable Constrained Dynamics").

    H(t) = M/dt^2 + sum_e k nn' + t_e/l_e (I - nn'),   (H(t) + s M/dt^2) d = -grad g(p)
    t_e <- k_e (l_e + n (A d)_e - r_e)

`springbench.solvers.methods.newton.hybrid_newton` gives the motivation. If H(t) is not positive
definite, a step along unstable
modes is longer the closer s is to the smallest value that has a factor (More and Sorensen 1983). So a smaller s is
tried after each step that allows it. The ratio of reduction is squared if there was a factor; otherwise its square root
is taken. So s approaches the smallest value in a few steps, and then tracks it.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.iteration.descent_method import (
    DescentPoint,
    ResidualMetric,
    backtracking_line_search,
    inner_product,
)
from springbench.solvers.kernels.line_search_conditions import is_armijo_step
from springbench.solvers.methods.newton.negative_curvature import probe_negative_curvature
from springbench.solvers.model.step_problem import Positions
from springbench.solvers.objective.step_objective import Hessian, StepObjective

_MODEL_DECREASE_FRACTION = 0.25
"""The quadratic model counts as accurate if a full step decreases the objective by this fraction of the linear
prediction; for a quadratic function the fraction is one half."""

_QUADRATIC_SLOPE_RATIO = 0.1
"""Near a minimum a Newton step leaves at most this fraction of the slope."""

_MIN_SHIFT, _MAX_SHIFT, _SHIFT_RATIO = 0.1, 10.0, 4.0
"""Smallest and largest multiple of the inertia that is added, if any, and the initial ratio of its reduction."""


class RelaxationMethod(Protocol):
    """The data of the method for one system: diagonals of the inertia and of Q, (3f,) [N/m]."""

    metric: ResidualMetric
    inertia_diagonal: NDArray[np.float64]
    system_diagonal: NDArray[np.float64]

    def relax_point(self, step: StepObjective, p: Positions) -> DescentPoint:
        """Return the point after local relaxation of p, which removes the second-order stretch of a step."""
        ...


class PredictedTensionNewton:
    """Newton's method with predicted tensions in one solve."""

    def __init__(self, method: RelaxationMethod, step: StepObjective, origin: DescentPoint) -> None:
        """Create the state with the point from which the first step starts."""
        self._method, self._step = method, step
        self._first_point: DescentPoint | None = origin
        self._predicted_tensions = np.zeros(len(step.fixed_objective.springs.stiffness))
        self._shift, self._shift_ratio, self._slope, self._can_reduce_shift = np.inf, _SHIFT_RATIO, -np.inf, False

    def compute_first_step(self, at: DescentPoint) -> tuple[DescentPoint, float, bool]:
        """Return a lower point by the true tensions, the decrease [J], and whether it lies off a saddle point."""
        step = self._step
        hessian = step.hessian(at.positions)
        descent = hessian.factorise_and_solve(at.gradient, 0.0)
        if descent is None:
            return at, 0.0, False
        self._slope = -inner_product(at.gradient, descent)
        following = backtracking_line_search(step, at, -descent) or at
        self._can_reduce_shift = objective_decrease(step, at, following) > -_MODEL_DECREASE_FRACTION * self._slope
        curvature = probe_negative_curvature(step, following, hessian, self._method.system_diagonal)
        following = curvature or following
        if self._can_reduce_shift:
            self._first_point, self._predicted_tensions = (
                None,
                step.linearise_tensions(following.positions, np.zeros_like(descent)),
            )
        return following, objective_decrease(step, at, following), curvature is not None

    def compute_next_step(self, point: DescentPoint) -> tuple[DescentPoint, float, bool]:
        """Return a lower point or the same one, the decrease [J], and whether to continue with the exact Hessian."""
        step, at = self._step, self._first_point or point
        self._first_point = None
        hessian = step.hessian(at.positions)
        descent = self._solve_regularised(hessian, at.gradient)
        if descent is None:
            return point, 0.0, True
        direction = -descent
        slope, before = inner_product(at.gradient, direction), self._slope
        self._slope = slope
        if not -slope > self._method.metric.energy_roundoff(at.positions):
            return point, 0.0, True
        predicted = step.linearise_tensions(at.positions, direction)
        length, following, is_sufficient = self._line_search(at, direction, slope)
        if following is None:
            return point, 0.0, True
        self._can_reduce_shift = is_sufficient or self._shift == np.inf
        self._predicted_tensions += length * (predicted - self._predicted_tensions)
        gain = objective_decrease(step, point, following)
        if gain == 0.0:
            return point, 0.0, at is point
        return following, gain, self._shift == 0.0 and is_sufficient and slope >= _QUADRATIC_SLOPE_RATIO * before

    def _solve_regularised(self, hessian: Hessian, b: Positions) -> Positions | None:
        """Solve with the regularised Hessian.

        The shift is reduced if the model was accurate in the previous step, and increased while there is no factor.
        """
        if self._can_reduce_shift and self._shift > 0.0:
            less = min(self._shift / self._shift_ratio, _MAX_SHIFT)
            less = less if less >= _MIN_SHIFT else 0.0
            solution = self._solve_shifted(hessian, b, less)
            if solution is not None:
                self._shift, self._shift_ratio = less, min(_SHIFT_RATIO, self._shift_ratio**2)
                return solution
            self._shift_ratio = self._shift_ratio**0.5 if self._shift < np.inf else _SHIFT_RATIO
        while (solution := self._solve_shifted(hessian, b, self._shift)) is None and self._shift < np.inf:
            self._shift, self._shift_ratio = max(_MIN_SHIFT, _SHIFT_RATIO * self._shift), _SHIFT_RATIO
            self._shift = self._shift if self._shift <= _MAX_SHIFT else np.inf
        return solution

    def _solve_shifted(self, hessian: Hessian, b: Positions, shift: float) -> Positions | None:
        """Solve with a multiple of the inertia added; an infinite one drops negative transverse parts instead."""
        keep, by = (1.0, shift) if shift < np.inf else (0.0, 0.0)
        return hessian.factorise_and_solve(b, keep, by * self._method.inertia_diagonal, self._predicted_tensions)

    def _line_search(
        self, at: DescentPoint, direction: Positions, slope: float
    ) -> tuple[float, DescentPoint | None, bool]:
        """Return the step size, the new point, and whether the decrease agrees with the model."""
        step = self._step
        p = step.apply_exact_pins(at.positions + direction)
        if step.objective_change(at.positions, p)[0] <= _MODEL_DECREASE_FRACTION * slope:
            return 1.0, DescentPoint(p, step.gradient(p)), True
        relaxed = self._method.relax_point(step, p)
        if is_armijo_step(step.objective_change(at.positions, relaxed.positions)[0], 1.0, slope, 0.0):
            return 1.0, relaxed, False
        found = backtracking_line_search(step, at, direction)
        if found is None:
            return 0.0, None, False
        length = inner_product(found.positions - at.positions, direction) / inner_product(direction, direction)
        return length, self._method.relax_point(step, found.positions), False


def objective_decrease(step: StepObjective, before: DescentPoint, after: DescentPoint) -> float:
    """Return the decrease of the objective [J]; 0 if it increases or the decrease is below round-off."""
    rise, noise = step.objective_change(before.positions, after.positions)
    return -rise if -rise > noise else 0.0
