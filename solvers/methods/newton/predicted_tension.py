"""Newton's method with predicted tensions (Tournier et al. 2015, "Stable Constrained Dynamics").

    H(t) = M/dt^2 + sum_e k nn' + t_e/l_e (I - nn'),   (H(t) + s M/dt^2) d = -grad g(p)
    t_e <- k_e (l_e + n (A d)_e - r_e)

`springbench.solvers.methods.newton.hybrid_newton` gives the motivation, `inertia_shift` the choice of s.
"""

from __future__ import annotations

from math import isnan
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.iteration.descent_method import (
    DescentPoint,
    ResidualMetric,
    backtracking_line_search,
    inner_product,
)
from springbench.solvers.jit.typed_kernel import TypedKernel
from springbench.solvers.kernels.iteration_loop import LoopLimits
from springbench.solvers.kernels.line_search_conditions import is_armijo_step
from springbench.solvers.methods.local_global.accelerated_local_global import AcceleratedState
from springbench.solvers.methods.newton.inertia_shift import MODEL_DECREASE_FRACTION, InertiaShift
from springbench.solvers.methods.newton.negative_curvature import probe_negative_curvature
from springbench.solvers.methods.newton.newton_kernel import NewtonArrays, run_measured_steps
from springbench.solvers.methods.newton.predicted_tension_kernel import (
    PREDICTED_PROGRESS_DTYPE,
    QUADRATIC_SLOPE_RATIO,
    LocalRelaxation,
    StepBudget,
    project_displacement,
    run_predicted_steps,
)
from springbench.solvers.model.step_problem import Positions
from springbench.solvers.objective.step_objective import StepObjective

RELAXATION_ITERATIONS = 5
"""L-BFGS iterations after a step."""

MAX_COMPILED_STEPS = 16
"""Maximum number of Newton steps in one call of a kernel."""

_MAX_SHIFT = 10.0
"""Largest multiple of the inertia that is added; then the negative parts of the springs are dropped instead."""


class CompiledNewton(NamedTuple):
    """Kernels of steps of Newton's methods for one system.

    Attributes:
        arrays: arrays of the system.
        run_measured_steps: `springbench.solvers.methods.newton.newton_kernel.run_measured_steps`.
        run_predicted_steps: `springbench.solvers.methods.newton.predicted_tension_kernel.run_predicted_steps`.
    """

    arrays: NewtonArrays
    run_measured_steps: TypedKernel
    run_predicted_steps: TypedKernel

    @classmethod
    def from_arrays(cls, arrays: NewtonArrays) -> CompiledNewton:
        """Create the kernels for the arrays of a system."""
        return cls(arrays, *map(TypedKernel, (run_measured_steps, run_predicted_steps)))


class RelaxationMethod(Protocol):
    """The data of the method for one system.

    The diagonals are those of the inertia and of Q, (3f,) [N/m]. `compiled_newton` are the compiled steps; None if they
    are not supported. `is_very_stiff` is whether gradients of L-BFGS have too much round-off.
    """

    metric: ResidualMetric
    inertia_diagonal: NDArray[np.float64]
    system_diagonal: NDArray[np.float64]
    is_very_stiff: bool

    @property
    def compiled_newton(self) -> CompiledNewton | None: ...

    def start_lbfgs(self, step: StepObjective, p: Positions) -> AcceleratedState:
        """Start L-BFGS at positions p (n, 3) [m].

        Args:
            step: objective of the step.
            p: positions at the end of a Newton step (n, 3) [m].
        """
        ...

    def relax_point(self, step: StepObjective, run: AcceleratedState) -> DescentPoint:
        """Return the point after local relaxation, which removes the second-order stretch of a step.

        Args:
            step: objective of the step.
            run: state of L-BFGS at the end of a Newton step.
        """
        ...


class PredictedSteps(NamedTuple):
    """Result of compiled steps.

    Attributes:
        point: last point.
        num_moved: number of steps that changed the positions, all or all but the last one.
        decreases: decrease of the objective in each step [J].
        costs: factorisations in each step.
        residual: residual [J^(1/2)] at the last point, None if it is not known.
        is_trial_due: whether to continue with the exact Hessian.
    """

    point: DescentPoint
    num_moved: int
    decreases: list[float]
    costs: list[float]
    residual: float | None
    is_trial_due: bool


