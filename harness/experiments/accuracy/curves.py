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

from harness.base.errors import RunFailed
from harness.experiments.accuracy.scales import round_off
from harness.reference.curvature import Curvature, curvature
from harness.reference.oracle import Oracle
from harness.simulation.clock import Watch, measured_again
from solvers.device import Remote
from solvers.problem import Positions, Prepared, StepProblem

STATIONARY, GAP = 1e-10, 1e-9
AT_REST = 1e-8
"""Stationarity at which iterates that do not change any more count as converged: round-off prevents progress."""

STILL = 5
"""Number of equal consecutive iterates after which a solver counts as stalled.

A solver that rejects its own step may use another direction in the next iteration.
"""

PROGRESS = 1e-3
"""Relative decrease of the gap that is required in the second half of the iterations."""

EXPLODED = 1e6
"""Ratio of the gap to that at the current positions above which the solve diverges, even if it is finite."""

WARM_UP = 2
"""Iterates whose time does not count against the limit, because they compile."""

SHORT = 0.1
"""Duration below which an untimed solve precedes the timed ones [s].

Scoring has filled the caches, and the first iterate of a small mesh would take three times as long.
"""

_EACH = 50
_MANTISSAS = (1.0, 1.2, 1.5, 1.8, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 7.0, 8.5)


def kept(iteration: int) -> bool:
    """Return whether an iterate is scored: each of the first 50, then 12 per decade."""
    if iteration <= _EACH:
        return True
    decade = 10 ** (len(str(iteration)) - 1)
    return any(round(mantissa * decade) == iteration for mantissa in _MANTISSAS)


@dataclass(frozen=True, slots=True, eq=False)
class GradedCurve:
    """Scored iterates of a solve.

    Attributes:
        numbers: (k,); 0 is the initial guess.
        positions: (k, n, 3) [m].
        g: objective (k,) [J].
        stationarity: (k,).
        status: status of the curve as a whole.
        reason: reason of the status.
        seconds: time since the start of the solve, (k, rounds) [s].
        interrupted: whether any round was preempted.
    """

    numbers: list[int]
    positions: list[Positions]
    g: list[float]
    stationarity: list[float]
    status: str
    reason: str
    seconds: NDArray[np.float64]
    interrupted: bool


def measure(
    prepared: Prepared,
    problem: StepProblem,
    oracle: Oracle,
    lowest: float | None,
    *,
    iterations: int,
    time_limit: float,
    rounds: int,
) -> GradedCurve:
    """Measure the convergence curve of a solve from the problem's initial guess.

    Args:
        prepared: the prepared solver.
        problem: the problem of the step.
        oracle: reference evaluator that scores iterates.
        lowest: energy of the lowest known minimum [J]; None without one.
        iterations: iteration limit.
        time_limit: limit on the solver's own time [s].
        rounds: number of timed passes.

    Raises:
        RunFailed: a timed pass ends at other positions, or another clock disagrees.
    """
    grading = _Grading(oracle, problem, lowest, iterations, time_limit)
    p, spent, number, still = problem.first_guess.copy(), 0.0, 0, 0
    grading.add(0, p)
    iterates = prepared.iterates(problem)
    while not grading.status:
        began = perf_counter()
        following = next(iterates)
        if number >= WARM_UP:
            spent += perf_counter() - began
        number, still = number + 1, still + 1 if np.array_equal(following, p) else 0
        np.copyto(p, following)
        fixed = still == STILL
        if kept(number) or fixed or spent > time_limit or number == iterations:
            grading.add(number, p)
            grading.judge(fixed, spent)
    if spent < SHORT:
        _timed(prepared, problem, number, p)
    stamps, interrupted = zip(*(_timed(prepared, problem, number, p) for _ in range(rounds)), strict=True)
    seconds = np.stack([stamp[grading.numbers] for stamp in stamps], axis=1)
    g, stationarity, status, reason = grading.g, grading.stationarity, grading.status, grading.reason
    return GradedCurve(grading.numbers, grading.positions, g, stationarity, status, reason, seconds, any(interrupted))


