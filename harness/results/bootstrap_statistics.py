"""Bootstrap statistics of times: one statistic for each purpose, so that tables are comparable.

    time of a phase              the median over the rounds (of a run: over its steps too)
    time that a frame adds       the mean over the frames of the median over the rounds: such means are additive
    ratio of paired times        the median of the ratios, round by round, of interleaved measurements
    ratio on different days      exp(median over the frames of log(new / old)), of the least over the rounds

A busy machine delays some rounds and accelerates none. The median is robust against delays of nearly half of them; a
mean is not, and a minimum has no interval. Rounds of two days are not paired, and the load differs between the days.
Their ratio uses the least time, which load affects least, and the frames are resampled. Intervals are those of a
percentile bootstrap (Efron 1979, `scipy.stats.bootstrap`), which resamples the rounds. It is seeded, so equal times
give equal intervals.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

NUM_RESAMPLES = 4000
"""Number of bootstrap resamples; with this number the ends of an interval repeat to a few per cent of its width."""


class ConfidenceInterval(NamedTuple):
    """An estimate and the ends of its 95 % interval."""

    estimate: float
    low: float
    high: float


def estimate_ratio(numerator: ArrayLike, denominator: ArrayLike) -> ConfidenceInterval:
    """Estimate the ratio numerator / denominator of paired times.

    The estimate is the median over the rounds.

    Args:
        numerator: times (rounds,), in any unit.
        denominator: times (rounds,) of the same rounds in the same unit.
    """
    return _bootstrap_interval((np.asarray(numerator, float) / np.asarray(denominator, float),), np.median)


def estimate_added_time(more: ArrayLike) -> ConfidenceInterval:
    """Estimate the time that a frame adds.

    It is the mean over frames of the median over rounds. The rounds of each frame are resampled separately. Only the
    drift of the machine couples the rounds of two frames, and it should count as noise.

    Args:
        more: added times (rounds, frames).

    Returns:
        Estimate and interval, in the unit of the times.
    """
    frames = tuple(np.asarray(more, float).T)

    def statistic(*rounds: NDArray[np.float64], axis: int) -> Any:
        return np.mean([np.median(frame, axis=axis) for frame in rounds], axis=0)

    return _bootstrap_interval(frames, statistic)


def compute_min_seconds(steps: Iterable[tuple[int, float]]) -> dict[int, float]:
    """Compute the least time of each frame's step over its rounds [s].

    Args:
        steps: pairs of a frame and its seconds in one round.

    Returns:
        Least seconds by frame.
    """
    seconds: dict[int, float] = {}
    for frame, taken in steps:
        seconds[frame] = min(taken, seconds.get(frame, taken))
    return seconds


def estimate_slowdown(new: Mapping[int, float], old: Mapping[int, float]) -> ConfidenceInterval:
    """Estimate the ratio new / old of times by frame.

    The estimate is over the common frames, of which there is at least one.

    Args:
        new: positive times by frame, in any unit.
        old: positive times by frame in the same unit.
    """
    frames = sorted(set(new) & set(old))
    logs = np.log([new[frame] / old[frame] for frame in frames])
    return ConfidenceInterval(*(float(np.exp(end)) for end in _bootstrap_interval((logs,), np.median)))


def _bootstrap_interval(samples: Sequence[NDArray[np.float64]], statistic: Callable[..., Any]) -> ConfidenceInterval:
    """Compute a statistic with its bootstrap interval; each sample is resampled separately.

    For a single round the interval is the value itself.
    """
    from scipy.stats import bootstrap  # takes half a second to import, and few commands need it

    middle = float(statistic(*samples, axis=-1))
    if len(samples[0]) < 2:
        return ConfidenceInterval(middle, middle, middle)
    found = bootstrap(
        samples,
        statistic,
        vectorized=True,
        n_resamples=NUM_RESAMPLES,
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    return ConfidenceInterval(middle, float(found.low), float(found.high))
