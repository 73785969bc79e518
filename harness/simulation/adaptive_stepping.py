"""Adaptive time stepping: the error estimate of each step determines the next step size.

    ratio = error/tolerance,   error = rms over free coordinates of (dp, span dv);   a step is accepted where ratio <= 1

The next step size h' is the smaller one of the elementary and the predictive controller
(`springbench.solvers.model.integrators.step_size_controller`), as in Hairer and Wanner's RADAU5. The step size of an
implicit step is 2^-level of the end time, and the step starts at a multiple of its size. Few factors are therefore
needed, the last ones used are cached (`MAX_FACTOR_BYTES`), and the last step ends exactly at the end time. The
step size is doubled where h' is at least twice as large. The proportional-integral controller of the explicit methods
would not reach that threshold.

The algebraic error of a step's solve is limited to a share of the tolerance (`ALGEBRAIC_ERROR_SHARE`). Positions
between steps are interpolated by cubic Hermite polynomials. Substepping solvers choose their step sizes within a frame
themselves.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import ceil, inf, isfinite, log2
from time import perf_counter, thread_time
from typing import ClassVar, Protocol

import numpy as np
from springbench.harness.errors import RunFailed
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.simulation.step_stages import StageSequence, StepResult
from springbench.harness.simulation.time_loop import (
    INITIAL_GUESSES,
    MotionState,
    SimulationStep,
    build_initial_state,
    prepare,
)
from springbench.solvers.model.integrators import Motion, RungeKutta
from springbench.solvers.model.integrators.step_size_controller import (
    StepSizeController,
    compute_rejection_factor,
    filter_error,
)
from springbench.solvers.model.step_problem import Positions, PreparedSolver, Solution, Solver, StopRule, Unsupported

MIN_STEP_FACTOR, MAX_REJECTION_FACTOR = 0.1, 0.5
"""Bounds of the change of the step size after a rejected step."""
ALGEBRAIC_ERROR_SHARE = 0.1
"""Maximum part of a step's error estimate that the residuals of its stages cause, relative to the tolerance."""
MAX_FACTOR_BYTES = 2**28
"""Memory limit [bytes] of cached factors; the two used last are always cached."""
MIN_STEP_SECONDS = 1e-9
"""Minimum step size [s]."""
MAX_SOLVE_ITERATIONS = 200
"""Maximum number of iterations of a solve; a step that needs more is rejected."""
_STALL_FACTOR = 10.0
"""Factor on the requested residual up to which a stalled solve is accepted."""
_MAX_LEVEL = 60
"""Maximum level: times are multiples of 2^-60 of the end time."""


StepObserver = Callable[[Scene, SimulationStep, float], None]
"""Called with the scene, each step and the time [s] of its end."""


class TimeBudgetExceeded(Exception):
    """The limit on processor time is exceeded."""


def build_budget_error(cpu_limit: float, time: float) -> TimeBudgetExceeded:
    """Build the error of a motion that takes too long.

    Args:
        cpu_limit: limit on the processor time [s].
        time: time that the motion had reached [s].
    """
    return TimeBudgetExceeded(f"it takes more than {cpu_limit:g} s of processor time; it reached {time:.6g} s")


class StepSizeUnderflow(RunFailed):
    """The error tolerance would need steps below the minimum step size."""


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """A motion within an error tolerance.

    Attributes:
        positions: positions (k + 1, n, 3) [m] at the start and at the end of each of k frames.
        velocities: velocities (k + 1, n, 3) [m/s] at the same times.
        num_accepted_steps: number of accepted steps.
        num_rejected_steps: number of rejected steps.
        num_factorisations: number of factorisations.
        num_iterations: number of iterations of the steps' solves; force evaluations of a solver with substeps.
        step_size_range: smallest and largest step size [s]; the mean size in both entries for a solver with substeps.
        wall_seconds: wall time [s], without the preparation of the first steps.
        frame_seconds: wall time (k,) [s] in which each frame was computed; frames of one step or call share its time
            equally.
        cpu_seconds: processor time [s] of this thread, including preparation.
    """

    positions: Positions
    velocities: Positions
    num_accepted_steps: int
    num_rejected_steps: int
    num_factorisations: int
    num_iterations: int
    step_size_range: tuple[float, float]
    wall_seconds: float
    frame_seconds: tuple[float, ...]
    cpu_seconds: float


