"""Interleaved paired benchmark (ABBA) of two programs with a sequential test.

It ends when the test decides, or with the time budget. The order of each block, A B B A or B A A B, is random. A test
detects any difference between two running programs. Two programs of the same code differ slightly by the memory layout
of their data (Mytkowicz et al. 2009). Between blocks the work of both is therefore rebuilt at other addresses, in an
eighth of the time (after Curtsinger and Berger 2013). The effect of the layout becomes noise with many samples.
Properties that a process has all its life, such as the addresses of its compiled code, become noise likewise: both
programs are restarted every PAIR. A slowdown is reported only if a second benchmark, with restarted
programs, confirms it. The first benchmark alone excludes chance, so the second needs fewer blocks. The guarantee of the
test is for the ratio of one pair of processes. For several pairs it is valid only as far as their ratios agree; the
study measures the error rate for these.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from itertools import count
from random import Random, SystemRandom
from time import perf_counter
from typing import Literal

from harness.experiments.gates.sequential import RatioInterval, Rule, Verdict, interval, turn

ORDERS = ("ABBA", "BAAB")

BUDGET = 240.0
"""Time budget [s] of a test, after which the result is inconclusive."""

SHARE = 0.125
"""Fraction of the time for rebuilding the work. The layout changes the times of blocks by 1 to 2 %, and other programs
change them by 3 to 7 %. Some twenty layouts are therefore as good as hundreds; the number of blocks matters more.
"""

PAIR = 30.0
"""Benchmark time [s] after which both programs are restarted. Two processes of the same code can differ by up to 1 %
all their lives, and a restart samples that difference again. Most benchmarks end earlier, and a start takes two or
three seconds.
"""

CONFIRMS = 0.05
"""Error probability of the benchmark that confirms a first one; a false alarm requires an error of both."""

CALL = 0.01
"""Minimum work of a call [s], for which the overhead of a clock is negligible. Longer calls have no less variance: with
seven other programs on two cores, blocks of 10 and of 40 ms have the same spread, and five times as many of them fit.
"""

Clock = Literal["cpu", "wall"]
Timed = Callable[[], float]
"""Function that performs the work once and returns its time [s] by some clock."""


@dataclass(frozen=True, slots=True)
class Racers:
    """Two programs after warm-up.

    a, b: perform the work once and return its time [s].
    renew: rebuilds the work of both at other addresses and warms it up; None if that is impossible.
    """

    a: Timed
    b: Timed
    renew: Callable[[], None] | None = None


Start = Callable[[], AbstractContextManager[Racers]]
"""Context manager that starts both programs and stops them at its end."""


@dataclass(slots=True)
class Renewing:
    """Rebuilds the programs' work between blocks, limited to its share of the time."""

    renew: Callable[[], None] | None
    _earned: float = 0.0

    def after(self, seconds: float) -> None:
        """Rebuild the work after a block, if the share of the time permits.

        seconds: duration of the block.
        """
        self._earned += SHARE / (1.0 - SHARE) * seconds
        if self.renew and self._earned >= 0.0:
            began = perf_counter()
            self.renew()
            self._earned -= perf_counter() - began


@dataclass(frozen=True, slots=True)
class Turn:
    """One block: its order, and the times [s] of its four calls in that order."""

    order: str
    seconds: tuple[float, ...]

    def of(self, who: str) -> list[float]:
        """Return the two times [s] of program "A" or "B"."""
        return [seconds for name, seconds in zip(self.order, self.seconds, strict=True) if name == who]

    @property
    def log_ratio(self) -> float:
        """Log of the ratio of A's time to B's."""
        return turn(self.of("A"), self.of("B"))


@dataclass(frozen=True, slots=True)
class Result:
    """Result of a performance test.

    answer: decision of the sequential test.
    rule: the test, with its limit and error probability.
    interval: estimated ratio of times, with its confidence interval.
    turns: all timed blocks.
    elapsed: duration of the blocks [s].
    load: load average of the machine at the end.
    starts: number of pairs of started programs, one every PAIR and those of the confirmation.
    """

    answer: Verdict
    rule: Rule
    interval: RatioInterval
    turns: tuple[Turn, ...]
    elapsed: float
    load: float
    starts: int = 1

    def __str__(self) -> str:
        limit, (ratio, low, high) = self.rule.limit, (self.interval.ratio, self.interval.low, self.interval.high)
        if self.answer is Verdict.UNDECIDED:
            held = f"{low:.3g} to {high:.3g}" if low > 0 else f"{len(self.turns)} turns are too few"
            return (
                f"cannot tell within {self.elapsed:.0f} s: {held} (limit {limit:.3g}), on a machine with {self._load}"
            )
        near = 0.9 <= limit <= 1.5 and ratio < 2
        if self.answer is Verdict.FAILS:
            if near:
                bounds = f"[{_percent(low)}, {_percent(high)}]"
                return f"slower by {_percent(ratio)} % {bounds}: fails (limit {_percent(limit)} %)"
            return f"ratio {ratio:.3g} [{low:.3g}, {high:.3g}]: fails (limit {limit:.3g})"
        if near and high >= 1:
            return f"no slower than {_percent(high)} %: holds (limit {_percent(limit)} %)"
        return f"ratio {ratio:.3g} [{low:.3g}, {high:.3g}]: holds (limit {limit:.3g})"

    @property
    def _load(self) -> str:
        return f"load {self.load:.0f}" if self.load >= 1 else "no load"


