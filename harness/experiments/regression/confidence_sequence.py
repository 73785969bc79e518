"""Sequential test on the ratio of two programs' times.

It may be evaluated after every block, and stops as soon as it decides. A block runs A and B twice each, and gives one
number:

    x = log((A_1 + A_2) / (B_1 + B_2))        in the order A B B A or B A A B, chosen at random

If A takes exp(m) times as long as B, then x - m is positive or negative with equal probability, given all earlier
blocks and |x - m|: the random order alone decided which positions of the block were A's. This is true for any behaviour
of the machine, such as bursts or drift, and for disturbances of any size. Blocks need be neither independent nor
identically distributed. So of n blocks the number k that lie above m is distributed as that of n fair coins. With the
mixture martingale (Robbins 1970)

    M_n(k) = 2^n B(a + k, a + n - k) / B(a, a),        P(some n has M_n >= 1/alpha) <= alpha        (Ville 1939)

the m that are not rejected form a confidence sequence: an interval on the median of x, between two order statistics. It
covers m at all n at once with a probability of at least 1 - alpha. Source: Howard and Ramdas 2022, "Sequential
estimation of quantiles with applications to A/B testing and best-arm identification".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import exp, log

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import betaln
from springbench.harness.results.regression_verdict import RegressionVerdict

DEFAULT_ALPHA = 0.001
"""Default error probability: the probability that the interval ever excludes the true ratio."""

MIXTURE_PARAMETER = 2.0
"""Parameter a of the mixture. Between 60 and 1000 blocks no other value from 1 to 15 makes an interval narrower by more
than 5 %. With this value, 16 blocks that agree are sufficient for a decision.
"""


@dataclass(frozen=True, slots=True)
class RatioInterval:
    """A ratio of times: the median over the blocks, with its bounds.

    The bounds are those of the confidence sequence, 0 and inf if open.
    """

    ratio: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class SequentialTest:
    """Sequential test of whether a ratio of times exceeds a limit.

    It stops when the confidence interval lies entirely above `max_ratio` (fail) or below it (pass).

    Attributes:
        max_ratio: limit of the ratio of times.
        alpha: upper bound on the probability of a wrong decision.

    Raises:
        ValueError: for an invalid max_ratio or alpha.
    """

    max_ratio: float
    alpha: float = DEFAULT_ALPHA

    def __post_init__(self) -> None:
        if not 0 < self.max_ratio < float("inf"):
            raise ValueError(f"max_ratio: got {self.max_ratio}; expected a ratio of times such as 1.03")
        if not 0 < self.alpha < 1:
            raise ValueError(f"alpha: got {self.alpha}; expected a probability such as {DEFAULT_ALPHA}")

    def decide_verdict(self, log_ratios: ArrayLike) -> RegressionVerdict:
        """Decide after the blocks so far, given their log ratios (n,)."""
        x = np.asarray(log_ratios, float)
        needed = compute_critical_count(len(x), self.alpha)
        if np.count_nonzero(x > log(self.max_ratio)) >= needed:
            return RegressionVerdict.FAIL
        if np.count_nonzero(x < log(self.max_ratio)) >= needed:
            return RegressionVerdict.PASS
        return RegressionVerdict.INCONCLUSIVE


def compute_log_ratio(a: Sequence[float], b: Sequence[float]) -> float:
    """Compute the log of the ratio of a's total time to b's.

    Args:
        a, b: times of the two programs in one block [s].
    """
    return log(sum(a) / sum(b))


def compute_interval(log_ratios: ArrayLike, alpha: float = DEFAULT_ALPHA) -> RatioInterval:
    """Compute the median ratio of n >= 1 blocks, and the confidence sequence.

    Args:
        log_ratios: log ratios of the blocks (n,).
        alpha: error probability.
    """
    x = np.sort(np.asarray(log_ratios, float))
    n, needed = len(x), compute_critical_count(len(x), alpha)
    if needed > n:
        return RatioInterval(exp(float(np.median(x))), 0.0, float("inf"))
    # At least `needed` blocks lie above every m < x_(n - needed + 1), counted from 1: such m are rejected.
    return RatioInterval(exp(float(np.median(x))), exp(x[n - needed]), exp(x[needed - 1]))


@lru_cache(maxsize=4096)
def compute_critical_count(n: int, alpha: float) -> int:
    """Compute the least number of blocks on one side of m that rejects m.

    It is n + 1 if all n blocks are too few.

    Args:
        n: number of blocks.
        alpha: error probability.
    """
    k = np.arange(n // 2, n + 1)
    is_rejected = n * log(2) + betaln(MIXTURE_PARAMETER + k, MIXTURE_PARAMETER + n - k) - betaln(
        MIXTURE_PARAMETER, MIXTURE_PARAMETER
    ) >= -log(alpha)
    return n // 2 + int(np.argmax(is_rejected)) if is_rejected[-1] else n + 1
