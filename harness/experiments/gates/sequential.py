"""A sequential test on the ratio of two programs' times: it may look after every turn and stop when it knows.

A turn runs A and B twice each, and gives one number:

    x = log((A_1 + A_2) / (B_1 + B_2))        in the order A B B A or B A A B, which a coin decides

If A takes exp(m) times what B takes, then x - m is as likely above 0 as below, given all earlier turns and given
|x - m|: the coin alone decided which places of the turn were A's. This holds however the machine behaves, in bursts
or with a drift, and whatever the size of the disturbance; turns need be neither independent nor alike. So of n turns
the number k that lie above m is that of n fair coins, and with the mixture martingale (Robbins 1970)

    M_n(k) = 2^n B(a + k, a + n - k) / B(a, a),        P(some n has M_n >= 1/alpha) <= alpha        (Ville 1939)

the m that are not refused are a confidence sequence: an interval on the median of x, between two order statistics,
which covers exp(m) at all n at once with probability 1 - alpha at least (Howard and Ramdas 2022, "Sequential estimation
of quantiles with applications to A/B testing and best-arm identification").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from functools import lru_cache
from math import exp, log

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import betaln

ALPHA = 0.001
"""The error of a test: the probability that its interval ever leaves out the true ratio."""

MIXTURE = 2.0
"""The a above: between 60 and 1000 turns no other from 1 to 15 makes an interval narrower by more than 5 %, and with
this one 16 turns that agree decide."""


class Verdict(Enum):
    """What a test says; the value is the exit code of a command that ends with it."""

    HOLDS = 0
    FAILS = 1
    UNDECIDED = 3


@dataclass(frozen=True, slots=True)
class RatioInterval:
    """A ratio of times: the median over the turns, and the ends of the confidence sequence, 0 and inf where open."""

    ratio: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class Rule:
    """When to stop: the ratio lies wholly above `limit` (fails) or below it (holds).

    alpha: the probability of a wrong answer. Raises ValueError for a limit or an alpha that cannot be.
    """

    limit: float
    alpha: float = ALPHA

    def __post_init__(self) -> None:
        if not 0 < self.limit < float("inf"):
            raise ValueError(f"limit: came {self.limit}; wanted a ratio of times, such as 1.03 for 3 % slower")
        if not 0 < self.alpha < 1:
            raise ValueError(f"alpha: came {self.alpha}; wanted a probability between 0 and 1, such as {ALPHA}")

    def judge(self, log_ratios: ArrayLike) -> Verdict:
        """The answer after the turns so far (n,)."""
        x = np.asarray(log_ratios, float)
        needed = critical(len(x), self.alpha)
        if np.count_nonzero(x > log(self.limit)) >= needed:
            return Verdict.FAILS
        return Verdict.HOLDS if np.count_nonzero(x < log(self.limit)) >= needed else Verdict.UNDECIDED

    def first(self, log_ratios: ArrayLike) -> tuple[Verdict, int]:
        """The first answer when looking after every turn (n,), and after how many turns it came; n where there is none.

        The same as `judge` turn by turn, in one pass: for a replay of many recorded samples.
        """
        x = np.asarray(log_ratios, float)
        needed = _critical_up_to(len(x), self.alpha)
        above, below = (np.cumsum(side) >= needed for side in (x > log(self.limit), x < log(self.limit)))
        decided = np.flatnonzero(above | below)
        if not len(decided):
            return Verdict.UNDECIDED, len(x)
        at = int(decided[0])
        return (Verdict.FAILS if above[at] else Verdict.HOLDS), at + 1


def turn(a: Sequence[float], b: Sequence[float]) -> float:
    """The log ratio of a turn's times [s]."""
    return log(sum(a) / sum(b))


def interval(log_ratios: ArrayLike, alpha: float = ALPHA) -> RatioInterval:
    """The median ratio of the turns (n,), n >= 1, and the confidence sequence at this n."""
    x = np.sort(np.asarray(log_ratios, float))
    n, needed = len(x), critical(len(x), alpha)
    if needed > n:
        return RatioInterval(exp(float(np.median(x))), 0.0, float("inf"))
    # At least `needed` turns lie above every m < x_(n - needed + 1), counted from 1: such m are refused.
    return RatioInterval(exp(float(np.median(x))), exp(x[n - needed]), exp(x[needed - 1]))


@lru_cache(maxsize=4096)
def critical(n: int, alpha: float) -> int:
    """The fewest of n turns on one side of m that refuse it; n + 1 where not even all of them do."""
    k = np.arange(n // 2, n + 1)
    refused = n * log(2) + betaln(MIXTURE + k, MIXTURE + n - k) - betaln(MIXTURE, MIXTURE) >= -log(alpha)
    return n // 2 + int(np.argmax(refused)) if refused[-1] else n + 1


def _critical_up_to(n: int, alpha: float) -> NDArray[np.int64]:
    """`critical` of 1 to n turns."""
    return _criticals(1 << n.bit_length(), alpha)[:n]  # so that a replay, which asks for many n, makes a few tables


@lru_cache(maxsize=64)
def _criticals(n: int, alpha: float) -> NDArray[np.int64]:
    return np.array([critical(turns, alpha) for turns in range(1, n + 1)], np.int64)