def race(
    racers: Racers, rule: Rule, *, budget: float = BUDGET, coin: Random | None = None, before: Sequence[Turn] = ()
) -> Result:
    """Time both programs, after warm-up, until the test decides or the budget ends.

    Args:
        racers: the two programs.
        rule: test on the ratio A / B.
        budget: seconds.
        coin: chooses the orders; by default the system's random source, which no other program can follow.
        before: blocks of earlier processes of the same programs, which count too.
    """
    game = playing(racers.b, rule, budget=budget, coin=coin, renew=racers.renew, before=before)
    next(game)
    while True:
        try:
            game.send(racers.a())
        except StopIteration as done:
            return done.value


def playing(
    b: Timed,
    rule: Rule,
    *,
    budget: float = BUDGET,
    coin: Random | None = None,
    renew: Callable[[], None] | None = None,
    before: Sequence[Turn] = (),
) -> Generator[None, float, Result]:
    """Run a paired benchmark as a generator, for a caller that times A itself.

    Each `yield` expects the seconds of one call of A; the generator returns the result.

    Args:
        b: times one call of B.
        rule: test on the ratio A / B.
        budget: seconds.
        coin: chooses the orders.
        renew: rebuilds the work of both programs.
        before: blocks of earlier processes of the same programs, which count too.
    """
    began, turns, renewing = perf_counter(), list(before), Renewing(renew)
    for order in orders(coin):
        at, seconds = perf_counter(), list[float]()
        for who in order:
            seconds.append((yield) if who == "A" else b())
        turns.append(Turn(order, tuple(seconds)))
        answer, now = rule.judge([t.log_ratio for t in turns]), perf_counter()
        if answer is not Verdict.UNDECIDED or now - began >= budget:
            return result(rule, turns, now - began)
        renewing.after(now - at)
    raise AssertionError("orders do not end")


def orders(coin: Random | None = None) -> Iterator[str]:
    """Draw the orders of blocks, without end."""
    coin = coin or SystemRandom()
    while True:
        yield coin.choice(ORDERS)


def result(rule: Rule, turns: list[Turn], elapsed: float) -> Result:
    """Build the result of at least one block.

    Args:
        rule: test on the ratio A / B.
        turns: all blocks so far.
        elapsed: their duration [s].
    """
    x = [t.log_ratio for t in turns]
    return Result(rule.judge(x), rule, interval(x, rule.alpha), tuple(turns), elapsed, os.getloadavg()[0])


def confirmed(start: Start, rule: Rule, *, budget: float = BUDGET) -> Result:
    """Benchmark programs that are restarted every PAIR, and confirm a failure with other processes.

    The confirmation has an error probability of its own, CONFIRMS. If it disagrees, the result is
    inconclusive.

    Args:
        start: starts both programs.
        rule: test on the ratio A / B.
        budget: seconds of both benchmarks together, without the starts of programs.
    """
    first = _raced(start, rule, budget)
    if first.answer is not Verdict.FAILS:
        return first
    second = _raced(start, replace(rule, alpha=max(rule.alpha, CONFIRMS)), max(budget - first.elapsed, 0.0))
    answer = Verdict.FAILS if second.answer is Verdict.FAILS else Verdict.UNDECIDED
    both, elapsed = (*first.turns, *second.turns), first.elapsed + second.elapsed
    # Each benchmark's interval has its own error; the wider bounds contain both.
    low, high = (f(getattr(r.interval, end) for r in (first, second)) for f, end in ((min, "low"), (max, "high")))
    found = RatioInterval(interval([t.log_ratio for t in both], rule.alpha).ratio, low, high)
    return Result(answer, rule, found, both, elapsed, second.load, first.starts + second.starts)


def _raced(start: Start, rule: Rule, budget: float) -> Result:
    """Run one benchmark over successive pairs of processes, whose blocks are pooled."""
    elapsed, turns = 0.0, tuple[Turn, ...]()
    for starts in count(1):
        with start() as racers:
            found = race(racers, rule, budget=min(PAIR, budget - elapsed), before=turns)
        elapsed, turns = elapsed + found.elapsed, found.turns
        if found.answer is not Verdict.UNDECIDED or elapsed >= budget:
            return replace(found, elapsed=elapsed, starts=starts)
    raise AssertionError("count does not end")


def _percent(ratio: float) -> str:
    return f"{100 * (ratio - 1):.1f}"
