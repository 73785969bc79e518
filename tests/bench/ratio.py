"""Ratios of two programs measured side by side, and how sure they are.

The time of one program wanders by tens of per cent with the machine and its load; the ratio of two that take turns
wanders by one or two. Each ratio comes from a turn A B A, in which a steady drift cancels:

    ratio = (A_before + A_after) / 2 / B

Turns share no times, so their ratios are independent, and `harness.base.statistics` gives the median's 95 % interval.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import count

import numpy as np
from numpy.typing import ArrayLike
from pytest_benchmark.fixture import BenchmarkFixture

from harness.base.statistics import ratio


@dataclass(frozen=True, slots=True)
class Ratio:
    """The median of the ratios of some turns, and its 95 % interval from `low` to `high`."""

    median: float
    low: float
    high: float
    turns: int

    @classmethod
    def of(cls, candidate: ArrayLike, yardstick: ArrayLike) -> Ratio:
        """The ratio of times (turns, 2), before and after, to times (turns,)."""
        before_and_after = np.asarray(candidate, float).mean(axis=1)
        return cls(*ratio(before_and_after, yardstick), len(before_and_after))

    def exceeds(self, limit: float) -> bool:
        """Whether the whole interval lies above the limit."""
        return self.low > limit


def measure_ratio(
    benchmark: BenchmarkFixture,
    candidate: Callable[[], object],
    yardstick: Callable[[], object],
    *,
    turns: int,
    clock: Callable[[], float],
) -> Ratio:
    """Time of `candidate` over time of `yardstick`; both have been called before, so they are warm.

    The candidate's rounds are pytest-benchmark's own and by the same clock: the file that it stores holds the
    times that the ratio is made of.
    """
    between: list[float] = []
    calls = count()

    def before_a_round() -> None:
        if next(calls) % 2:
            began = clock()
            yardstick()
            between.append(clock() - began)

    benchmark.pedantic(candidate, setup=before_a_round, rounds=2 * turns)
    assert benchmark.stats is not None
    return Ratio.of(np.reshape(benchmark.stats.stats.data, (turns, 2)), between)
