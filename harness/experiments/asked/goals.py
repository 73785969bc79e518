"""Time for the same error, side by side: the cheapest way that is known now, and what it is held against.

Both take turns in one process on one core, told by processor time, preparing included: its least of some rounds. A goal
that is `graded` has errors by the reference; the way's own may be twice the one asked at the most, and smaller than a
third of it only where longer steps would be unstable.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import inf
from time import thread_time

from harness.base.errors import RunFailed
from harness.config.goals import Goals, OneGoal
from harness.experiments.asked.held import Held, held
from harness.experiments.asked.search import WIDE, Found, foresee, search
from harness.experiments.asked.ways import Asked
from harness.reference.store import Store
from solvers.problem import NotPositiveDefinite, Unsupported

ROUNDS, MOST_ROUNDS, LONG = 3, 15, 0.5
"""Rounds at the least, and at the most, where the way's own are over sooner than after so many processor seconds."""
MOST = 2.0
"""Times the error asked, what one may be."""


@dataclass(frozen=True, slots=True)
class Met:
    """A goal as it was found: way and other in words, their errors and processor seconds; error: of the way by the
    reference, None where it does not grade; note: why it is far more exact than was asked; bound: whether the other
    would take longer than its seconds; reason: why there is nothing."""

    asked: OneGoal
    size: int
    vertices: int = 0
    way: str = ""
    estimated: float = inf
    seconds: float = inf
    other: str = ""
    other_error: float = inf
    other_seconds: float = inf
    bound: bool = False
    error: float | None = None
    note: str = ""
    reason: str = ""

    @property
    def ratio(self) -> float:
        """Of its processor time to the other's, at the most."""
        return self.seconds / self.other_seconds

    @property
    def as_asked(self) -> bool:
        """Whether the error, where the reference grades it, is about the one asked."""
        if self.error is None:
            return True
        return self.error <= MOST * self.asked.error and (self.error >= WIDE * self.asked.error or bool(self.note))

    @property
    def holds(self) -> bool:
        """Whether no more than the part that was wanted is needed, for the error asked."""
        return not self.reason and self.as_asked and self.ratio <= self.asked.goal.wanted


def met(goals: Goals, store: Store, say: Callable[[str], None]) -> Iterator[Met]:
    """Each goal in turn; what cannot be measured is told by its reason. store: of references."""
    for one in goals.goals:
        say(f"{one.scene} {one.size or ''} to {one.error:g} after {one.goal.horizon:g} s:")
        asked = None
        try:
            asked = Asked.of(goals.scenes[one.scene], one.size, one.goal.horizon)
            yield _met(one, asked, store, say)
        except (RunFailed, Unsupported, NotPositiveDefinite) as error:
            yield Met(one, asked.size if asked else one.size or 0, reason=str(error))


def _met(one: OneGoal, asked: Asked, store: Store, say: Callable[[str], None]) -> Met:
    seen = foresee(asked, one.error, say)
    truth = store.trajectory(asked.scene, asked.size, [asked.horizon], error=one.error) if one.goal.graded else None
    answer = search(asked, one.error, seen, say)
    best, free = answer.best, asked.bound(asked.frame, "own").system.free
    end = best.path.positions[-1]
    other = held(one, asked, answer, lambda p: truth.error(-1, p) if truth else answer.error(p, free), say)
    ours, its = _in_turns(best, other)
    return Met(
        *(one, asked.size, len(end), str(best.way), best.estimated, ours),
        *(other.name, other.error, its, other.bound),
        error=truth.error(-1, end) if truth else None,
        note=answer.note,
    )


def _in_turns(best: Found, other: Held) -> tuple[float, float]:
    """The least processor seconds of both."""
    ours, its = list[float](), [other.seconds]
    while len(ours) < ROUNDS or (sum(ours) < LONG and len(ours) < MOST_ROUNDS):
        ours.append(_timed(best.again))
        its += [other.again()] if other.again else []
    return min(ours), min(its)


def _timed(call: Callable[[], object]) -> float:
    began = thread_time()
    call()
    return thread_time() - began
