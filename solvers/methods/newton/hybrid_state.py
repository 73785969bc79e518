"""The states of a solve by the hybrid: by all methods, and by L-BFGS alone until another one is needed."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from springbench.solvers.iteration.descent_method import (
    DescentPoint,
)
from springbench.solvers.iteration.iterative_solver import SolverState
from springbench.solvers.kernels.descent_rounds import GROUP_ITERATIONS, REASON_SWITCH
from springbench.solvers.kernels.iteration_loop import (
    ONE_ITERATION,
    REASON_ITERATIONS,
    REASON_STALLED,
    RESIDUAL_EACH,
    RESIDUAL_LAST,
    LoopLimits,
    check_residual,
)
from springbench.solvers.methods.newton.hybrid_choice import NO_GRADIENT, MethodChoice, SolveControl, limit_rounds
from springbench.solvers.methods.newton.negative_curvature import (
    is_positive_definite,
)
from springbench.solvers.methods.quasi_newton.windowed_acceleration import (
    CompiledAccelerationState,
)
from springbench.solvers.model.step_problem import Positions, StepProblem
from springbench.solvers.objective.step_objective import StepObjective

if TYPE_CHECKING:
    from springbench.solvers.methods.newton.hybrid_newton import PreparedHybrid


class HybridState(SolverState):
    """The state of a solve, which does many rounds of L-BFGS at once.

    Attributes:
        positions: current positions (n, 3) [m].
    """

    def __init__(self, prepared: PreparedHybrid, problem: StepProblem, guess: Positions) -> None:
        self._prepared, self._problem, self._control = prepared, problem, SolveControl()
        self._point: DescentPoint | None = None
        self.positions = guess
        self._start_points()

    def _start_points(self) -> None:
        """Start the iteration at the initial guess."""
        self.positions = self._step.apply_exact_pins(self.positions)
        self._points = self._prepared.hybrid_iteration.iterate_from(self._step, self.positions, self._control)

    @cached_property
    def _step(self) -> StepObjective:
        return StepObjective(self._prepared.fixed_objective, self._problem)

    def step_state(self) -> bool:
        """Do one iteration; return False if the positions do not change."""
        return self._advance(ONE_ITERATION)

    def _advance(self, limits: LoopLimits) -> bool:
        """Do iterations within the limits; return False if the positions do not change."""
        before, self._control.limits, self._control.residual = self.positions, limits, None
        self._point = next(self._points, self._point)
        if self._point is not None:
            self.positions = self._point.positions
        return self.positions is not before

    def residual(self) -> float:
        """Return the residual [J^(1/2)] at the current positions."""
        if self._control.residual is not None:
            return self._control.residual
        return self._prepared.metric.residual(self._current_point().gradient)

    def _current_point(self) -> DescentPoint:
        return self._point or DescentPoint(self.positions, self._step.gradient(self.positions))

    def run_iterations(self, limits: LoopLimits) -> tuple[int, float, int]:
        """Iterate up to the limits; return count, residual and reason."""
        count, found, ended = 0, np.nan, REASON_ITERATIONS
        while ended == REASON_ITERATIONS and count < limits.max_iterations:
            moved = self._advance(limits._replace(max_iterations=limits.max_iterations - count) if count else limits)
            count += self._control.num_iterations if moved else 0
            if limits.residual_mode == RESIDUAL_EACH:
                found = self.residual()
                if not (self._point and self._point.is_past_saddle):  # the residual is small next to a saddle
                    ended = check_residual(found, limits)
            if ended == REASON_ITERATIONS and not moved:
                ended = REASON_STALLED
        if limits.residual_mode == RESIDUAL_LAST or (limits.residual_mode == RESIDUAL_EACH and count == 0):
            found = self.residual()
        return count, found, ended

    def can_terminate(self) -> bool:
        """Return whether the current positions are a minimum; the next iteration leaves a saddle."""
        control = self._control
        control.must_escape = not (
            control.is_minimum
            or self._prepared.saddle_check.is_bounded_by_springs(self.positions)
            or is_positive_definite(self._step, self.positions)
        )
        return not control.must_escape

    @property
    def solver_phases(self) -> dict[str, tuple[int, float]]:
        """Iterations and cost of each method so far."""
        return self._control.solver_phases


class LbfgsFirstState(HybridState):
    """The state of a solve by L-BFGS alone, until another method is needed.

    Nothing is prepared for the other methods before that. Most steps of small meshes end with L-BFGS alone, and the
    preparation of the other methods would cost as much as such a step.
    """

    _run: CompiledAccelerationState | None = None
    _num_rounds = 0
    _is_lbfgs_alone = True

    def _start_points(self) -> None:
        """Do nothing; the first round starts the solve."""

    def compute_start_residual(self) -> float:
        """Start L-BFGS and return the residual [J^(1/2)] at the initial guess."""
        return self._start_run(measures_guess=True).guess_residual

    def _start_run(self, *, measures_guess: bool) -> CompiledAccelerationState:
        """Start L-BFGS; `measures_guess` states whether the residual at the guess is needed."""
        method = self._prepared.hybrid_iteration
        run = self._run = method.start_lower(self._problem, self.positions, measures_guess=measures_guess)
        self._start, self._rounds = run.positions.copy(), method.init_rounds()
        self._floor = method.round_off(self._start)
        self._one_round = limit_rounds(ONE_ITERATION, self._floor)
        return run

    def run_iterations(self, limits: LoopLimits) -> tuple[int, float, int]:
        """Iterate up to the limits; return count, residual and reason."""
        if self._num_rounds == 0 and limits.max_iterations == 0:
            self.positions = self._step.apply_exact_pins(self.positions)
        return super().run_iterations(limits)

    def _advance(self, limits: LoopLimits) -> bool:
        """Do rounds of L-BFGS as long as it is alone."""
        if not self._is_lbfgs_alone:
            return super()._advance(limits)
        control, run = self._control, self._run or self._start_run(measures_guess=False)
        if control.must_escape:
            self._end_lbfgs_alone(run, np.inf, REASON_ITERATIONS)
            return super()._advance(limits)
        limits = self._one_round if limits is ONE_ITERATION else limit_rounds(limits, self._floor)
        count, residual, ended = run.run_rounds(self._rounds, limits)
        control.num_iterations, control.residual = count, residual
        self._num_rounds += count
        self.positions = run.positions
        if ended in (REASON_STALLED, REASON_SWITCH) or residual <= self._floor:
            self._end_lbfgs_alone(run, residual, ended)
        return True

    def _end_lbfgs_alone(self, run: CompiledAccelerationState, residual: float, ended: int) -> None:
        """End the phase of L-BFGS alone, and continue with the choice between the methods."""
        method, control = self._prepared.hybrid_iteration, self._control
        control.solver_phases, self._is_lbfgs_alone, self._run = dict(self.solver_phases), False, None
        self._point = DescentPoint(run.positions.copy(), NO_GRADIENT)
        self.positions = self._point.positions
        method_choice = MethodChoice(method, self._step, self._start, run, control, self._rounds, self._point)
        method_choice.record_rounds(residual, ended)
        self._points = method.continue_from(self._step, self._point, control, method_choice)

    @property
    def solver_phases(self) -> dict[str, tuple[int, float]]:
        """Iterations and cost of each method so far."""
        if not self._is_lbfgs_alone:
            return self._control.solver_phases
        groups = int(self._rounds["num_iterations"][0]) / GROUP_ITERATIONS if self._num_rounds else 0.0
        return {"lbfgs": (self._num_rounds, groups / self._prepared.hybrid_iteration.newton_cost)}
