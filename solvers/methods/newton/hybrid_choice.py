"""The choice between the methods in one solve of the hybrid; `hybrid_newton` describes its rule."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.iteration.descent_method import (
    DescentPoint,
    inner_product,
)
from springbench.solvers.kernels.descent_rounds import GROUP_ITERATIONS, REASON_SWITCH
from springbench.solvers.kernels.iteration_loop import (
    ONE_ITERATION,
    REASON_STALLED,
    RESIDUAL_EACH,
    LoopLimits,
)
from springbench.solvers.linalg.cholesky.block_cholesky import BlockCholesky
from springbench.solvers.methods.local_global.accelerated_local_global import AcceleratedState
from springbench.solvers.methods.newton.hessian_regularisation import ShiftScheduleRule, factorise_shifted
from springbench.solvers.methods.newton.inertia_shift import MODEL_DECREASE_FRACTION, InertiaShift
from springbench.solvers.methods.newton.negative_curvature import (
    escape_saddle,
    probe_negative_curvature,
)
from springbench.solvers.methods.newton.predicted_tension import PredictedTensionNewton, compute_objective_decrease
from springbench.solvers.model.step_problem import Positions
from springbench.solvers.objective.step_objective import Hessian, StepObjective

if TYPE_CHECKING:
    from springbench.solvers.methods.newton.hybrid_newton import HybridIteration

_FIRST_PATIENCE = 10.0
"""Initial multiple of the cost of an attempt, after which the exact method is tried again."""

_MODEL_RANGE = (0.3, 0.7)
"""Range of the decrease, as a fraction of the slope, in which a step agrees with the quadratic model: half of it for a
full step on a quadratic function, three quarters for half a step."""

_MEASURED_STEPS = 3
"""Number of consecutive steps of a Newton method whose decrease per cost is compared: single steps vary widely."""

_MAX_SHIFT = 1e3
"""Largest multiple of the inertia that is added to an exact Hessian; then its negative parts are reduced instead."""

NO_GRADIENT = np.empty((0, 3))
"""Placeholder for the gradient at a point of L-BFGS: the residual there is known, and the gradient is not used."""


@dataclass
class SolveControl:
    """What a solve and its loop exchange.

    Attributes:
        limits: limits of the next iterations, in rounds of L-BFGS or Newton steps.
        num_iterations: number of iterations that led to the last point.
        must_escape: whether the last point is a saddle point, to be left.
        is_minimum: whether the last point was reached by an unmodified Newton step that agrees with its model.
        residual: residual at the last point [J^(1/2)], None if it is not known.
        solver_phases: iterations and cost in Newton steps of each method so far.
    """

    limits: LoopLimits = ONE_ITERATION
    num_iterations: int = 1
    must_escape: bool = False
    is_minimum: bool = False
    residual: float | None = None
    solver_phases: dict[str, tuple[int, float]] = field(default_factory=dict)

    def add_phase(self, name: str, num_iterations: int, cost: float) -> None:
        """Record iterations and the cost of a method, and set `num_iterations`.

        Args:
            name: name of the method in `solver_phases`.
            num_iterations: iterations that led to the last point.
            cost: cost of these iterations, in Newton steps.
        """
        count, spent = self.solver_phases.get(name, (0, 0.0))
        self.solver_phases[name] = count + num_iterations, spent + cost
        self.num_iterations = num_iterations


class MeasuredRule(ShiftScheduleRule):
    """The smallest multiple of the inertia, or the shift schedule.

    The rule also measures the steps of the exact method.

    Attributes:
        agrees_with_model: whether the Hessian of the last step was unmodified and its decrease agreed with the model.
        is_exact_only: whether only the unmodified Hessian may be factorised.
    """

    def __init__(self, inertia_diagonal: NDArray[np.float64], factor: BlockCholesky) -> None:
        """Create the rule.

        Args:
            inertia_diagonal: diagonal of the inertia (3f,) [N/m].
            factor: factor of the Hessian, which counts factorisations.
        """
        self._inertia_diagonal, self._factor = inertia_diagonal, factor
        self._shift, self._level, self._before = InertiaShift(0.0, _MAX_SHIFT), cast(int | None, None), 0.0
        self._gains = {"shift": np.inf, "schedule": np.inf}  # [J] per factorisation, when last used
        self._name = "shift"
        self.agrees_with_model = self.is_exact_only = False

    def factorise_hessian(self, hessian: Hessian, at: DescentPoint, diagonal: NDArray[np.float64]) -> int | None:
        """Factorise the exact Hessian or, unless `is_exact_only`, a shifted one.

        Args:
            hessian: exact Hessian at the point.
            at: not used.
            diagonal: diagonal of the shift schedule (3f,) [N/m].

        Returns:
            0 if nothing was added, more for other factors, None for no factor.
        """
        self.agrees_with_model, self._before = False, self._factor.num_factorisations
        self._name = max(self._gains, key=lambda name: self._gains[name])
        if self.is_exact_only:
            self._level = 0 if hessian.factorise() else None
        elif self._name == "schedule":
            self._level = factorise_shifted(hessian, diagonal)
        else:
            self._level = self._shift.find_smallest(lambda shift: self._factorise_shifted(hessian, diagonal, shift))
        return self._level

    def _factorise_shifted(self, hessian: Hessian, diagonal: NDArray[np.float64], shift: float) -> int | None:
        """Factorise with a multiple of the inertia added.

        An infinite multiple stands for the shift schedule.
        """
        if shift == np.inf:
            return factorise_shifted(hessian, diagonal, first_level=1)
        added = shift * self._inertia_diagonal if shift > 0.0 else 0.0
        return int(shift > 0.0) if hessian.factorise(1.0, added) else None

    def record_step(self, step: StepObjective, hessian: Hessian, at: DescentPoint, to: DescentPoint) -> None:
        """Compare the decrease in a step with its quadratic model, and record it per factorisation.

        Args:
            step: objective of the step.
            hessian: not used.
            at: first point.
            to: point at which the line search ended.
        """
        slope = inner_product(at.gradient, at.positions - to.positions)
        fall, (low, high) = compute_objective_decrease(step, at, to), _MODEL_RANGE
        if self._name == "shift":
            self._shift.can_reduce = fall >= MODEL_DECREASE_FRACTION * slope or self._shift.value == np.inf
        if self._level:
            self._gains[self._name] = fall / (self._factor.num_factorisations - self._before)
        self.agrees_with_model = self._level == 0 and (fall == 0.0 or low * slope <= fall <= high * slope)


class MethodChoice:
    """The choice between the methods in one solve, without active contacts."""

    def __init__(
        self,
        method: HybridIteration,
        step: StepObjective,
        start: Positions,
        run: AcceleratedState,
        control: SolveControl,
        rounds: NDArray[Any],
        at: DescentPoint | None = None,
    ) -> None:
        """Start at positions (n, 3) [m], or continue at a point `at`.

        Rounds of L-BFGS have led from the positions to that point.

        Args:
            method: iteration for the system.
            step: objective of the step.
            start: positions at which the solve starts (n, 3) [m].
            run: state of L-BFGS.
            control: limits of the next iterations; counts and costs are recorded there.
            rounds: state of the rounds of L-BFGS.
            at: point from which the iteration continues; the start if omitted.
        """
        self._method, self._step, self._start, self._control = method, step, start, control
        self._run: AcceleratedState | None = run
        self._point, self._rounds = at or DescentPoint(start, NO_GRADIENT), rounds
        self._num_lbfgs_iterations, self._rival_gain = 0, 0.0  # last values read from and written to `rounds`
        self._measured_rule: MeasuredRule | None = None
        self._steepest = 0.0
        self._floor = method.round_off(start)
        self._predicting: PredictedTensionNewton | None = None
        self._gains = {"lbfgs": np.inf, "predicted tensions": 0.0, "newton": 0.0}  # [J] per cost of a group
        self._name = ""
        self._recent_steps: deque[tuple[float, float]] = deque(maxlen=_MEASURED_STEPS)  # [J], cost
        self._is_trial_due, self._patience, self._spent, self._fallen = False, _FIRST_PATIENCE, 0.0, 0.0
        self._trial_cost = _FIRST_PATIENCE * method.newton_cost  # spent by the others until the exact method is tried

    def iterate_points(self) -> Iterator[DescentPoint]:
        """Yield points of the method with the largest predicted gain, without end."""
        while True:
            point = self._escape() if self._control.must_escape else None
            if point is None:
                name = self._choose_method()
                if name != self._name:
                    self._name = name
                    self._recent_steps.clear()
                if name == "lbfgs":
                    point = self._run_lbfgs()
                else:
                    if self._run is not None:  # the gradient of L-BFGS has the round-off of its kernel
                        positions = self._point.positions
                        self._point, self._run = DescentPoint(positions, self._step.gradient(positions)), None
                    before = self._method.factor.num_factorisations
                    point = self._take_newton_step() if name == "newton" else self._take_predicted_step()
                    self._record_step(name, point, self._method.factor.num_factorisations - before)
            if point is not self._point:
                self._point, self._control.is_minimum = point, self._agrees_with_model
                yield point

    @property
    def _rule(self) -> MeasuredRule:
        """The regularisation of the exact method; a solve by L-BFGS alone needs none."""
        if self._measured_rule is None:
            self._measured_rule = MeasuredRule(self._method.inertia_diagonal, self._method.factor)
        return self._measured_rule

    @property
    def _agrees_with_model(self) -> bool:
        """Whether the last step of the exact method agreed with its quadratic model."""
        return self._measured_rule is not None and self._measured_rule.agrees_with_model

    def _choose_method(self) -> str:
        if self._agrees_with_model or self._is_trial_due or not any(self._gains.values()):
            return "newton"
        if self._gains["lbfgs"] == np.inf:
            return "lbfgs"
        return max(self._gains, key=lambda name: self._gains[name])

    def _run_lbfgs(self) -> DescentPoint:
        """Do rounds of L-BFGS up to the limits, or until another method is preferable."""
        rounds, step, limits = self._rounds, self._step, self._control.limits
        if self._run is None:
            self._run = self._method.start_lbfgs(step, self._point.positions)
            rounds["group_start"], rounds["group_end"] = 0.0, rounds["num_iterations"] + GROUP_ITERATIONS
            rounds["gain"], rounds["group_residual"] = np.inf, 0.0
        if step.barrier_energies:  # each round is checked for collisions
            limits = limits._replace(max_iterations=1)
        rival_gain = max(self._gains["predicted tensions"], self._gains["newton"])
        if rival_gain != self._rival_gain:
            rounds["rival_gain"] = self._rival_gain = rival_gain
        count, residual, ended = self._run.run_rounds(rounds, limit_rounds(limits, self._floor))
        done = int(rounds["num_iterations"][0]) - self._num_lbfgs_iterations
        self._control.add_phase("lbfgs", count, done / GROUP_ITERATIONS / self._method.newton_cost)
        if self._method.exact_lbfgs:
            point, self._control.residual = DescentPoint(self._run.positions.copy(), NO_GRADIENT), residual
        else:
            point = compute_current_point(self._run)
        self.record_rounds(residual, ended)
        return point

    def record_rounds(self, residual: float, ended: int) -> None:
        """Record the cost of rounds of L-BFGS and what follows from their end.

        Args:
            residual: last residual [J^(1/2)].
            ended: termination reason.
        """
        rounds = self._rounds
        before, self._num_lbfgs_iterations = self._num_lbfgs_iterations, int(rounds["num_iterations"][0])
        self._spent += (self._num_lbfgs_iterations - before) / GROUP_ITERATIONS
        if ended == REASON_SWITCH and rounds["is_unsuited"]:
            self._predicting = PredictedTensionNewton(self._method, self._step, self._origin())
            self._gains |= {"lbfgs": 0.0, "predicted tensions": np.inf}
            rounds["is_unsuited"], rounds["initial_residual"] = 0, np.inf
        elif ended == REASON_SWITCH:
            gain = float(rounds["gain"][0])
            self._gains["lbfgs"] = max(gain, 0.0)
            self._is_trial_due = gain >= self._rival_gain
        elif ended == REASON_STALLED or residual <= self._floor:
            self._gains["lbfgs"], self._is_trial_due = 0.0, True

    def _take_newton_step(self) -> DescentPoint:
        """Return the point after a step of the exact method.

        If the Hessian has no factor in the first attempt, the current point is returned, and predicted tensions follow.
        """
        self._rule.is_exact_only = self._predicting is None and any(self._gains.values())
        point, self._steepest = self._method.newton.next_point(self._step, self._point, self._steepest, self._rule)
        if point.is_stalled and self._rule.is_exact_only:
            self._gains["predicted tensions"] = np.inf
            return self._point
        return point

    def _take_predicted_step(self) -> DescentPoint:
        """Return the point after a step with predicted tensions."""
        step, point = self._step, self._point
        if self._predicting is None:
            self._predicting = PredictedTensionNewton(self._method, step, self._origin())
            following, _, is_past_saddle = self._predicting.compute_first_step(point)
            if is_past_saddle:
                self._gains["lbfgs"] = np.inf
            return following
        following, _, self._is_trial_due = self._predicting.compute_next_step(point)
        return following

    def _origin(self) -> DescentPoint:
        """Return the point at which the solve started."""
        return DescentPoint(self._start, self._step.gradient(self._start))

    def _record_step(self, name: str, to: DescentPoint, num_factorisations: float) -> None:
        """Record the decrease per cost of a Newton step.

        This also determines when the exact method is tried next.
        """
        fall = compute_objective_decrease(self._step, self._point, to)
        cost = self._method.newton_cost * num_factorisations
        self._control.add_phase(name, int(to.positions is not self._point.positions), num_factorisations)
        if fall == 0.0:
            self._recent_steps.clear()
        self._recent_steps.append((fall, cost))
        total_fall, total_cost = map(sum, zip(*self._recent_steps, strict=True))
        if fall > 0.0 or name == "newton" or self._is_trial_due:
            self._gains[name] = total_fall / total_cost if total_cost > 0.0 else 0.0
        if name == "newton":
            others = self._fallen / self._spent if self._spent > 0.0 else 0.0
            is_better = self._agrees_with_model or self._gains["newton"] > others
            self._patience = _FIRST_PATIENCE if is_better else 2.0 * self._patience
            self._is_trial_due, self._spent, self._fallen = False, 0.0, 0.0
            rounds = self._rounds
            self._trial_cost = self._patience * (cost or self._method.newton_cost)
            rounds["trial_iteration"] = rounds["num_iterations"] + GROUP_ITERATIONS * self._trial_cost
        else:
            self._spent, self._fallen = self._spent + cost, self._fallen + fall
            self._is_trial_due |= self._spent >= self._trial_cost

    def _escape(self) -> DescentPoint | None:
        """Return a lower point next to the current saddle point, or None."""
        self._control.must_escape = False
        step, diagonal = self._step, self._method.system_diagonal
        at = compute_current_point(self._run) if self._run is not None else self._point
        hessian = step.hessian(at.positions)
        if not hessian.factorise(0.0):
            return None
        before = self._method.factor.num_factorisations
        found = probe_negative_curvature(step, at, hessian, diagonal) or escape_saddle(step, at, hessian, diagonal)
        self._control.add_phase("escape", 1, self._method.factor.num_factorisations - before)
        return found and found._replace(is_past_saddle=True)


def limit_rounds(limits: LoopLimits, floor: float) -> LoopLimits:
    """Return the limits of rounds.

    Rounds also end where the residual is due to rounded positions.

    Args:
        limits: limits of the solve.
        floor: residual [J^(1/2)] that rounded positions leave.
    """
    limit = limits.residual_limit if limits.residual_mode == RESIDUAL_EACH else 0.0
    return LoopLimits(limits.max_iterations, limit, max(floor, limits.residual_floor), RESIDUAL_EACH)


def compute_current_point(run: AcceleratedState) -> DescentPoint:
    """Return the current point of L-BFGS, with its gradient."""
    return DescentPoint(run.positions.copy(), run.gradient())
