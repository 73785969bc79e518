"""Cross-check of times: wall time and CPU time by other clocks around the timed work.

    wall_seconds      = wall time of all work of a phase, by the kernel's raw clock
    preempted_seconds = wall_seconds - CPU time        the process was preempted or stopped
    |wall_seconds - sum of the phase's times| <= max(3 % of wall_seconds, 1 ms, 15 us for each entry)

The sum may be less than wall_seconds by another 1.5 times preempted_seconds, since caches are cold after a preemption.
However long the preemption, the sum includes at least half of the CPU time of the calling thread (which includes the
reading of the clocks, in which caches may be cold):

    CPU time of the thread / 2 - sum of the phase's times <= max(1 ms, 15 us for each entry)

The times themselves are measured by `perf_counter`, call by call, elsewhere, so that an error in one place shows in the
other. A delay between two calls is in wall_seconds only. It is then in preempted_seconds as well and is no error.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import wraps
from time import perf_counter, process_time, thread_time
from typing import Any, ParamSpec, TypeVar, cast

import numpy as np
from numpy.typing import NDArray
from springbench.harness.errors import RunFailed
from springbench.solvers.model.step_problem import PreparedSolver, StepProblem

P = ParamSpec("P")
T = TypeVar("T")

CLOCK_RTOL, CLOCK_ATOL_SECONDS, CALL_OVERHEAD_SECONDS = 0.03, 1e-3, 15e-6
"""Relative and absolute [s] difference allowed between two clocks, and time [s] to read them once, including the call
in between: 1e-6 with warm caches, 5e-6 to 1e-5 after work that has evicted them."""
PREEMPTED_FACTOR = 1.5
"""Time that may be missing, relative to the lost time: caches are cold after a preemption."""

PHASE_SUM_RTOL = 0.15
"""Relative difference between an iteration's time and the sum of its phases above which their rows are flagged."""


def read_raw_clock() -> float:
    """Return the kernel's raw clock [s], which no time service adjusts; `perf_counter` where there is none."""
    if hasattr(time, "CLOCK_MONOTONIC_RAW"):  # not on Windows
        return time.clock_gettime(time.CLOCK_MONOTONIC_RAW)
    return perf_counter()


class ClockMismatch(RunFailed):
    """Two clocks measured different times."""


def retry_on_mismatch(measure: Callable[P, T]) -> Callable[P, T]:
    """Repeat a measurement once if its clocks disagree; a second ClockMismatch is raised."""

    @wraps(measure)
    def measure_twice(*arguments: P.args, **named: P.kwargs) -> T:
        try:
            return measure(*arguments, **named)
        except ClockMismatch:
            return measure(*arguments, **named)

    return measure_twice


@dataclass
class PhaseWatch:
    """Sum of wall and CPU time over repeated contexts.

    Attributes:
        num_threads: number of threads that may compute. While all of them do, the process uses this many CPU seconds
            per second; while one does, it is the calling thread, which uses one.
        wall_seconds: total wall time [s].
        num_entries: number of contexts.
        process_seconds: total CPU time [s] of the process.
        thread_seconds: total CPU time [s] of the calling thread.
        start_times: the three clocks at the start of the present context [s].
    """

    num_threads: int = 1
    wall_seconds: float = 0.0
    num_entries: int = 0
    process_seconds: float = 0.0
    thread_seconds: float = 0.0
    start_times: list[float] = field(default_factory=list[float])

    def __enter__(self) -> None:
        self.start_times = [process_time(), thread_time()]
        perf_counter()  # so that neither clock is read with cold caches, which takes up to 1e-5 s
        read_raw_clock()
        self.start_times.append(read_raw_clock())

    def __exit__(self, *_: object) -> None:
        wall, thread, process = read_raw_clock(), thread_time(), process_time()
        self.process_seconds += process - self.start_times[0]
        self.thread_seconds += thread - self.start_times[1]
        self.wall_seconds += wall - self.start_times[2]
        self.num_entries += 1

    @property
    def preempted_seconds(self) -> float:
        """Seconds in which the process did not compute.

        If one thread may compute and it is the calling one, which then uses most of the CPU time, its time counts
        alone: background threads of the process, which drain pipes or write recordings, would hide a preemption.
        """
        if self.num_threads == 1 and 2.0 * self.thread_seconds >= self.process_seconds:
            return max(0.0, self.wall_seconds - self.thread_seconds)
        return max(0.0, self.wall_seconds - max(self.thread_seconds, self.process_seconds / self.num_threads))

    @property
    def max_difference(self) -> float:
        """Difference [s] allowed to another clock."""
        return max(CLOCK_RTOL * self.wall_seconds, CLOCK_ATOL_SECONDS, CALL_OVERHEAD_SECONDS * self.num_entries)

    def build_columns(self, what: str, seconds: Iterable[float]) -> dict[str, Any]:
        """Build the check columns of rows with measured times.

        Args:
            what: name of the measured work, for the message.
            seconds: times [s] by another clock, which together cover all contexts of this watch.

        Returns:
            The columns `wall_seconds_check`, `wall_seconds_sum`, `cpu_seconds` and `preempted`.

        Raises:
            ClockMismatch: the sum of the times differs from the wall time of this watch by more than its tolerance.
        """
        total = sum(seconds)
        if (
            not -self.max_difference
            <= self.wall_seconds - total
            <= self.max_difference + PREEMPTED_FACTOR * self.preempted_seconds
            or self.thread_seconds / 2 - total > max(CLOCK_ATOL_SECONDS, CALL_OVERHEAD_SECONDS * self.num_entries)
        ):  # so that NaN fails too
            raise ClockMismatch(
                f"the times of {what} add up to {total:.6g} s, where another clock measured {self.wall_seconds:.6g} s, "
                f"{self.preempted_seconds:.3g} s of them without computing: one "
                "of the two does not measure what it says"
            )
        return {
            "wall_seconds_check": self.wall_seconds,
            "wall_seconds_sum": total,
            "cpu_seconds": self.process_seconds,
            "preempted": self.preempted_seconds > max(CLOCK_RTOL * self.wall_seconds, CLOCK_ATOL_SECONDS),
        }


class Stopwatch:
    """Stopwatch for successive pieces of work, each also timed by a watch.

    `seconds` is the time of the last one [s].
    """

    def __init__(self, watch: PhaseWatch) -> None:
        self.watch, self.seconds, self._began = watch, 0.0, 0.0

    def __enter__(self) -> None:
        self.watch.__enter__()
        self._began = perf_counter()

    def __exit__(self, *_: object) -> None:
        self.seconds = perf_counter() - self._began
        self.watch.__exit__()


def check_phases(prepared: PreparedSolver, problem: StepProblem) -> dict[str, Callable[[], object]]:
    """Return a solver's phases after checking that each computes.

    The returned array of each phase is overwritten with NaN, and a second call must restore it.

    Args:
        prepared: solver with the phases of an iteration.
        problem: step problem at which they are called.

    Returns:
        Functions by the names of the phases.

    Raises:
        RunFailed: a phase does nothing.
    """
    phases = prepared.iteration_phases(problem)
    for phase, call in phases.items():
        given: Any = call()
        if not isinstance(given, np.ndarray):
            does = given is not None
        else:
            array = cast(NDArray[Any], given)
            known = np.isfinite(array).any()
            array.fill(np.nan)
            again = call()
            does = bool(np.isfinite(np.asarray(again)).any()) or not known or not len(problem.system.free_vertices)
        if not does:
            raise RunFailed(
                f"the phase {phase} does nothing; expected a call that computes and returns its output array"
            )
    return phases