class FullStep(NamedTuple):
    """A step along the direction of a Hessian.

    Attributes:
        direction: direction (n, 3) [m].
        slope: derivative along it [J].
        predicted: tensions linearised for it (m,) [N].
        positions: positions at its end (n, 3) [m].
        gradient: gradient there (n, 3) [N]; None unless the decrease agrees with the quadratic model.
    """

    direction: Positions
    slope: float
    predicted: NDArray[np.float64]
    positions: Positions
    gradient: Positions | None


class PredictedTensionNewton:
    """Newton's method with predicted tensions in one solve.

    Attributes:
        relaxation: state of L-BFGS of the same step, which relaxations restart; None to create one.
    """

    def __init__(self, method: RelaxationMethod, step: StepObjective, origin: DescentPoint) -> None:
        """Create the state of a solve.

        Args:
            method: metric, diagonals and local relaxation for the system.
            step: objective of the step.
            origin: point from which the first step starts.
        """
        self._method, self._step = method, step
        self._first_point: DescentPoint | None = origin
        self._predicted_tensions = np.zeros(len(step.fixed_objective.springs.stiffness))
        self._shift, self._slope = InertiaShift(np.inf, _MAX_SHIFT), -np.inf
        self.relaxation: AcceleratedState | None = None

    def compute_first_step(self, at: DescentPoint) -> tuple[DescentPoint, float, bool]:
        """Do the first step, with the true tensions.

        Args:
            at: current point.

        Returns:
            A lower point or the same one, the decrease [J], and whether the step has left a saddle point.
        """
        step = self._step
        hessian = step.hessian(at.positions)
        descent = hessian.factorise_and_solve(at.gradient, 0.0)
        if descent is None:
            return at, 0.0, False
        self._slope = -inner_product(at.gradient, descent)
        following = backtracking_line_search(step, at, -descent, uses_rounded_slope=True) or at
        fall = compute_objective_decrease(step, at, following)
        is_accurate = fall > -MODEL_DECREASE_FRACTION * self._slope
        self._shift.can_reduce = is_accurate
        curvature = probe_negative_curvature(step, following, hessian, self._method.system_diagonal)
        if curvature is not None:
            following, fall = curvature, compute_objective_decrease(step, at, curvature)
        if is_accurate:
            self._first_point, self._predicted_tensions = (
                None,
                step.linearise_tensions(following.positions, np.zeros_like(descent)),
            )
        return following, fall, curvature is not None

    def compute_next_step(self, point: DescentPoint) -> tuple[DescentPoint, float, bool]:
        """Do a step with predicted tensions.

        Args:
            point: current point. The first of these steps starts at the origin of the solve instead, unless
                `compute_first_step` was accurate.

        Returns:
            A lower point or the same one, the decrease [J], and whether to continue with the exact Hessian.
        """
        step, at = self._step, self._first_point or point
        self._first_point = None
        full = self._shift.find_smallest(lambda shift: self._try_full_step(at, shift))
        if full is None:
            return point, 0.0, True
        slope, before = full.slope, self._slope
        self._slope = slope
        if not -slope > self._method.metric.energy_roundoff(at.positions):
            return point, 0.0, True
        length, following, is_sufficient = self._line_search(at, full)
        if following is None:
            return point, 0.0, True
        self._shift.can_reduce = is_sufficient or self._shift.value == np.inf
        self._predicted_tensions += length * (full.predicted - self._predicted_tensions)
        gain = compute_objective_decrease(step, point, following)
        if gain == 0.0:
            return point, 0.0, at is point
        return following, gain, self._shift.value == 0.0 and is_sufficient and slope >= QUADRATIC_SLOPE_RATIO * before

    def run_compiled_steps(
        self, point: DescentPoint, limits: LoopLimits, budget: StepBudget, recent: NDArray[np.float64]
    ) -> PredictedSteps | None:
        """Do steps as `compute_next_step` does them, compiled.

        Args:
            point: current point.
            limits: limits, in steps.
            budget: what ends the steps.
            recent: decrease [J] and cost of the last steps (2, k), the last one last; zero for no step; overwritten.

        Returns:
            None if such steps are not supported.
        """
        compiled, step, shift = self._method.compiled_newton, self._step, self._shift
        if compiled is None:
            return None
        if self.relaxation is None:
            self.relaxation = self._method.start_lbfgs(step, point.positions)
        if (data := self.relaxation.kernel_data) is None:
            return None
        relaxation = LocalRelaxation(*data, RELAXATION_ITERATIONS, not self._method.is_very_stiff)
        progress = np.zeros(1, PREDICTED_PROGRESS_DTYPE)
        progress[0] = shift.value, shift.max_value, shift.ratio, shift.can_reduce, self._slope, False
        at = self._first_point or point
        p, gradient, (decreases, costs) = at.positions.copy(), at.gradient.copy(), np.empty((2, MAX_COMPILED_STEPS))
        fixed, tensions = (compiled.arrays, step.step_data, step.exact_pins), self._predicted_tensions
        outputs = tensions, np.empty_like(tensions), p, gradient, recent, decreases, costs, progress
        moved, count, residual = compiled.run_predicted_steps.call(
            *fixed, relaxation, limits, budget, point.positions, at is not point, *outputs
        )
        shift.value, _, shift.ratio, can_reduce, self._slope, is_trial_due = progress.item()
        shift.can_reduce, self._first_point = bool(can_reduce), None
        return PredictedSteps(
            DescentPoint(p, gradient) if moved else point,
            moved,
            decreases[:count].tolist(),
            costs[:count].tolist(),
            None if isnan(residual) else residual,
            bool(is_trial_due),
        )

    def _try_full_step(self, at: DescentPoint, shift: float) -> FullStep | None:
        """Return the full step with a multiple of the inertia added.

        It is None if there is no factor. An infinite multiple drops negative transverse parts instead.
        """
        step, (keep, by) = self._step, (1.0, shift) if shift < np.inf else (0.0, 0.0)
        added = by * self._method.inertia_diagonal if by > 0.0 else 0.0
        descent = step.hessian(at.positions).factorise_and_solve(at.gradient, keep, added, self._predicted_tensions)
        if descent is None:
            return None
        direction = -descent
        slope, p = inner_product(at.gradient, direction), step.apply_exact_pins(at.positions + direction)
        predicted = step.linearise_tensions(at.positions, direction)
        is_sufficient = step.objective_change(at.positions, p)[0] <= MODEL_DECREASE_FRACTION * slope
        return FullStep(direction, slope, predicted, p, step.gradient(p) if is_sufficient else None)

    def _line_search(self, at: DescentPoint, full: FullStep) -> tuple[float, DescentPoint | None, bool]:
        """Return the step size, the new point, and whether the decrease agrees with the model."""
        step, direction = self._step, full.direction
        if full.gradient is not None:
            return 1.0, DescentPoint(full.positions, full.gradient), True
        relaxed = self._relax_point(full.positions)
        if is_armijo_step(step.objective_change(at.positions, relaxed.positions)[0], 1.0, full.slope, 0.0):
            return 1.0, relaxed, False
        found = backtracking_line_search(step, at, direction, uses_rounded_slope=True)
        if found is None:
            return 0.0, None, False
        length = project_displacement(at.positions, found.positions, direction)
        return length, self._relax_point(found.positions), False

    def _relax_point(self, p: Positions) -> DescentPoint:
        """Return the point after local relaxation of positions p (n, 3) [m]."""
        last, step = self.relaxation, self._step
        run = self.relaxation = self._method.start_lbfgs(step, p) if last is None else last.restart_at(p)
        return self._method.relax_point(step, run)


def compute_objective_decrease(step: StepObjective, before: DescentPoint, after: DescentPoint) -> float:
    """Return the decrease of the objective [J]; 0 if it increases or is below round-off.

    Args:
        step: the objective.
        before, after: points between which it is compared; their gradients are not used.
    """
    rise, noise = step.objective_change(before.positions, after.positions)
    return -rise if -rise > noise else 0.0
