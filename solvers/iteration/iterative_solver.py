"""The iteration loop of all methods, with the stop rule, its limits and the solution.

    run = init_state(problem, guess);  step_state(run), step_state(run), ...  while residual(run) > rtol * residual_0

A method supplies these three functions: an `IterativeSolver` has `init_state`, and a `SolverState` has `step_state` and
`residual`. A method that does several iterations in one call overrides `run_unchecked`. A method with a compiled loop
overrides `run_iterations` and uses the kernel version in `springbench.solvers.kernels.iteration_loop`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from operator import methodcaller
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.jit.typed_kernel import as_kernel_array
from springbench.solvers.kernels import iteration_loop, objective_kernels
from springbench.solvers.kernels.iteration_loop import LoopLimits, iteration_limit
from springbench.solvers.model.rounding_bound import is_gradient_roundoff
from springbench.solvers.model.step_problem import (
    Positions,
    ResidualIterate,
    Solution,
    StepProblem,
    StopRule,
    Unsupported,
)

if TYPE_CHECKING:
    from springbench.solvers.iteration.saddle_check import SaddleCheck

_TERMINATION_REASONS = {
    iteration_loop.REASON_ITERATIONS: "max-iter",
    iteration_loop.REASON_TOLERANCE: "converged",
    iteration_loop.REASON_FLOOR: "roundoff",
    iteration_loop.REASON_STALLED: "stalled",
}

_ROUNDOFF_CHECK_FRACTION = 1e-12
"""Fraction of `IterativeSolver.residual_scale` that no rounding error reaches. It is thousands of units in the last
place of any sum involved."""

_FAR_ORIGIN_RATIO = 1e5
"""Ratio of coordinates to extent beyond which round-off at rest is detected by the decrease of the residual."""

_MINIMUM_CHECK_RTOL = 1e-5
"""Largest rtol for which the last iterate is checked for a minimum; looser tolerances do not justify the check."""


EXACT_LENGTHS_UNSUPPORTED = (
    "supports finite stiffness only, and the scene has length constraints (a stiffness of `exact`): use "
    "avbd, which supports them, or give springs and strain limits a finite stiffness"
)
"""Reason, after the method's name, why a method without length constraints does not support the scene."""


class SolverState(ABC):
    """The state of a solve.

    Attributes:
        positions: the iterate (n, 3) [m], which the next iteration may overwrite.
        velocity: velocity at the end of the step (n, 3) [m/s], for a method that computes its own.
        start_residual: residual at the initial guess [J^(1/2)], if the method computes it at the start.

    Example:
        >>> class Descent(springbench.SolverState):
        ...     def __init__(self, problem, p):
        ...         self.problem, self.positions = problem, p
        ...     def step_state(self):
        ...         inertia = self.problem.system.inertia_diagonal[:, None]
        ...         self.positions = self.positions - self.problem.gradient(self.positions) / inertia
        ...         return True

        >>> import numpy as np
        >>> system, p = springbench.System(np.array([1.0]), time_step=0.5), np.zeros((1, 3))
        >>> start = springbench.StepStart(p, 0.0 * p, 0.0, p, system.velocity_rate)
        >>> weight = np.array([[0.0, -8.0, 0.0]])
        >>> problem = springbench.StepProblem(system, p, weight, np.empty((0, 3)), p, p, start)

        >>> state = Descent(problem, p)
        >>> state.run_unchecked(3)
        3
        >>> state.positions.tolist()
        [[0.0, -2.0, 0.0]]
    """

    positions: Positions
    velocity: Positions | None = None
    start_residual: float | None = None

    @property
    def warm_start(self) -> NDArray[np.float64] | None:
        """Warm start of the next solve, of any shape; None if the method has none."""
        return None

    @property
    def solver_phases(self) -> Mapping[str, tuple[int, float, float]] | None:
        """Iterations, counted cost and time [s] of each method so far.

        It is None for a solver that does not switch between methods.
        """
        return None

    @abstractmethod
    def step_state(self) -> bool:
        """Do one iteration; return False if round-off prevents descent and the positions do not change."""

    def compute_start_residual(self) -> float | None:
        """Return the residual at the initial guess [J^(1/2)] before any iteration.

        It is None if it costs extra work.
        """
        return self.start_residual

    def residual(self) -> float:
        """Return |Q^-1 grad g|_Q [J^(1/2)] over the unpinned vertices, at the iterate of `residual_iterate`.

        It is nan for a method that does not minimise, and before the first iteration if it belongs to the previous
        iterate.
        """
        return float("nan")

    def can_terminate(self) -> bool:
        """Return whether a stationary iterate may be a minimum; False for a saddle point."""
        return True

    def run_unchecked(self, num_iterations: int) -> int:
        """Do iterations without a residual, up to the first that fails; return how many succeeded."""
        for count in range(num_iterations):
            if not self.step_state():
                return count
        return num_iterations

    def iterations_until_residual(self) -> int:
        """Return the number of iterations up to the next residual that may end the solve."""
        return 1

    def run_iterations(self, limits: LoopLimits) -> tuple[int, float, int]:
        """Iterate up to the limits.

        Returns:
            Number of iterations, last residual [J^(1/2)] and termination reason (`REASON_ITERATIONS` and so on).
        """
        return _interpreted_loop(self, limits)