class Stepper(Protocol):
    """Integrator of a motion to an error tolerance, or with a fixed step size.

    `order` is the order of convergence of the error, `has_fixed_step` states whether the step size is fixed. A setting
    is the error tolerance [m] of each step or, with a fixed step size, the number of steps relative to that with the
    largest step size.
    """

    has_fixed_step: ClassVar[bool] = False

    @property
    def order(self) -> int:
        """The order of convergence of the error."""
        ...

    def initial_setting(self, tolerance: float) -> float:
        """Return the initial setting for an error tolerance [m] of the steps."""
        return 1.0 if self.has_fixed_step else tolerance

    def scale_setting(self, setting: float, ratio: float, order: float | None = None) -> float:
        """Return the setting at which the final error is scaled by about a given ratio.

        The error of a step of size h is of order h^(order + 1). Fixed step sizes are not increased beyond the largest.

        Args:
            setting: present setting.
            ratio: new error over present error.
            order: measured order of convergence; the theoretical one if omitted.
        """
        order = order or self.order
        if self.has_fixed_step:
            return max(1.0, setting * ratio ** (-1.0 / order))
        return setting * ratio ** ((order + 1.0) / order)

    def integrate_motion(
        self, setting: float, *, cpu_limit: float = inf, observe: StepObserver | None = None
    ) -> Trajectory:
        """Integrate the motion up to the end time.

        Args:
            setting: error tolerance [m] or number of steps relative to the smallest number.
            cpu_limit: limit on the processor time [s].
            observe: called after each accepted step; after each frame that the solver integrates itself.

        Raises:
            TimeBudgetExceeded: the limit is exceeded.
            StepSizeUnderflow: the tolerance would need steps below the minimum step size.
        """
        ...


class _StepSizeLevels:
    """Scenes and prepared solvers by step size; beyond MAX_FACTOR_BYTES the least recently used are discarded."""

    def __init__(self, bound: Callable[[float], Scene], solver: Solver, horizon: float) -> None:
        self._bound, self._solver, self._horizon = bound, solver, horizon
        self._cached = OrderedDict[int, tuple[Scene, PreparedSolver]]()
        self.made = 0

    def compute_step_size(self, level: int) -> float:
        """Return the step size [s] of a level."""
        return self._horizon * 0.5**level

    def prepare_level(self, level: int) -> tuple[Scene, PreparedSolver]:
        if level not in self._cached:
            scene = self._bound(self.compute_step_size(level))
            self._cached[level] = scene, prepare(scene, self._solver)
            self.made += 1
        self._cached.move_to_end(level)
        while (
            len(self._cached) > 2
            and sum(_estimate_factor_bytes(prepared) for _, prepared in self._cached.values()) > MAX_FACTOR_BYTES
        ):
            self._cached.popitem(last=False)
        return self._cached[level]


def _estimate_factor_bytes(prepared: PreparedSolver) -> float:
    """Estimate the memory of a solver's factors: an index and a number for each entry."""
    return 12.0 * sum(count for name, count in prepared.stats.items() if name.startswith("nnz") and "factor" in name)


@dataclass(frozen=True, eq=False)
class AdaptiveImplicitStepper(Stepper):
    """Adaptive stepping by an integrator with an embedded error estimate.

    Attributes:
        build_scene: builds the scene with a given step size [s].
        solver: solver of the steps.
        t_end: end time [s].
        frames: number of frames up to the end time.
    """

    build_scene: Callable[[float], Scene]
    solver: Solver
    t_end: float
    frames: int

    @property
    def order(self) -> int:
        """The order of convergence of the integrator."""
        return self.build_scene(self.t_end / self.frames).integrator.order

    def integrate_motion(
        self, setting: float, *, cpu_limit: float = inf, observe: StepObserver | None = None
    ) -> Trajectory:
        """Integrate the motion up to the end time.

        Args:
            setting: error tolerance [m] of each step.
            cpu_limit: limit on the processor time [s] of this thread.
            observe: called after each accepted step.

        Raises:
            Unsupported: the integrator estimates no error, there are velocity filters, or the solver does not support
                the scene.
            TimeBudgetExceeded: the limit is exceeded.
            StepSizeUnderflow: the tolerance would need steps below the minimum step size.
        """
        return _AdaptiveIntegration(self, setting, cpu_limit, observe).run_to_end()


