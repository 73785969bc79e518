"""The cheapest way to an error: all ways are run, the best one's setting is moved until its error is the one asked.

    estimate = |p(T) - q(T)| / |q(T) - p(0)|,    q the same motion to a much smaller error

in Frobenius norms over the vertices that are not pinned, as errors are told everywhere. How the cost of a way grows
with its error is known from its order: a step is in proportion to error^(1/order).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf, sqrt
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from harness.base.errors import RunFailed
from harness.config.sweep import SolverSpec
from harness.experiments.asked.ways import Asked, Way, ways
from harness.reference.growth import Growth, growth
from harness.simulation.controlled import Path, Stuck, TooSlow
from solvers.problem import Positions

AIM = 0.65
"""Of the error asked, what a setting is chosen for: estimates scatter."""
_AIM_EVEN = 0.85
"""Where steps have one length, and the error falls by their order."""
WIDE = 1 / 3
"""An error below this part of the one asked was bought for too much, if a cheaper way is stable; DOUBT times as much,
where it is estimated."""
CLOSER = 1 / 50
"""Of a step's error, that of the motion that errors are estimated by."""
DOUBT = 1.25
"""What an estimate is multiplied by: the closer motion errs too, by a tenth of it, and by a sixth where stability rules
the steps and its own are hardly shorter."""
_FINER = 10.0
"""Times as exact, by the order and the number of steps, at which a motion counts as closer."""
_MOVES, _CLOSINGS = 6, 3
_SHORT = 0.05
"""Processor seconds below which a way is run twice, and the lesser time counts."""
_AT_FIRST, _PATIENCE = 1.0, 4.0
"""Processor seconds that a way may take, so many times as many if none ends within them, or as the cheapest takes."""


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """A way, its setting (`Follower`), the path that it gave, and its estimated relative error."""

    way: Way
    setting: float
    path: Path
    estimated: float

    @property
    def tolerance(self) -> float | None:
        """Of the error of a step [m]; None where steps have one length."""
        return None if self.way.follower.even else self.setting

    @property
    def columns(self) -> dict[str, Any]:
        """What rows of any table say of it."""
        return {
            "integrator": self.way.integrator,
            "estimated": self.estimated,
            "local_tolerance_m": self.tolerance,
            "accepted": self.path.accepted,
            "rejected": self.path.rejected,
            "factorisations": self.path.factorisations,
        }

    def again(self) -> Path:
        """The same once more."""
        return self.way.follower.follow(self.setting)


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """best: what keeps to the error; tried: the ways at their first settings, which the tolerance [m] gave, and the
    processor seconds that each promised, the cheapest first; closer: by which errors were estimated; seconds: wall time
    of all that was done besides; note: why it is far more exact than was asked."""

    best: Found
    tried: tuple[tuple[Found, float], ...]
    tolerance: float
    closer: Found
    seconds: float
    note: str

    def error(self, p: Positions, free: NDArray[np.int64]) -> float:
        """Of the end p (n, 3) [m] of another motion by the closer one, relative to its way, over the free vertices."""
        q = self.closer.path.positions
        away, moved = (float(np.linalg.norm((x - q[-1])[free])) for x in (p, q[0]))
        return away / moved


def foresee(asked: Asked, error: float, say: Callable[[str], None]) -> Growth:
    """How far ahead the motion can be known, told before anything else. Raises RunFailed where the error cannot be had
    at the horizon, with the one that can."""
    seen = growth(asked.bound, asked.horizon, asked.frames)
    if not seen.scale > 0.0:
        raise RunFailed("nothing moves up to the horizon, and errors are relative to what does")
    worst = float(seen.grown[-1])
    told = (
        f"what differs by 1e-12 of the size at the start differs by {worst:.1g} of the motion after {asked.horizon:g} s"
    )
    if not seen.known(error) >= asked.horizon * (1.0 - 1e-9):
        raise RunFailed(
            f"{told}: nobody can know the motion to {error:g} there; it can be known to {seen.least:.1g}, and to "
            f"{error:g} up to {seen.known(error):.3g} s: ask for a larger --error or a shorter --horizon"
        )
    say(f"{told}: an error of {error:g} can be known there, and of {seen.least:.0e} at the least")
    return seen


def search(
    asked: Asked,
    error: float,
    seen: Growth,
    say: Callable[[str], None],
    pairs: Sequence[tuple[str, SolverSpec]] = (),
) -> Answer:
    """The cheapest way that keeps to a relative error at the horizon; pairs: see `ways`. Raises RunFailed where none
    does."""
    return _Search(asked, error, seen, say).answer(pairs)


