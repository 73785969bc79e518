"""Measure performance targets: the time of the cheapest method for an error, against a baseline.

Both are timed in one process on one core, interleaved. The smallest CPU time of several rounds counts, including
preparation. If a target is `graded`, its errors are computed from the reference solution. The method's error may then
be at most twice the requested one. It may be below a third of it only where longer steps would be unstable.
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
"""Smallest and largest number of rounds; rounds above the minimum end at this total CPU time of the method [s]."""
MOST = 2.0
"""Largest accepted ratio of the error to the requested one."""


@dataclass(frozen=True, slots=True)
class Met:
    """Measured result of a performance target.

    Attributes:
        asked: the performance target.
        size: size of the mesh.
        vertices: number of vertices.
        way: name of the cheapest method.
        estimated: its estimated error.
        seconds: its CPU time [s].
        other: name of the baseline.
        other_error: error of the baseline.
        other_seconds: CPU time of the baseline [s].
        bound: whether the baseline would take longer than other_seconds.
        error: error of the method against the reference solution; None where the target is not graded.
        note: why the method is much more accurate than requested; empty otherwise.
        reason: why there is no result; empty if there is one.
    """

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
        """CPU time of the method divided by that of the baseline.

        It is an upper bound if `bound`.
        """
        return self.seconds / self.other_seconds

    @property
    def as_asked(self) -> bool:
        """Whether the error against the reference solution, if known, is close to the requested one."""
        if self.error is None:
            return True
        return self.error <= MOST * self.asked.error and (self.error >= WIDE * self.asked.error or bool(self.note))

    @property
    def holds(self) -> bool:
        """Whether the error is as requested and the time ratio at most the target ratio."""
        return not self.reason and self.as_asked and self.ratio <= self.asked.goal.wanted


def met(goals: Goals, store: Store, say: Callable[[str], None]) -> Iterator[Met]:
    """Measure the targets one after the other; a failure is reported as `reason`.

    Args:
        goals: the performance targets.
        store: store of the reference solutions.
        say: prints a remark.
    """
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
    """Return the smallest CPU seconds of the method and of the baseline, timed interleaved."""
    ours, its = list[float](), [other.seconds]
    while len(ours) < ROUNDS or (sum(ours) < LONG and len(ours) < MOST_ROUNDS):
        ours.append(_timed(best.again))
        its += [other.again()] if other.again else []
    return min(ours), min(its)


def _timed(call: Callable[[], object]) -> float:
    began = thread_time()
    call()
    return thread_time() - began
