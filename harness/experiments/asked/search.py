"""The cheapest way to an error: all ways are run, the best one's setting is moved until its error is the one asked.

    estimate = |p(T) - q(T)| / |q(T) - p(0)|,    q the same motion to a much smaller error

in Frobenius norms over the vertices that are not pinned, as errors are told everywhere. How the cost of a way grows
with its error is known from its order: a step is in proportion to error^(1/order). The order is measured where two
settings were tried, for a scene may lower it. Ways are compared by processor seconds, preparing included.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import inf, log, sqrt
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
_MOVES, _STALLS, _CLOSINGS = 6, 2, 3
_SHORT = 0.05
"""Processor seconds below which a way is run twice, and the lesser time counts."""
_AT_FIRST, _PATIENCE = 1.0, 4.0
"""Processor seconds that a way may take, so many times as many if none ends within them, or as the cheapest takes."""
_DEAR = 2.0
"""Times what the next way promises, what one may take before that one is tried instead."""
_LEAST_ORDER = 0.5
"""No order is measured below it: a way whose error falls more slowly is given up."""


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """A way, its setting (`Follower`), the path that it gave, its estimated relative error, and the order by which the
    error falls with the step: the way's own, or less where two settings showed it."""

    way: Way
    setting: float
    path: Path
    estimated: float
    order: float

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
    """How far ahead the motion can be known, told before anything else. Raises Unpredictable where the error cannot be
    had at the horizon, with the one that can, and where nothing moves."""
    seen = growth(asked.scene, asked.size, asked.horizon)
    seen.require(error)
    say(
        f"a perturbation of 1e-12 of the size grows to {seen.grown[-1]:.1e} of the displacement after "
        f"{asked.horizon:g} s: an error of {error:g} can be reached there, of {seen.least:.0e} at the least"
    )
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
        graded = sorted((self._measured(one, closer) for one in raced), key=self._promise)
        for one in graded:
            self._say(
                f"  {one.way}: {self._promise(one):.3g} s predicted; {one.path.processor:.3g} s for an error of "
                f"{one.estimated:.1e}, of order {one.order:.2g}"
            )
        best, note = self._reached(graded, closer)
        besides = perf_counter() - began - best.path.seconds
        promised = tuple((one, self._promise(one)) for one in graded)
        return Answer(best, promised, tolerance, closer, besides, note)

    @staticmethod
    def _run(way: Way, setting: float, limit: float = inf) -> Found:
        """With a second run where the first is too short to be timed."""
        paths = [way.follower.follow(setting, limit=limit)]
        if paths[0].processor < _SHORT:
            paths.append(way.follower.follow(setting, limit=limit))
        return Found(way, setting, min(paths, key=lambda path: path.processor), inf, way.follower.order)

    def _race(self, ways: list[Way], tolerance: float) -> list[Found]:
        """Those that end, none of which takes much longer than the fastest."""
        found, stuck, limit = list[Found](), list[Stuck](), _AT_FIRST
        while ways and not found:
            late = list[tuple[Way, float]]()
            for way in ways:
                try:
                    found.append(self._run(way, way.follower.first(tolerance), limit))
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
        order = self._order(best) if follower.even else float(follower.order)
        part = CLOSER ** (order / (order + 1.0))
        for _ in range(_CLOSINGS):  # where frames or stability rule the steps, a closer tolerance may change nothing
            found = self._run(best.way, follower.changed(found.setting, part, order))
            if (found.path.accepted / best.path.accepted) ** order >= _FINER:
                break
        begun = self._graded(best, found)
        if AIM * self._error < begun.estimated < inf:
            found = self._run(best.way, follower.changed(found.setting, AIM * self._error / begun.estimated, order))
        return found

    def _order(self, one: Found) -> float:
        """Of steps of one length, by what halving them twice changes (Richardson)."""
        two, four = (self._run(one.way, parts * one.setting).path.positions[-1] for parts in (2.0, 4.0))
        first, second = self._apart(one.path.positions[-1], two), self._apart(two, four)
        fell = log(first / second, 2.0) if 0.0 < first < inf and 0.0 < second < inf else inf
        return min(float(one.way.follower.order), max(_LEAST_ORDER, fell))

    @staticmethod
    def _cost(one: Found, part: float) -> float:
        """Processor seconds with a part of the error of a step: it prepares once."""
        stepping = min(one.path.seconds, one.path.processor)
        return one.path.processor - stepping + stepping * part ** (-1.0 / one.order)

    def _graded(self, one: Found, closer: Found) -> Found:
        p, q = one.path.positions, closer.path.positions
        moved = self._apart(q[-1], q[0])
        least = (closer.tolerance or 0.0) / self._seen.scale
        estimated = max(DOUBT * self._apart(p[-1], q[-1]) / moved, least) if moved else inf
        return replace(one, estimated=estimated if estimated < inf else inf)

    def _measured(self, one: Found, closer: Found) -> Found:
        """One with its estimated error; where steps of one length err too much, half of them, with their order."""
        one = self._graded(one, closer)
        if not one.way.follower.even or one.estimated <= self._error:
            return one
        try:
            return _of_order(one, self._graded(self._run(one.way, 2.0 * one.setting), closer))
        except Stuck:
            return one

    def _apart(self, p: Positions, q: Positions) -> float:
        return float(np.linalg.norm((p - q)[self._free]))

    def _promise(self, one: Found) -> float:
        """The processor seconds that a way would take to the error asked; where it is more exact than that, those that
        it took, for explicit steps may be as long as is stable already."""
        return self._cost(one, min(1.0, self._aim(one) / one.estimated)) if one.estimated < inf else inf

    def _aim(self, one: Found) -> float:
        """The error that a setting is chosen for."""
        return (_AIM_EVEN if one.way.follower.even else AIM) * self._error

    def _reached(self, graded: list[Found], closer: Found) -> tuple[Found, str]:
        """The first way that gives the error asked, at its setting for that, and why it is far more exact, if it is.

        A way that takes much longer than the next one promises is tried again after all others."""
        nearest, times = list[Found](), _DEAR
        while graded:
            late = list[Found]()
            for one, after in zip(graded, [*graded[1:], graded[-1]], strict=True):
                limit = times * max(_SHORT, self._promise(one), self._promise(after))
                try:
                    found, note = self._moved(one, closer, limit)
                except TooSlow:
                    self._say(f"  {one.way}: takes more than {limit:.3g} s")
                    late.append(one)
                    continue
                if found.estimated <= self._error:
                    return found, note
                nearest.append(found)
                self._say(f"  {one.way}: reaches {found.estimated:.1e}, and shorter steps come no nearer")
            graded, times = late, _PATIENCE * times
        raise self._nothing(min(nearest, key=lambda one: one.estimated))

    def _moved(self, one: Found, closer: Found, limit: float) -> tuple[Found, str]:
        """The way at the setting that gives the error asked, or the nearest to it, and why it is far more exact, if it
        is. Raises TooSlow beyond a limit of processor seconds."""
        best, above = None if one.estimated > self._error else one, None
        nearest, stalled = one, 0
        for _ in range(_MOVES):
            if best and best.estimated >= DOUBT * WIDE * self._error:
                return best, ""
            setting = self._next(one, best, above)
            if setting == one.setting:
                return one, _STABLE
            before = one
            try:
                one = _of_order(before, self._graded(self._run(one.way, setting, limit), closer))
            except Stuck:
                break
            nearest = min(nearest, one, key=lambda found: found.estimated)
            if one.estimated > self._error:
                shorter = setting < 0.1 * before.setting or one.path.accepted > 4 * before.path.accepted
                stalled = stalled + 1 if best is None and one.estimated > 0.5 * before.estimated and shorter else 0
                if stalled == _STALLS:
                    break
                above = one
            elif best and one.path.processor > 0.9 * best.path.processor:
                return best, _STABLE
            else:
                best = one
        if best is None:
            return nearest, ""
        return best, _STABLE if best.estimated < DOUBT * WIDE * self._error else ""

    def _next(self, one: Found, best: Found | None, above: Found | None) -> float:
        """The setting to try after one that errs too much or too little: between both where they are known."""
        if best and above:
            return sqrt(best.setting * above.setting)
        aim = self._aim(one)
        ratio = aim / max(one.estimated, 1e-3 * aim)
        return one.way.follower.changed(one.setting, min(30.0, max(1e-3, ratio)), one.order)

    def _nothing(self, nearest: Found) -> RunFailed:
        at = f" at {nearest.tolerance:.1e} m a step" if nearest.tolerance else f" with {nearest.path.accepted} steps"
        return RunFailed(
            f"no steps keep to an error of {self._error:g}: {nearest.way} came nearest and reached "
            f"{nearest.estimated:.1g}{at}, and shorter ones come no nearer; ask for a larger --error or a shorter "
            "--horizon"
        )


def _of_order(before: Found, after: Found) -> Found:
    """After, with the order by which errors fell from one to the other, at most that of the way."""
    shorter = log(after.path.accepted / before.path.accepted)
    if not (0.0 < before.estimated < inf and 0.0 < after.estimated < inf and abs(shorter) > 0.1):
        return after
    fell = log(before.estimated / after.estimated) / shorter
    return replace(after, order=min(float(after.way.follower.order), max(_LEAST_ORDER, fell)))


_STABLE = "longer steps are unstable, or cost as much"