class _Search:
    def __init__(self, asked: Asked, error: float, seen: Growth, say: Callable[[str], None]) -> None:
        self._asked, self._error, self._seen, self._say = asked, error, seen, say
        self._free = asked.bound(asked.frame, "own").system.free

    def answer(self, pairs: Sequence[tuple[str, SolverSpec]]) -> Answer:
        self._say("ways to the error:")
        tolerance = 0.2 * self._error * self._seen.scale
        known = ways(self._asked, self._say, pairs)
        began = perf_counter()
        raced = self._race(known, tolerance)
        closer = self._closer(raced)
        graded = sorted((self._graded(one, closer) for one in raced), key=self._promise)
        for one in graded:
            self._say(f"  {one.way}: {one.path.seconds:.3g} s, an error of {one.estimated:.1e}")
        best, note = self._moved(graded[0], closer)
        besides = perf_counter() - began - best.path.seconds
        promised = tuple((one, self._promise(one)) for one in graded)
        return Answer(best, promised, tolerance, closer, besides, note)

    @staticmethod
    def _run(way: Way, setting: float, limit: float = inf) -> Found:
        return Found(way, setting, way.follower.follow(setting, limit=limit), inf)

    def _race(self, ways: list[Way], tolerance: float) -> list[Found]:
        """Those that end, none of which takes much longer than the fastest."""
        found, stuck, limit = list[Found](), list[Stuck](), _AT_FIRST
        while ways and not found:
            late = list[tuple[Way, float]]()
            for way in ways:
                try:
                    one = self._run(way, way.follower.first(tolerance), limit)
                    if one.path.processor < _SHORT:
                        one = min(one, self._run(way, one.setting), key=lambda run: run.path.processor)
                    found.append(one)
                    limit = max(_AT_FIRST, _PATIENCE * min(one.path.processor for one in found))
                except Stuck as error:
                    stuck.append(error)
                except TooSlow:
                    late.append((way, limit))
            ways, limit = [way for way, _ in late], _PATIENCE * limit
            for way, given in late if found else ():
                self._say(f"  {way}: given up after {given:.3g} s, for it is slower than others")
        if not found:
            raise stuck[0]
        return found

    def _closer(self, raced: list[Found]) -> Found:
        """The same motion with a much smaller error, by what is the cheapest there and keeps to an error, if any does:
        by so much smaller a one that it can tell the error asked."""
        best = min(raced, key=lambda one: (one.way.follower.even, self._cost(one, CLOSER)))
        follower, found = best.way.follower, best
        part = CLOSER ** (follower.order / (follower.order + 1.0))
        for _ in range(_CLOSINGS):  # where frames or stability rule the steps, a closer tolerance may change nothing
            found = self._run(best.way, follower.changed(found.setting, part))
            if (found.path.accepted / best.path.accepted) ** follower.order >= _FINER:
                break
        begun = self._graded(best, found)
        if AIM * self._error < begun.estimated < inf:
            found = self._run(best.way, follower.changed(found.setting, AIM * self._error / begun.estimated))
        return found

    @staticmethod
    def _cost(one: Found, part: float) -> float:
        """Processor seconds with a part of the error of a step: it prepares once."""
        stepping = min(one.path.seconds, one.path.processor)
        return one.path.processor - stepping + stepping * part ** (-1.0 / one.way.follower.order)

    def _graded(self, one: Found, closer: Found) -> Found:
        p, q = one.path.positions, closer.path.positions
        moved = self._apart(q[-1], q[0])
        least = (closer.tolerance or 0.0) / self._seen.scale
        estimated = max(DOUBT * self._apart(p[-1], q[-1]) / moved, least) if moved else inf
        return Found(one.way, one.setting, one.path, estimated if estimated < inf else inf)

    def _apart(self, p: Positions, q: Positions) -> float:
        return float(np.linalg.norm((p - q)[self._free]))

    def _promise(self, one: Found) -> float:
        """The processor seconds that a way would take to the error asked; where it is more exact than that, those that
        it took, for explicit steps may be as long as is stable already."""
        return self._cost(one, min(1.0, self._aim(one) / one.estimated)) if one.estimated < inf else inf

    def _aim(self, one: Found) -> float:
        """The error that a setting is chosen for."""
        return (_AIM_EVEN if one.way.follower.even else AIM) * self._error

    def _moved(self, one: Found, closer: Found) -> tuple[Found, str]:
        """The way at the setting that gives the error asked, and why it is far more exact, if it is."""
        best, above = None if one.estimated > self._error else one, None
        for _ in range(_MOVES):
            if best and best.estimated >= DOUBT * WIDE * self._error:
                return best, ""
            setting = self._next(one, best, above)
            if setting == one.setting:
                return one, _STABLE
            before, one = one, self._graded(self._run(one.way, setting), closer)
            if one.estimated > self._error:
                if best is None and one.estimated > 0.5 * before.estimated and setting < 0.1 * before.setting:
                    raise self._nothing(min(one, before, key=lambda x: x.estimated))
                above = one
            elif best and one.path.processor > 0.9 * best.path.processor:
                return best, _STABLE
            else:
                best = one
        if best is None:
            raise self._nothing(one)
        return best, _STABLE if best.estimated < DOUBT * WIDE * self._error else ""

    def _next(self, one: Found, best: Found | None, above: Found | None) -> float:
        """The setting to try after one that errs too much or too little: between both where they are known."""
        if best and above:
            return sqrt(best.setting * above.setting)
        aim = self._aim(one)
        ratio = aim / max(one.estimated, 1e-3 * aim)
        return one.way.follower.changed(one.setting, min(30.0, max(1e-3, ratio)))

    def _nothing(self, nearest: Found) -> RunFailed:
        at = f" at {nearest.tolerance:.1e} m a step" if nearest.tolerance else f" with {nearest.path.accepted} steps"
        return RunFailed(
            f"no steps keep to an error of {self._error:g}: {nearest.way} reached {nearest.estimated:.1g}{at}, and "
            "shorter ones do not come nearer; ask for a larger --error or a shorter --horizon"
        )


_STABLE = "longer steps are unstable, or cost as much"
