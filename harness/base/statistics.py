"""The statistics of times, one for each meaning, so that tables can be laid side by side.

    what something takes         the median over the rounds (of a run: over its steps too)
    what a frame adds to a run   the mean over the frames of the median over the rounds: such means add up
    how many times as much       the median of the ratios, round by round, of what took turns
    the same on another day      exp(median over the frames of log(new / old)), of the least over the rounds

A busy machine delays some rounds and speeds up none. The median bears that of nearly half of them; a mean does not, and
a minimum has no interval. Rounds of two days do not pair, and their load differs: there the least is what load moves
least, and the frames are what is resampled. Intervals are those of a percentile bootstrap (Efron 1979,
`scipy.stats.bootstrap`), which resamples the rounds; it is seeded, so the same times give the same interval.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

RESAMPLES = 4000
"""Of the bootstrap: with so many, the ends of an interval repeat to a few per cent of its width."""


class Interval(NamedTuple):
    """A figure and the ends of its 95 % interval."""

    middle: float
    low: float
    high: float


def ratio(theirs: ArrayLike, ours: ArrayLike) -> Interval:
    """How many times as much `theirs` are as `ours`, both (rounds,): the median of the ratios of the same round."""
    return _resampled((np.asarray(theirs, float) / np.asarray(ours, float),), np.median)


def added(more: ArrayLike) -> Interval:
    """What a frame adds, of (rounds, frames): the mean over frames of the median over rounds.

    Each frame's rounds are resampled by themselves: nothing ties those of two frames together but the machine's drift,
    which is to count as noise.
    """
    frames = tuple(np.asarray(more, float).T)

    def statistic(*rounds: NDArray[np.float64], axis: int) -> Any:
        return np.mean([np.median(frame, axis=axis) for frame in rounds], axis=0)

    return _resampled(frames, statistic)


def least(steps: Iterable[tuple[int, float]]) -> dict[int, float]:
    """Of each frame's step the least over its rounds [s], of pairs of a frame and its seconds in a round."""
    seconds: dict[int, float] = {}
    for frame, taken in steps:
        seconds[frame] = min(taken, seconds.get(frame, taken))
    return seconds


def changed(new: Mapping[int, float], old: Mapping[int, float]) -> Interval:
    """How many times as much `new` is as `old`, both by frame: over those that both have, of which there is one."""
    frames = sorted(set(new) & set(old))
    logs = np.log([new[frame] / old[frame] for frame in frames])
    return Interval(*(float(np.exp(end)) for end in _resampled((logs,), np.median)))


def _resampled(samples: Sequence[NDArray[np.float64]], statistic: Callable[..., Any]) -> Interval:
    """The statistic of some samples, each resampled by itself; of a single round the interval is that round."""
    from scipy.stats import bootstrap  # half a second to load: few commands need it

    middle = float(statistic(*samples, axis=-1))
    if len(samples[0]) < 2:
        return Interval(middle, middle, middle)
    found = bootstrap(
        samples,
        statistic,
        vectorized=True,
        n_resamples=RESAMPLES,
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    return Interval(middle, float(found.low), float(found.high))