class _AdaptiveIntegration:
    """The integration of one motion, with step sizes of `_StepSizeLevels`."""

    def __init__(
        self, stepper: AdaptiveImplicitStepper, tolerance: float, limit: float, observe: StepObserver | None
    ) -> None:
        self._stepper, self._tolerance, self._limit, self._cpu = stepper, tolerance, limit, thread_time()
        self._observe = observe
        self._ladder = _StepSizeLevels(stepper.build_scene, stepper.solver, stepper.t_end)
        self._span = stepper.t_end / stepper.frames
        self._level = ceil(log2(max(1.0, stepper.t_end / self._span)))
        scene, _ = self._ladder.prepare_level(self._level)
        method = scene.integrator
        if not isinstance(method, RungeKutta) or not method.embedded_order:
            raise Unsupported("the integrator has no error estimate; use an embedded one such as esdirk-4")
        if scene.velocity_filters:
            raise Unsupported("error estimates do not include velocity filters, and the scene has one")
        self._method, error_order = method, 1.0 + min(method.order, method.embedded_order)
        self._elementary = StepSizeController(error_order, min_factor=MIN_STEP_FACTOR)
        self._predictive = StepSizeController(error_order, beta_1=2.0, beta_2=-1.0, alpha=-1.0)
        self._now, self._acceleration, self._ticks = build_initial_state(scene).motion, None, 0
        self._free, self._mass = scene.system.free_vertices, float(scene.system.mass[scene.system.free_vertices].mean())
        self._seen, self._before = [self._now], (1.0, scene.system.time_step)
        self._accepted = self._rejected = self._iterations = 0
        self._lengths = inf, 0.0
        self._began, self._reached = perf_counter(), list[float]()

    def run_to_end(self) -> Trajectory:
        """Integrate to the end and return the motion."""
        while self._ticks < 1 << _MAX_LEVEL:
            self._try_step()
            if thread_time() - self._cpu > self._limit:
                raise build_budget_error(self._limit, self._tick_time(self._ticks))
        counts = self._accepted, self._rejected, self._ladder.made, self._iterations
        shared, processor = share_frame_seconds(self._reached), thread_time() - self._cpu
        return Trajectory(*stack_motions(self._seen), *counts, self._lengths, self._reached[-1], shared, processor)

    def _try_step(self) -> None:
        """Try one step."""
        scene, prepared = self._ladder.prepare_level(self._level)
        h, time = scene.system.time_step, self._tick_time(self._ticks)
        rule = self._build_stop_rule(h)
        done = StageSequence(scene, self._now, self._acceleration, time).solve_stages(
            prepared, rule, INITIAL_GUESSES["extrapolated"]
        )
        self._iterations += sum(done.iteration_counts)
        ratio = self._error_ratio(done)
        if not ratio <= 1.0:
            self._rejected += 1
            change = min(MAX_REJECTION_FACTOR, compute_rejection_factor(self._elementary, ratio))
            self._level += ceil(log2(1.0 / change))
            if self._ladder.compute_step_size(self._level) < MIN_STEP_SECONDS:
                raise self._build_underflow_error(ratio, time)
            return
        self._accepted += 1
        self._lengths = min(self._lengths[0], h), max(self._lengths[1], h)
        self._ticks += 1 << (_MAX_LEVEL - self._level)
        self._add_frames(done.end.motion, time, h)
        if self._observe:
            state = MotionState(done.end.motion, self._now, self._accepted, done.end.acceleration)
            step = SimulationStep(*done.stages[-1], state, done.iteration_counts, done.stages, rule)
            self._observe(scene, step, self._tick_time(self._ticks))
        self._now, self._acceleration = done.end.motion, done.end.acceleration
        self._choose_step_size(ratio, h)

    def _choose_step_size(self, ratio: float, h: float) -> None:
        """Choose the next step's level after a step of size h [s]."""
        previous_ratio, previous_h = self._before
        change = min(
            filter_error(control, ratio, previous_ratio, h / previous_h)
            for control in (self._elementary, self._predictive)
        )
        self._before = ratio, h
        if change < 0.6:
            self._level += 1
        elif change >= 2.0 and self._level and self._ticks % (1 << (_MAX_LEVEL - self._level + 1)) == 0:
            self._level -= 1

    def _tick_time(self, ticks: int) -> float:
        return self._stepper.t_end * (ticks / (1 << _MAX_LEVEL))

    def _build_stop_rule(self, h: float) -> StopRule:
        """Build the stop rule from the share of the error estimate that residuals may cause.

        A residual is at least rate |dp|_M. It adds rate h |dp| to the positions, and rate times as much to the
        velocities.
        """
        speed = self._method.velocity_factor
        part = ALGEBRAIC_ERROR_SHARE * self._tolerance / (speed * (1.0 + speed * self._span / h))
        return StopRule(MAX_SOLVE_ITERATIONS, atol=part * speed / h * (3.0 * len(self._free) * self._mass) ** 0.5)

    def _error_ratio(self, done: StepResult) -> float:
        """Return the step's error relative to the tolerance; infinite where a solve did not converge."""
        error, within = done.end.error, self._build_stop_rule(self._ladder.compute_step_size(self._level)).atol
        if error is None or not all(_is_solved(solution, within) for _, solution in done.stages):
            return inf
        with np.errstate(over="ignore", invalid="ignore"):
            squares = sum(float((part[self._free] ** 2).sum()) for part in (error[0], self._span * error[1]))
        found = (squares / max(1, 3 * len(self._free))) ** 0.5 / self._tolerance
        return found if isfinite(found) else inf

    def _add_frames(self, after: Motion, time: float, h: float) -> None:
        """Add the frames that end within a step."""
        until, reached = self._tick_time(self._ticks), perf_counter() - self._began
        while len(self._seen) <= self._stepper.frames and (len(self._seen) * self._span) <= until * (1.0 + 1e-12):
            part = min(1.0, (len(self._seen) * self._span - time) / h)
            self._seen.append(interpolate_hermite(self._now, after, h, part))
            self._reached.append(reached)

    def _build_underflow_error(self, ratio: float, time: float) -> StepSizeUnderflow:
        cause = "is not solved" if ratio == inf else f"errs by {ratio:.2g} times what it may"
        return StepSizeUnderflow(
            f"frame {len(self._seen)}, after {time:.6g} s: even a step of {MIN_STEP_SECONDS:g} s {cause}; up to there "
            f"{self._accepted} steps were within {self._tolerance:.2g} m: forces are too sudden there, or round-off is "
            "larger; use a larger --error or a shorter --t-end"
        )


