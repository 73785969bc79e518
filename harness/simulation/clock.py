"""A second opinion about times: wall and CPU time by other clocks, around what is timed.

    pass_seconds = wall time of all that a phase did, by the kernel's raw clock
    lost         = pass_seconds - CPU time             the process was stopped, or others had its processor
    |pass_seconds - sum of the phase's times| <= max(3 % of it, 1 ms), and below that by no more than half as much
                                                 again as was lost besides: who comes back finds the caches cold

The times themselves are taken by `perf_counter`, call by call, elsewhere: an error in one place shows in the other. A
delay can fall between two calls and be in the first sum alone; then it is in `lost` as well, and no failure.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import wraps
from time import CLOCK_MONOTONIC_RAW, clock_gettime, perf_counter, process_time, thread_time
from typing import Any, ParamSpec, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from harness.base.errors import RunFailed
from solvers.problem import Prepared, StepProblem

P = ParamSpec("P")
T = TypeVar("T")

SHARE, LEAST, CALL = 0.03, 1e-3, 5e-6
"""The share of a wall time, and the seconds, by which two clocks may differ; seconds that reading them may take each
time, with the call in between: a tenth of the shortest steps there are."""
COLD = 1.5
"""Of the seconds that were lost, what may be missing: caches are cold after them."""

ITERATION_SHARE = 0.15
"""The share of an iteration's time by which that of its phases may differ before their rows say so."""


class ClocksDisagree(RunFailed):
    """Two clocks tell of different times."""


def measured_again(measure: Callable[P, T]) -> Callable[P, T]:
    """The same, done once more where its clocks disagree; raises ClocksDisagree where they do so twice."""

    @wraps(measure)
    def twice(*arguments: P.args, **named: P.kwargs) -> T:
        try:
            return measure(*arguments, **named)
        except ClocksDisagree:
            return measure(*arguments, **named)

    return twice


@dataclass
class Watch:
    """Adds up the wall and the CPU time of what is done within it, again and again.

    threads: how many may compute. While all of them do, the process takes so many seconds of CPU time a second; while
    one does, it is the thread that called, and takes one.
    """

    threads: int = 1
    wall: float = 0.0
    entered: int = 0
    process: float = 0.0
    thread: float = 0.0
    began: list[float] = field(default_factory=list[float])

    def __enter__(self) -> None:
        self.began = [process_time(), thread_time(), clock_gettime(CLOCK_MONOTONIC_RAW)]

    def __exit__(self, *_: object) -> None:
        wall, thread, process = clock_gettime(CLOCK_MONOTONIC_RAW), thread_time(), process_time()
        self.process += process - self.began[0]
        self.thread += thread - self.began[1]
        self.wall += wall - self.began[2]
        self.entered += 1

    @property
    def lost(self) -> float:
        """Seconds in which nothing was computed."""
        return max(0.0, self.wall - max(self.thread, self.process / self.threads))

    @property
    def tolerance(self) -> float:
        """Seconds by which another clock may differ."""
        return max(SHARE * self.wall, LEAST, CALL * self.entered)

    def columns(self, what: str, seconds: Iterable[float]) -> dict[str, Any]:
        """The columns of rows with these times of `what`, which were taken within. Raises ClocksDisagree."""
        told = sum(seconds)
        if not -self.tolerance <= self.wall - told <= self.tolerance + COLD * self.lost:  # so that NaN fails too
            raise ClocksDisagree(
                f"the times of {what} add up to {told:.6g} s, where another clock saw {self.wall:.6g} s go by, "
                f"{self.lost:.3g} s of them without computing: one of the two does not measure what it says"
            )
        return {
            "pass_seconds": self.wall,
            "summed_seconds": told,
            "cpu_seconds": self.process,
            "interrupted": self.lost > max(SHARE * self.wall, LEAST),
        }


class Clock:
    """Times one piece of work after the other, each of which its watch sees as well; seconds: of the last one."""

    def __init__(self, watch: Watch) -> None:
        self.watch, self.seconds, self._began = watch, 0.0, 0.0

    def __enter__(self) -> None:
        self.watch.__enter__()
        self._began = perf_counter()

    def __exit__(self, *_: object) -> None:
        self.seconds = perf_counter() - self._began
        self.watch.__exit__()


def working(prepared: Prepared, problem: StepProblem) -> dict[str, Callable[[], object]]:
    """A solver's phases, each of which was seen to do something: what it returned was erased, and was there again.

    Raises RunFailed for one that does nothing.
    """
    phases = prepared.phases(problem)
    for phase, call in phases.items():
        given: Any = call()
        if not isinstance(given, np.ndarray):
            does = given is not None
        else:
            array = cast(NDArray[Any], given)
            known = np.isfinite(array).any()
            array.fill(np.nan)
            again = call()
            does = bool(np.isfinite(np.asarray(again)).any()) or not known or not len(problem.system.free)
        if not does:
            raise RunFailed(f"the phase {phase} does nothing; it should compute, and return the array that it wrote")
    return phases
