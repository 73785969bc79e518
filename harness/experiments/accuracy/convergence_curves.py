"""Measure the convergence of a solver on one step snapshot.

Errors and times come from separate passes. The first pass stores the iterates to score, and ends at the time limit.
Each timed pass then computes as many iterates as the first. It records a time stamp after each and does nothing else in
between. It must end at bitwise identical positions.

A curve ends on convergence: at a stationarity of 1e-10, or at an energy gap of 1e-9 of that at the current positions.
It also ends where the iterates do not change any more, and at its limits. A saddle is stationary too; its negative
curvature identifies it. A solver may still leave a saddle, and one that remains there has not converged.
"""

from __future__ import annotations

import gc
from dataclasses import dataclass
from itertools import islice
from time import perf_counter

import numba
import numpy as np
from numpy.typing import NDArray
from springbench.harness.errors import RunFailed
from springbench.harness.experiments.accuracy.step_scales import compute_energy_roundoff
from springbench.harness.reference.hessian_curvature import HessianCurvature, compute_curvature
from springbench.harness.reference.reference_evaluator import ReferenceEvaluator
from springbench.harness.simulation.stopwatch import PhaseWatch, retry_on_mismatch
from springbench.solvers.iteration.device_interface import PreparedDeviceSolver
from springbench.solvers.model.step_problem import Positions, PreparedSolver, StepProblem

STATIONARITY_TOLERANCE, ENERGY_GAP_TOLERANCE = 1e-10, 1e-9
UNCHANGED_STATIONARITY_TOLERANCE = 1e-8
"""Stationarity at which iterates that do not change any more count as converged: round-off prevents progress."""

MAX_UNCHANGED_ITERATES = 5
"""Number of equal consecutive iterates after which a solver counts as stalled.

A solver that rejects its own step may use another direction in the next iteration.
"""

MIN_RELATIVE_PROGRESS = 1e-3
"""Relative decrease of the gap that is required in the second half of the iterations."""

DIVERGENCE_GAP = 1e6
"""Ratio of the gap to that at the current positions above which the solve diverges, even if it is finite."""

NUM_WARMUP_ITERATES = 2
"""Iterates whose time does not count against the limit, because they compile."""

_MAX_ITERATE_SHARE = 0.5
"""Share of the time limit in one iterate above which a pass is repeated: a kernel may have been compiled in it."""

MIN_SOLVE_SECONDS = 0.1
"""Duration below which an untimed solve precedes the timed ones [s].

Scoring has filled the caches, and the first iterate of a small mesh would take three times as long.
"""

_NUM_DENSE_ITERATES = 50
_MANTISSAS = (1.0, 1.2, 1.5, 1.8, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 7.0, 8.5)


def is_scored_iteration(iteration: int) -> bool:
    """Return whether an iterate is scored: each of the first 50, then 12 per decade."""
    if iteration <= _NUM_DENSE_ITERATES:
        return True
    decade = 10 ** (len(str(iteration)) - 1)
    return any(round(mantissa * decade) == iteration for mantissa in _MANTISSAS)


@dataclass(frozen=True, slots=True, eq=False)
class ScoredCurve:
    """Scored iterates of a solve.

    Attributes:
        iterate_indices: (k,); 0 is the initial guess.
        positions: (k, n, 3) [m].
        g: objective (k,) [J].
        stationarity: (k,).
        status: status of the curve as a whole.
        reason: reason of the status.
        seconds: time since the start of the solve, (k, rounds) [s].
        preempted: whether any round was preempted.
    """

    iterate_indices: list[int]
    positions: list[Positions]
    g: list[float]
    stationarity: list[float]
    status: str
    reason: str
    seconds: NDArray[np.float64]
    preempted: bool