_interpreted_loop = iteration_loop.build_loop(
    lambda state, count: state.run_unchecked(count), methodcaller("residual"), methodcaller("iterations_until_residual")
)


class CompiledState(SolverState):
    """The state of a solve whose iteration loop is compiled."""

    @abstractmethod
    def run_iterations(self, limits: LoopLimits) -> tuple[int, float, int]:
        """Iterate up to the limits; return count, residual and reason."""

    def step_state(self) -> bool:
        """Do one iteration; return False if round-off prevents descent."""
        return self.run_iterations(iteration_loop.ONE_ITERATION)[0] == 1

    def residual(self) -> float:
        """Return the residual [J^(1/2)] at the iterate."""
        return self.run_iterations(iteration_loop.NO_ITERATIONS)[1]


class IterativeSolver(ABC):
    """A method after the setup for a system.

    With `description` and `stats` it is a `PreparedSolver`.

    Attributes:
        residual_iterate: the iterate of the residuals. It is "previous" for a method that computes them in its
            iteration as |p - LG(p)|, and "none" for a method that does not minimise, which does all iterations.
        supports_length_constraints: whether length constraints are supported; if not, `iterates` and `solve` raise
            Unsupported for a system that has any.
        can_leave_saddles: whether a solve that ends at a saddle may start again from a lower point.

    Example:
        >>> class Descent(springbench.SolverState):
        ...     def __init__(self, problem, p):
        ...         self.problem, self.positions = problem, p
        ...     def step_state(self):
        ...         inertia = self.problem.system.inertia_diagonal[:, None]
        ...         self.positions = self.positions - self.problem.gradient(self.positions) / inertia
        ...         return True

        >>> class PreparedDescent(springbench.IterativeSolver):
        ...     description, stats, residual_iterate = "", {}, "none"
        ...     def init_state(self, problem, initial_guess):
        ...         return Descent(problem, initial_guess)

        >>> import numpy as np
        >>> system, p = springbench.System(np.array([1.0]), time_step=0.5), np.zeros((1, 3))
        >>> start = springbench.StepStart(p, 0.0 * p, 0.0, p, system.velocity_rate)
        >>> weight = np.array([[0.0, -8.0, 0.0]])
        >>> problem = springbench.StepProblem(system, p, weight, np.empty((0, 3)), p, p, start)

        >>> PreparedDescent().solve(problem, springbench.StopRule(3)).num_iterations
        3
    """

    residual_iterate: ClassVar[ResidualIterate] = "returned"
    supports_length_constraints: ClassVar[bool] = False
    can_leave_saddles: ClassVar[bool] = True

    @property
    def can_identify_saddles(self) -> bool:
        """Whether `SolverState.can_terminate` distinguishes saddles from minima; other methods get a `SaddleCheck`."""
        return False

    @abstractmethod
    def init_state(self, problem: StepProblem, initial_guess: Positions) -> SolverState:
        """Start a solve.

        Args:
            problem: the step.
            initial_guess: positions (n, 3) [m], which are not modified.
        """

    def iterates(self, problem: StepProblem) -> Iterator[Positions]:
        """Yield the iterates from the initial guess; the next one may overwrite a yielded array."""
        run = self._initial_state(problem)
        while True:
            run.step_state()
            yield run.positions

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        """Iterate until `stop` terminates the solve or no step decreases the objective.

        Without a tolerance only the last residual is computed.

        Args:
            problem: the step.
            stop: the criteria that terminate the solve.

        Raises:
            Unsupported: the system has length constraints, which the method does not support.
        """
        run = self._initial_state(problem)
        initial_residual, close = float("nan"), False
        if (stop.rtol is not None or stop.atol > 0.0) and self.residual_iterate != "none":
            near, limit = (
                _ROUNDOFF_CHECK_FRACTION * self.residual_scale(problem) if stop.roundoff_floor > 0.0 else 0.0,
                float(stop.atol),
            )
            if stop.rtol is not None:
                known = run.compute_start_residual() if problem.initial_guess is problem.current_positions else None
                initial_residual = self.residual_at(problem, problem.current_positions) if known is None else known
                limit, close = max(limit, stop.rtol * initial_residual), stop.rtol <= _MINIMUM_CHECK_RTOL
            limits = LoopLimits(stop.max_iterations, limit, near, iteration_loop.RESIDUAL_EACH)
        else:
            limits = iteration_limit(stop.max_iterations)
        count, residual, ended = self._iterate_to_roundoff(run, problem, limits, stop.roundoff_floor)
        # A method that recognises saddles continues from them by itself.
        while close and _has_converged(ended) and not run.can_terminate():
            left = limits._replace(max_iterations=stop.max_iterations - count)
            more, residual, ended = self._iterate_to_roundoff(run, problem, left, stop.roundoff_floor)
            count += more
            if not more and ended != iteration_loop.REASON_ITERATIONS:
                ended = iteration_loop.REASON_STALLED
        reason = _TERMINATION_REASONS[ended]
        # Other methods restart from a lower point along negative curvature, which counts as an iteration.
        while (close and _has_converged(ended)) or ended == iteration_loop.REASON_STALLED:
            lower = self._find_lower_point(problem, run.positions, count)
            if lower is None:
                break
            if count + 1 >= stop.max_iterations or not self.can_leave_saddles:
                reason = "saddle"
                break
            self.release_state(run)
            run = self.init_state(problem, lower)
            left = limits._replace(max_iterations=stop.max_iterations - count - 1)
            more, residual, ended = self._iterate_to_roundoff(run, problem, left, stop.roundoff_floor)
            count, reason = count + 1 + more, _TERMINATION_REASONS[ended]
        found = Solution(
            run.positions,
            count,
            residual,
            initial_residual,
            reason,
            run.velocity,
            self.residual_iterate,
            run.warm_start,
            run.solver_phases,
        )
        self.release_state(run)
        return found

    def release_state(self, run: SolverState) -> None:
        """Recycle the state of a finished solve.

        A method whose next solve reuses the state overrides this.
        """
        return

    def _find_lower_point(self, problem: StepProblem, p: Positions, num_iterations: int) -> Positions | None:
        """Return a point lower than a saddle at the end point p, or None."""
        system = problem.system
        if self.can_identify_saddles or self.residual_iterate == "none" or system.length_constraints:
            return None
        if not self._saddle_checks or self._saddle_checks[0].system is not system:
            from springbench.solvers.iteration.saddle_check import SaddleCheck
            from springbench.solvers.objective.fixed_objective import FixedObjective

            self._saddle_checks[:] = [SaddleCheck(FixedObjective(system))]
        return self._saddle_checks[0].find_lower_point(problem, p, num_iterations)

    @cached_property
    def _saddle_checks(self) -> list[SaddleCheck]:
        """The check of the last system, if any."""
        return []

    def _initial_state(self, problem: StepProblem) -> SolverState:
        if problem.system.length_constraints and not self.supports_length_constraints:
            raise Unsupported(EXACT_LENGTHS_UNSUPPORTED)
        return self.init_state(problem, problem.initial_guess)

    @staticmethod
    def _iterate_to_roundoff(
        run: SolverState, problem: StepProblem, limits: LoopLimits, roundoff_floor: float
    ) -> tuple[int, float, int]:
        """Call `run.run_iterations`, and return FLOOR only if the gradient is round-off at each vertex.

        The gradient is checked once the residual is near round-off, then after one more iteration, and then whenever
        the iterations since the first check have grown by half. Far from the origin the bound consists mostly of the
        rounding of coordinates whose differences are exact; there the iterations continue while each halves the
        residual.
        """
        count, residual, ended = run.run_iterations(limits)
        since, gains = 0, True
        while ended == iteration_loop.REASON_FLOOR:
            rests = is_gradient_roundoff(problem, run.positions, roundoff_floor)
            if rests and not (gains and is_far_from_origin(run.positions)):
                break
            some = min(1 if rests else 1 + since // 2, limits.max_iterations - count)
            if some == 0:
                return count, residual, iteration_loop.REASON_FLOOR if rests else iteration_loop.REASON_ITERATIONS
            more, now, ended = run.run_iterations(limits._replace(max_iterations=some, residual_floor=0.0))
            gains = gains and (not rests or now < 0.5 * residual)
            count, since, residual = count + more, since + more, now
            if ended == iteration_loop.REASON_ITERATIONS or (rests and ended == iteration_loop.REASON_STALLED):
                ended = iteration_loop.REASON_FLOOR
        return count, residual, ended

    def residual_at(self, problem: StepProblem, p: Positions) -> float:
        """Return the residual [J^(1/2)]; it costs one iteration if it belongs to the previous iterate.

        Args:
            problem: the step.
            p: positions (n, 3) [m].
        """
        if self.residual_iterate == "none":
            return float("nan")
        run = self.init_state(problem, p)
        if run.start_residual is not None:
            return run.start_residual
        return run.run_iterations(iteration_limit(int(self.residual_iterate == "previous")))[1]

    def build_residual(self, problem: StepProblem) -> Callable[[Positions], float]:
        """Build a function that returns `residual_at` for many positions of one step."""
        return lambda p: self.residual_at(problem, p)

    def residual_scale(self, problem: StepProblem) -> float:
        """Return the scale of residuals [J^(1/2)] for the round-off check; 0 disables the check.

        It is the residual of a mean displacement as large as the initial guess's largest coordinate. The check begins
        at a small fraction of it.
        """
        return 0.0

    def iteration_phases(self, problem: StepProblem) -> dict[str, Callable[[], object]]:
        """Return the phases of an iteration; none by default."""
        return {}


class SubsteppingState(SolverState):
    """The whole step in 1, 2, ... substeps, each time from its start.

    Iterates that are not needed are skipped.
    """

    def __init__(
        self, step_in_substeps: Callable[[StepProblem, int], tuple[Positions, Positions]], problem: StepProblem
    ) -> None:
        """Create the state at the start of a step.

        Args:
            step_in_substeps: function of the step and a number of substeps that returns positions [m] and velocities
                [m/s] at its end, (n, 3) each.
            problem: the step.
        """
        self._step_in_substeps, self._problem, self._num_substeps = step_in_substeps, problem, 0
        self.positions = problem.step_start.positions

    def step_state(self) -> bool:
        """Integrate the step with one more substep."""
        return self.run_unchecked(1) == 1

    def run_unchecked(self, num_iterations: int) -> int:
        """Integrate the step once, with as many more substeps as iterations."""
        self._num_substeps += num_iterations
        self.positions, self.velocity = self._step_in_substeps(self._problem, self._num_substeps)
        return num_iterations


def _has_converged(ended: int) -> bool:
    return ended in (iteration_loop.REASON_TOLERANCE, iteration_loop.REASON_FLOOR)


def is_far_from_origin(p: Positions) -> bool:
    """Return whether the rounding of coordinates dominates that of their differences.

    This depends on the ratio of the largest coordinate of p (n, 3) [m] to the extent of p.
    """
    return (
        bool(np.abs(p).max(initial=0.0) > _FAR_ORIGIN_RATIO * np.ptp(p, axis=0).max(initial=0.0)) if len(p) else False
    )


def compute_max_coordinate(problem: StepProblem) -> float:
    """Return the largest coordinate [m] of the initial guess.

    Exactly pinned vertices are on their targets.
    """
    p, (indices, vertices) = problem.initial_guess, problem.system.exact_pins
    if p is not problem.current_positions and len(vertices):
        p = p.copy()
        p[vertices] = problem.pin_targets[indices]
    return objective_kernels.compute_max_magnitude(as_kernel_array(p))