def _is_solved(solution: Solution, atol: float) -> bool:
    """Return whether a solve ended with a small enough residual.

    A stalled solve is allowed a larger one, since round-off may prevent any further reduction.
    """
    if solution.termination_reason in ("stalled", "saddle"):
        return solution.residual <= _STALL_FACTOR * atol
    return solution.termination_reason != "max-iter"


def share_frame_seconds(reached: Sequence[float]) -> tuple[float, ...]:
    """Return the wall time [s] of each frame from the cumulative times.

    Frames of one step or call share its time equally.
    """
    gone = np.diff(np.array(reached), prepend=0.0)
    steps = np.cumsum(gone > 0.0)
    steps -= steps[0]
    return tuple((np.bincount(steps, gone) / np.bincount(steps))[steps].tolist())


def stack_motions(motions: Sequence[Motion]) -> tuple[Positions, Positions]:
    """Return the positions [m] and velocities [m/s] of motions, both (k, n, 3)."""
    return np.array([p for p, _ in motions]), np.array([v for _, v in motions])


def interpolate_hermite(before: Motion, after: Motion, h: float, part: float) -> Motion:
    """Interpolate a motion within a step by cubic Hermite polynomials.

    Args:
        before: motion at the start.
        after: motion at the end.
        h: step size [s].
        part: fraction of the step.

    Returns:
        The motion, whose positions are accurate to order 3.
    """
    (p, v), (q, w), s = before, after, part
    if s == 1.0:
        return after
    d = q - p
    quadratic, cubic = 3.0 * d - h * (2.0 * v + w), h * (v + w) - 2.0 * d
    return Motion(p + s * (h * v + s * (quadratic + s * cubic)), v + s / h * (2.0 * quadratic + 3.0 * s * cubic))