def measure_convergence(
    prepared: PreparedSolver,
    problem: StepProblem,
    evaluator: ReferenceEvaluator,
    lowest_energy: float | None,
    *,
    max_iterations: int,
    time_limit: float,
    num_rounds: int,
) -> ScoredCurve:
    """Measure the convergence curve of a solve from the problem's initial guess.

    Args:
        prepared: the prepared solver.
        problem: the problem of the step.
        evaluator: reference evaluator that scores iterates.
        lowest_energy: energy of the lowest known minimum [J]; None without one.
        max_iterations: iteration limit.
        time_limit: limit on the solver's own time [s].
        num_rounds: number of timed passes.

    Returns:
        The scored iterates, with the times of all passes.

    Raises:
        RunFailed: a timed pass ends at other positions, or another clock disagrees.
    """
    number = 0
    while True:
        grading, before = _ConvergenceMonitor(evaluator, problem, lowest_energy, max_iterations, time_limit), number
        spent, longest = grading.grade_pass(prepared)
        number, p = grading.iterate_indices[-1], grading.positions[-1]
        may_have_compiled = grading.status == "time-limit" and longest > _MAX_ITERATE_SHARE * time_limit
        if not may_have_compiled or number <= before:
            break
    if spent < MIN_SOLVE_SECONDS:
        _time_iterates(prepared, problem, number, p)
    stamps, interrupted = zip(*(_time_iterates(prepared, problem, number, p) for _ in range(num_rounds)), strict=True)
    seconds = np.stack([stamp[grading.iterate_indices] for stamp in stamps], axis=1)
    g, stationarity, status, reason = grading.g, grading.stationarity, grading.status, grading.reason
    return ScoredCurve(
        grading.iterate_indices, grading.positions, g, stationarity, status, reason, seconds, any(interrupted)
    )


