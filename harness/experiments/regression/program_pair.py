"""Pair of two functions of one process, which are compared, then timed."""

from __future__ import annotations

import time
from collections.abc import Callable
from math import ceil
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from springbench.harness.experiments.regression.abba_benchmark import (
    MIN_CALL_SECONDS,
    ClockName,
    ProgramPair,
    TimedCall,
)

DEFAULT_AGREEMENT_RTOL = 1e-9
"""Default tolerance of the difference of two answers, relative to their size. It covers round-off of some hundred
iterations in another order.
"""

CLOCK_FUNCTIONS: dict[ClockName, Callable[[], float]] = {"cpu": time.process_time, "wall": time.perf_counter}

WorkFunction = Callable[[], Any]
"""Function that performs some work once and returns its answer."""


class AnswersDiffer(Exception):
    """Two programs give different answers, so nothing is timed."""


def require_agreement(new: ArrayLike, old: ArrayLike, rtol: float = DEFAULT_AGREEMENT_RTOL) -> None:
    """Check that two answers agree.

    Args:
        new: points (n, d), or an array of any other shape.
        old: answer of the baseline, of the same shape.
        rtol: tolerance relative to the size of `old`, its largest extent along an axis; 0 requires equal numbers.

    Raises:
        AnswersDiffer: if the shapes or the numbers differ, or a number is NaN.
    """
    now, was = np.asarray(new, float), np.asarray(old, float)
    if now.shape != was.shape:
        raise AnswersDiffer(f"the answers have shapes {now.shape} and {was.shape}; nothing was timed")
    points = was.reshape(-1, was.shape[-1]) if was.ndim > 1 else was.reshape(-1, 1)
    size = float(np.ptp(points, axis=0).max(initial=0.0)) if points.size else 0.0
    size = size or float(np.abs(was).max(initial=0.0)) or 1.0
    difference = float(np.abs(now - was).max(initial=0.0)) / size
    if not difference <= rtol:  # NaN fails too
        raise AnswersDiffer(
            f"the answers differ by {difference:.1e} of their size, at most {rtol:g} is allowed; nothing was timed"
        )


def build_timer(work: WorkFunction, num_calls: int, clock: ClockName) -> TimedCall:
    """Build a function that returns the time [s] of a number of calls together.

    Args:
        work: function to time.
        num_calls: number of calls.
        clock: "cpu" or "wall".
    """
    now = CLOCK_FUNCTIONS[clock]

    def time_calls() -> float:
        start = now()
        for _ in range(num_calls):
            work()
        return now() - start

    return time_calls


def build_program_pair(candidate: WorkFunction, baseline: WorkFunction, clock: ClockName) -> ProgramPair:
    """Build timers of two warm functions, of enough calls for the resolution of the clock.

    Args:
        candidate: function to test.
        baseline: function to compare with.
        clock: "cpu" or "wall".
    """
    once = min(build_timer(work, 1, "wall")() for work in (candidate, baseline))
    num_calls = max(1, ceil(MIN_CALL_SECONDS / max(once, 1e-7)))
    a, b = (build_timer(work, num_calls, clock) for work in (candidate, baseline))
    return ProgramPair(a, b, num_calls=num_calls)
