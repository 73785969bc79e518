"""Find the cheapest method for an error.

All methods are run, then the setting of the best one is tuned.

    estimate = |p(T) - q(T)| / |q(T) - p(0)|,    q: reference trial of a much smaller error

in Frobenius norms over the free vertices. The cost of a method depends on its error through its order: the step size is
proportional to error^(1/order). The order is measured where two settings were run, for a scene may reduce it. Methods
are compared by CPU seconds, including preparation.
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
"""Fraction of the target error at which a setting aims, because estimates scatter."""
_AIM_EVEN = 0.85
"""The same fraction for fixed step sizes, whose error follows their order."""
WIDE = 1 / 3
"""Smallest fraction of the target error that is accepted if a cheaper setting is stable.

Estimated errors are compared with DOUBT times this fraction.
"""
CLOSER = 1 / 50
"""Local error of the reference trial, as a fraction of that of the trial."""
DOUBT = 1.25
"""Safety factor on error estimates, because the reference trial has an error too.

That error is a tenth of the estimate. It is a sixth where stability limits the step size, so that the reference trial
has hardly shorter steps.
"""
_FINER = 10.0
"""Factor of accuracy, by order and number of steps, above which a trial may serve as reference."""
_MOVES, _STALLS, _CLOSINGS = 6, 2, 3
_SHORT = 0.05
"""CPU time below which a trial is run twice, and the smaller time counts [s]."""
_AT_FIRST, _PATIENCE = 1.0, 4.0
"""First time limit of a method [s of CPU time]; factor on the limit if no method finishes, and on the cheapest time."""
_DEAR = 2.0
"""Factor on the predicted cost of the next method, above which that method is tried first."""
_LEAST_ORDER = 0.5
"""Lower bound of measured orders; a method whose error decreases more slowly is given up."""


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """Run of a method at one setting.

    Attributes:
        way: the method.
        setting: setting of its stepper.
        path: the computed motion.
        estimated: estimated relative error.
        order: order at which the error decreases with the step size: that of the method, or less if two settings show
            it.
    """

    way: Way
    setting: float
    path: Path
    estimated: float
    order: float

    @property
    def tolerance(self) -> float | None:
        """Tolerance on the local error [m]; None for fixed step sizes."""
        return None if self.way.follower.even else self.setting

    @property
    def columns(self) -> dict[str, Any]:
        """Columns of this trial, common to several tables."""
        return {
            "integrator": self.way.integrator,
            "estimated": self.estimated,
            "local_tolerance_m": self.tolerance,
            "accepted": self.path.accepted,
            "rejected": self.path.rejected,
            "factorisations": self.path.factorisations,
        }

    def again(self) -> Path:
        """Run the method again at the same setting."""
        return self.way.follower.follow(self.setting)


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """Result of a search.

    Attributes:
        best: cheapest trial that meets the error.
        tried: first trials of all methods with the CPU seconds predicted for the target error, cheapest first.
        tolerance: tolerance of the first trials [m].
        closer: trial from which errors are estimated.
        seconds: wall time of everything except the best trial.
        note: why the best trial is much more accurate than requested; empty otherwise.
    """

    best: Found
    tried: tuple[tuple[Found, float], ...]
    tolerance: float
    closer: Found
    seconds: float
    note: str

    def error(self, p: Positions, free: NDArray[np.int64]) -> float:
        """Return the error of end positions p (n, 3) [m] against the reference trial.

        The error is relative to the displacement and taken over the free vertices.
        """
        q = self.closer.path.positions
        away, moved = (float(np.linalg.norm((x - q[-1])[free])) for x in (p, q[0]))
        return away / moved


def foresee(asked: Asked, error: float, say: Callable[[str], None]) -> Growth:
    """Compute how far ahead the motion is predictable.

    The smallest error that can be reached is printed.

    Args:
        asked: the scene and its end time.
        error: relative error to reach.
        say: prints a remark.

    Raises:
        Unpredictable: the error cannot be reached at t_end (the message states one that can), or nothing moves.
    """
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
    """Find the cheapest method whose relative error at t_end is at most `error`.

    Args:
        asked: the scene and its end time.
        error: relative error to reach.
        seen: growth of perturbations (`foresee`).
        say: prints a remark.
        pairs: integrators and solvers to try; the default candidates if empty.

    Raises:
        RunFailed: no method reaches the error.
    """
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
        """Run a method at a setting.

        The method is run twice where the first run is too short to be timed.
        """
        paths = [way.follower.follow(setting, limit=limit)]
        if paths[0].processor < _SHORT:
            paths.append(way.follower.follow(setting, limit=limit))
        return Found(way, setting, min(paths, key=lambda path: path.processor), inf, way.follower.order)

    def _race(self, ways: list[Way], tolerance: float) -> list[Found]:
        """Run all methods and return the trials that are fast enough.

        The time limit is a multiple of the fastest time.
        """
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
        """Run the reference trial: a motion whose error is much smaller than the target error.

        The method that is predicted to be the cheapest at that accuracy computes it; adaptive methods are preferred.
        """
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
        """Estimate the order of fixed step sizes by doubling the step twice (Richardson)."""
        two, four = (self._run(one.way, parts * one.setting).path.positions[-1] for parts in (2.0, 4.0))
        first, second = self._apart(one.path.positions[-1], two), self._apart(two, four)
        fell = log(first / second, 2.0) if 0.0 < first < inf and 0.0 < second < inf else inf
        return min(float(one.way.follower.order), max(_LEAST_ORDER, fell))

    @staticmethod
    def _cost(one: Found, part: float) -> float:
        """Predict the CPU seconds at a fraction of the local error; preparation counts once."""
        stepping = min(one.path.seconds, one.path.processor)
        return one.path.processor - stepping + stepping * part ** (-1.0 / one.order)

    def _graded(self, one: Found, closer: Found) -> Found:
        p, q = one.path.positions, closer.path.positions
        moved = self._apart(q[-1], q[0])
        least = (closer.tolerance or 0.0) / self._seen.scale
        estimated = max(DOUBT * self._apart(p[-1], q[-1]) / moved, least) if moved else inf
        return replace(one, estimated=estimated if estimated < inf else inf)

    def _measured(self, one: Found, closer: Found) -> Found:
        """Estimate the error of a trial, and its order where necessary.

        The order is measured where fixed steps are not accurate enough.
        """
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
        """Predict the CPU seconds of a trial's method at the target error.

        The measured time counts where the trial is more accurate, since explicit steps may have reached the stability
        limit.
        """
        return self._cost(one, min(1.0, self._aim(one) / one.estimated)) if one.estimated < inf else inf

    def _aim(self, one: Found) -> float:
        """Return the error for which a setting is chosen."""
        return (_AIM_EVEN if one.way.follower.even else AIM) * self._error

    def _reached(self, graded: list[Found], closer: Found) -> tuple[Found, str]:
        """Return the first trial that reaches the error, and a note.

        The note states why the trial is much more accurate, if it is.

        A method that exceeds the predicted time of the next one by far is tried again after all others.
        """
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
        """Tune the setting of a method towards the target error, and return the nearest trial.

        The second result says why the trial is much more accurate. Raises TooSlow beyond a limit of CPU seconds.
        """
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
        """Return the next setting to try; between two settings where they bracket the error."""
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
    """Return the second trial with the observed order, at most that of its method."""
    shorter = log(after.path.accepted / before.path.accepted)
    if not (0.0 < before.estimated < inf and 0.0 < after.estimated < inf and abs(shorter) > 0.1):
        return after
    fell = log(before.estimated / after.estimated) / shorter
    return replace(after, order=min(float(after.way.follower.order), max(_LEAST_ORDER, fell)))


_STABLE = "longer steps are unstable, or cost as much"