class _ConvergenceMonitor:
    """Scored iterates of a running solve, and the conditions that end the curve."""

    def __init__(
        self,
        evaluator: ReferenceEvaluator,
        problem: StepProblem,
        lowest_energy: float | None,
        max_iterations: int,
        time_limit: float,
    ) -> None:
        self._evaluator, self._problem, self._max_iterations, self._time_limit = (
            evaluator,
            problem,
            max_iterations,
            time_limit,
        )
        self._lowest_energy = (
            np.nan if lowest_energy is None else lowest_energy
        )  # NaN: every comparison with a gap is then false
        self._energy_scale = max(
            problem.value(problem.current_positions) - self._lowest_energy, compute_energy_roundoff(problem)
        )
        self.iterate_indices: list[int] = []
        self.positions: list[Positions] = []
        self.g: list[float] = []
        self.stationarity: list[float] = []
        self.status = self.reason = ""

    def grade_pass(self, prepared: PreparedSolver) -> tuple[float, float]:
        """Score the iterates of a solve until one ends the curve.

        Returns:
            Time of the solver, and of its longest iterate [s].
        """
        p, spent, longest, number, still = self._problem.initial_guess.copy(), 0.0, 0.0, 0, 0
        self.add_iterate(0, p)
        iterates = prepared.iterates(self._problem)
        while not self.status:
            began = perf_counter()
            following = next(iterates)
            if number >= NUM_WARMUP_ITERATES:
                seconds = perf_counter() - began
                spent, longest = spent + seconds, max(longest, seconds)
            number, still = number + 1, still + 1 if np.array_equal(following, p) else 0
            np.copyto(p, following)
            fixed, is_last = still == MAX_UNCHANGED_ITERATES, number == self._max_iterations
            if is_scored_iteration(number) or fixed or spent > self._time_limit or is_last:
                self.add_iterate(number, p)
                self.update_status(fixed, spent)
        return spent, longest

    def add_iterate(self, number: int, p: Positions) -> None:
        finite = bool(np.isfinite(p).all())
        with np.errstate(over="ignore", invalid="ignore"):  # terms may overflow while positions are finite
            self.g.append(self._problem.value(p) if finite else np.nan)
            self.stationarity.append(
                self._evaluator.measure_stationarity(self._problem, p).stationarity if finite else np.nan
            )
        self.iterate_indices.append(number)
        self.positions.append(p.copy())

    def update_status(self, is_unchanged: bool, solver_seconds: float) -> None:
        """Set status and reason where the last added iterate ends the curve."""
        number, stationarity = self.iterate_indices[-1], self.stationarity[-1]
        gap = (self.g[-1] - self._lowest_energy) / self._energy_scale
        at = f"after {number} iterations, at a stationarity of {stationarity:.1e}"
        saddle = (
            self._find_saddle_curvature()
            if stationarity <= UNCHANGED_STATIONARITY_TOLERANCE and not gap <= ENERGY_GAP_TOLERANCE
            else None
        )
        if not np.isfinite([self.g[-1], stationarity]).all() or gap > DIVERGENCE_GAP:
            self.status, self.reason = "diverged", f"the energy exploded {at}"
        elif saddle and (is_unchanged or solver_seconds > self._time_limit or number == self._max_iterations):
            self.status = "saddle"
            self.reason = f"ended at a saddle, where the curvature is {saddle.min_eigenvalue:.1e} N/m, {at}"
        elif not saddle and (stationarity <= STATIONARITY_TOLERANCE or gap <= ENERGY_GAP_TOLERANCE):
            self.status = "ok"
        elif is_unchanged:
            self.status = "ok" if stationarity <= UNCHANGED_STATIONARITY_TOLERANCE else "no-progress"
            self.reason = f"positions do not change {at}"
        elif solver_seconds > self._time_limit:
            self.status, self.reason = "time-limit", f"the limit of {self._time_limit:g} s was reached {at}"
        elif number == self._max_iterations:
            self.status = "ok" if self._has_progressed() else "no-progress"
            self.reason = f"the limit of iterations was reached {at}"

    def _find_saddle_curvature(self) -> HessianCurvature | None:
        """Return the curvature at the last iterate if it is negative beyond round-off, else None."""
        found = compute_curvature(self._problem, self.positions[-1])
        return found if found.is_saddle else None

    def _has_progressed(self) -> bool:
        """Return whether energy gap or stationarity decreased in the second half of the iterations."""
        half = np.searchsorted(self.iterate_indices, self.iterate_indices[-1] / 2, side="right")
        gaps, stationarity = np.array(self.g) - self._lowest_energy, np.array(self.stationarity)
        return any(np.min(s[half:]) < (1 - MIN_RELATIVE_PROGRESS) * np.min(s[:half]) for s in (gaps, stationarity))


@retry_on_mismatch
def _time_iterates(
    prepared: PreparedSolver, problem: StepProblem, num_iterates: int, expected: Positions
) -> tuple[NDArray[np.float64], bool]:
    """Return the wall seconds until each iterate, and whether the pass was preempted.

    The times (num_iterates + 1,) begin with 0 for the initial guess.
    """
    stamps, watch = np.zeros(num_iterates + 1), PhaseWatch(numba.get_num_threads())
    p, copied = problem.initial_guess, None
    gc.disable()  # a garbage collection would count as the solver's time
    try:
        with watch:
            began = perf_counter()
            if isinstance(prepared, PreparedDeviceSolver):
                for number, copy in enumerate(islice(prepared.iterates_without_copy(problem), num_iterates), start=1):
                    stamps[number] = perf_counter()
                    copied = copy
            else:
                for number, following in enumerate(islice(prepared.iterates(problem), num_iterates), start=1):
                    stamps[number] = perf_counter()
                    p = following
    finally:
        gc.enable()
    p = copied() if copied else p
    if not np.array_equal(p, expected, equal_nan=True):
        raise RunFailed("the final positions of a timed pass differ from those of the graded pass; expected equal bits")
    stamps[1:] -= began
    return stamps, watch.build_columns("iterates", np.diff(stamps))["preempted"]
