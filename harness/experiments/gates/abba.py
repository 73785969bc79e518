"""Two programs take turns, A B B A or B A A B by a coin, until the sequential test knows or the budget ends.

A test sees what differs between two running programs, and two of the same code differ a little, by where their memory
happens to lie (Mytkowicz et al. 2009). So the work of both is made anew between turns, elsewhere in memory, in an
eighth of the time (after Curtsinger and Berger 2013): what places do is noise then, of which there are many draws.
What a process keeps all its life, such as where its compiled code lies, is noise likewise: both programs are started
anew every PAIR seconds. A slowdown is believed only when a second race, by programs started anew, finds it too. Chance
is ruled out by the first race alone, so that the second needs fewer turns. What the rule proves of one pair's ratio
holds of several only as far as theirs are alike: of those the study tells how often gates are wrong.
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
"""Seconds that a gate may take until it says that it cannot tell."""

SHARE = 0.125
"""Of the time, what making work anew may take. Places make turns differ by 1 to 2 %, other programs by 3 to 7 %: some
twenty places are as good as hundreds, and turns are what is needed."""

PAIR = 30.0
"""Seconds of racing after which both programs are started anew: what differs between two processes of the same code all
their lives, up to 1 %, is then drawn again. Most races end earlier, and a start takes two or three seconds."""

CONFIRMS = 0.05
"""The error of the race that confirms a first one: both must be wrong for an alarm to be."""

CALL = 0.01
"""Seconds of work that a call should hold: a clock's overhead is nothing then. Longer calls are not steadier: with
seven other programs on two cores turns of 10 and of 40 ms spread alike, and five times as many of them fit."""

Clock = Literal["cpu", "wall"]
Timed = Callable[[], float]
"""Does the work once; how long it took [s], by whatever clock."""


@dataclass(frozen=True, slots=True)
class Racers:
    """Two programs, warm. renew: makes the work of both anew, elsewhere in memory, and warms it; None where that cannot
    be done."""

    a: Timed
    b: Timed
    renew: Callable[[], None] | None = None


Start = Callable[[], AbstractContextManager[Racers]]
"""Starts both programs, which end with the block."""


@dataclass(slots=True)
class Renewing:
    """Renews racers' work after turns, in its share of the time, however long it takes."""

    renew: Callable[[], None] | None
    _earned: float = 0.0

    def after(self, seconds: float) -> None:
        """After a turn of so many seconds."""
        self._earned += SHARE / (1.0 - SHARE) * seconds
        if self.renew and self._earned >= 0.0:
            began = perf_counter()
            self.renew()
            self._earned -= perf_counter() - began


@dataclass(frozen=True, slots=True)
class Turn:
    """One turn: its order, and the seconds of its four calls in that order."""

    order: str
    seconds: tuple[float, ...]

    def of(self, who: str) -> list[float]:
        """The two times of A, or of B [s]."""
        return [seconds for name, seconds in zip(self.order, self.seconds, strict=True) if name == who]

    @property
    def log_ratio(self) -> float:
        """Of A's time to B's."""
        return turn(self.of("A"), self.of("B"))


@dataclass(frozen=True, slots=True)
class Result:
    """What came of a gate. elapsed: seconds that its turns took; load: the machine's load average at its end; starts:
    how many pairs of programs were started, one every PAIR seconds and others to confirm what the first race found."""

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
    """Time both, warm, until the rule answers or `budget` seconds have gone.

    coin: what decides the orders; the system's own where none is given, which nothing on the machine can follow;
    before: turns that others of the same programs took already, and that count.
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
    """The same for a caller that times A itself: each time this yields it wants the seconds of one call of A."""
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
    """The orders of turns, without end."""
    coin = coin or SystemRandom()
    while True:
        yield coin.choice(ORDERS)


def result(rule: Rule, turns: list[Turn], elapsed: float) -> Result:
    """What came of the turns so far, one at least, after so many seconds."""
    x = [t.log_ratio for t in turns]
    return Result(rule.judge(x), rule, interval(x, rule.alpha), tuple(turns), elapsed, os.getloadavg()[0])


def confirmed(start: Start, rule: Rule, *, budget: float = BUDGET) -> Result:
    """A race between programs that `start` starts, anew every PAIR seconds; one that fails is repeated with others.

    The second has a larger error of its own (CONFIRMS); where it finds otherwise nothing is decided. The budget is that
    of both races together, without what it takes to start programs.
    """
    first = _raced(start, rule, budget)
    if first.answer is not Verdict.FAILS:
        return first
    second = _raced(start, replace(rule, alpha=max(rule.alpha, CONFIRMS)), max(budget - first.elapsed, 0.0))
    answer = Verdict.FAILS if second.answer is Verdict.FAILS else Verdict.UNDECIDED
    both, elapsed = (*first.turns, *second.turns), first.elapsed + second.elapsed
    # Each race's interval has its own error; the wider ends hold what both say.
    low, high = (f(getattr(r.interval, end) for r in (first, second)) for f, end in ((min, "low"), (max, "high")))
    found = RatioInterval(interval([t.log_ratio for t in both], rule.alpha).ratio, low, high)
    return Result(answer, rule, found, both, elapsed, second.load, first.starts + second.starts)


def _raced(start: Start, rule: Rule, budget: float) -> Result:
    """One race, of pairs that are started one after the other, whose turns count together."""
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