class _Grading:
    """Scored iterates of a running solve, and the conditions that end the curve."""

    def __init__(
        self, oracle: Oracle, problem: StepProblem, lowest: float | None, iterations: int, time_limit: float
    ) -> None:
        self._oracle, self._problem, self._iterations, self._limit = oracle, problem, iterations, time_limit
        self._lowest = np.nan if lowest is None else lowest  # then no gap is small, and none is large
        self._scale = max(problem.value(problem.current) - self._lowest, round_off(problem))
        self.numbers: list[int] = []
        self.positions: list[Positions] = []
        self.g: list[float] = []
        self.stationarity: list[float] = []
        self.status = self.reason = ""

    def add(self, number: int, p: Positions) -> None:
        finite = bool(np.isfinite(p).all())
        with np.errstate(over="ignore", invalid="ignore"):  # what explodes may overflow before it is not finite
            self.g.append(self._problem.value(p) if finite else np.nan)
            self.stationarity.append(self._oracle.stationarity(self._problem, p).reached if finite else np.nan)
        self.numbers.append(number)
        self.positions.append(p.copy())

    def judge(self, fixed: bool, spent: float) -> None:
        """Set status and reason where the last added iterate ends the curve."""
        number, stationarity = self.numbers[-1], self.stationarity[-1]
        gap = (self.g[-1] - self._lowest) / self._scale
        at = f"after {number} iterations, at a stationarity of {stationarity:.1e}"
        saddle = self._saddle() if stationarity <= AT_REST and not gap <= GAP else None
        if not np.isfinite([self.g[-1], stationarity]).all() or gap > EXPLODED:
            self.status, self.reason = "diverged", f"the energy exploded {at}"
        elif saddle and (fixed or spent > self._limit or number == self._iterations):
            self.status = "saddle"
            self.reason = f"ended at a saddle, where the curvature is {saddle.smallest:.1e} N/m, {at}"
        elif not saddle and (stationarity <= STATIONARY or gap <= GAP):
            self.status = "ok"
        elif fixed:
            self.status = "ok" if stationarity <= AT_REST else "no-progress"
            self.reason = f"positions do not change any more {at}"
        elif spent > self._limit:
            self.status, self.reason = "time-limit", f"the limit of {self._limit:g} s was reached {at}"
        elif number == self._iterations:
            self.status = "ok" if self._progress() else "no-progress"
            self.reason = f"the limit of iterations was reached {at}"

    def _saddle(self) -> Curvature | None:
        """Return the curvature at the last iterate if it is negative beyond round-off, else None."""
        found = curvature(self._problem, self.positions[-1])
        return found if found.falls else None

    def _progress(self) -> bool:
        """Return whether energy gap or stationarity decreased in the second half of the iterations."""
        half = np.searchsorted(self.numbers, self.numbers[-1] / 2, side="right")
        gaps, stationarity = np.array(self.g) - self._lowest, np.array(self.stationarity)
        return any(np.min(s[half:]) < (1 - PROGRESS) * np.min(s[:half]) for s in (gaps, stationarity))


@measured_again
def _timed(
    prepared: Prepared, problem: StepProblem, count: int, expected: Positions
) -> tuple[NDArray[np.float64], bool]:
    """Return the wall seconds until each iterate, and whether the pass was preempted.

    The times (count + 1,) begin with 0 for the initial guess.
    """
    stamps, watch = np.zeros(count + 1), Watch(numba.get_num_threads())
    p, copied = problem.first_guess, None
    gc.disable()  # a collection in the middle would be counted as the solver's
    try:
        with watch:
            began = perf_counter()
            if isinstance(prepared, Remote):
                for number, copy in enumerate(islice(prepared.uncopied(problem), count), start=1):
                    stamps[number] = perf_counter()
                    copied = copy
            else:
                for number, following in enumerate(islice(prepared.iterates(problem), count), start=1):
                    stamps[number] = perf_counter()
                    p = following
    finally:
        gc.enable()
    p = copied() if copied else p
    if not np.array_equal(p, expected, equal_nan=True):
        raise RunFailed("a timed pass ended at other positions than the graded one")
    stamps[1:] -= began
    return stamps, watch.columns("iterates", np.diff(stamps))["interrupted"]
