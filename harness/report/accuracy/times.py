"""Time to accuracy, amortised set-up, and crossings between solvers.

Rows contain about 12 iterates per decade. Between two of them the gap is assumed to decrease geometrically. A solver
can stop only after whole iterations: the first one at or below the accuracy counts.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import ceil, inf, log

import numpy as np

from harness.report.accuracy.measured import Curve, Measurements, Problem
from harness.report.page import quantity

TARGETS = (1e-1, 1e-2, 1e-3, 1e-4, 1e-6)
"""Energy gaps at which solvers are compared."""

STEPS = (1, 10, 100, 1000)
"""Numbers of steps over which set-up is amortised."""

FATAL = ("unsupported", "diverged", "failed")
"""Statuses of curves that reach nothing; with others, such as time-limit, earlier results count."""

_FINE = tuple(10.0 ** (-k / 2) for k in range(1, 19))  # half decades, in which solvers overtake each other


@dataclass(frozen=True, slots=True)
class Reached:
    """Iteration and time at which a curve reached an accuracy.

    The time is given as median and quartiles over the rounds [s].
    """

    iteration: int
    seconds: float
    lower: float
    upper: float


def reach(curve: Curve, target: float) -> Reached | None:
    """Find when the gap is first at most `target`.

    Args:
        curve: convergence of a solver.
        target: energy gap.
    Returns: the iteration and its time; None if the gap is not reached, the run failed or was not timed.
    """
    at = np.flatnonzero(curve.gap <= target)
    if not len(at) or curve.status in FATAL:
        return None
    k = int(at[0])
    iteration, seconds = curve.iterations[k], curve.seconds[:, k]
    if k > 0 and curve.iterations[k] - curve.iterations[k - 1] > 1:
        before, start = curve.gap[k - 1], curve.iterations[k - 1]
        # A gap of round-off, possibly negative, has no logarithm.
        end = max(curve.gap[k], min(curve.problem.round_off, target))
        share = log(before / target) / log(before / end) if end < before else 1.0
        iteration = ceil(start + share * (iteration - start))
        part = (iteration - start) / (curve.iterations[k] - start)
        seconds = curve.seconds[:, k - 1] + part * (seconds - curve.seconds[:, k - 1])
    if not np.isfinite(seconds).all():
        return None
    lower, middle, upper = np.quantile(seconds, (0.25, 0.5, 0.75))
    return Reached(int(iteration), float(middle), float(lower), float(upper))


def seconds_to(curve: Curve, target: float, steps: int | None = None) -> float:
    """Return the median time to the accuracy [s], infinite if it is not reached.

    Args:
        curve: convergence of a solver.
        target: energy gap.
        steps: number of steps over which set-up is amortised; None to omit set-up.
    """
    reached = reach(curve, target)
    if reached is None:
        return inf
    return reached.seconds + (curve.warm / steps if steps else 0.0)


def askable(problem: Problem, target: float) -> bool:
    """Return whether the minimum is certified and the accuracy is above round-off."""
    return not problem.doubt and target > problem.round_off


def left_out(problems: Iterable[Problem]) -> list[str]:
    """Describe the steps that comparisons exclude, in at most one sentence."""
    problems = list(problems)
    doubtful = [problem.name for problem in problems if problem.doubt]
    if not doubtful:
        return []
    which = f": {', '.join(doubtful)}" if len(doubtful) < 4 else ""
    return [f"{len(doubtful)} of {len(problems)} steps are left out, as their minimum is not certified{which}"]


def races(table: Measurements) -> dict[tuple[str, str], list[Curve]]:
    """Group the curves with the same start, by problem and initial guess."""
    found: dict[tuple[str, str], list[Curve]] = {}
    for curve in table.curves:
        found.setdefault((curve.problem.digest, curve.first_guess), []).append(curve)
    return found


def contested(race: Sequence[Curve], target: float) -> bool:
    """Return whether a solver, but not the initial guess, reaches the accuracy."""
    times = [reached for curve in race if (reached := reach(curve, target))]
    return bool(times) and all(reached.iteration > 0 for reached in times)


def crossings(race: Iterable[Curve]) -> list[str]:
    """Describe which solver is fastest to which accuracy, without set-up.

    One sentence describes the coarsest accuracy, and one each change of the fastest solver. A solver takes the lead if
    its upper quartile is below the leader's lower quartile, because a smaller difference may be chance.
    """
    race = list(race)
    if len(race) < 2:
        return []
    sentences: list[str] = []
    leader: Curve | None = None
    for target in _FINE:
        if not contested(race, target) or target <= race[0].problem.round_off:
            continue
        times = {curve: reached for curve in race if (reached := reach(curve, target))}
        best = min(times, key=lambda curve: times[curve].seconds)
        if leader is None:
            sentences.append(f"at {power(target)} {best.label} is the fastest: {duration(times[best].seconds)}")
            leader = best
        elif leader not in times or times[best].upper < times[leader].lower:
            known = leader in times
            other = f" against {duration(times[leader].seconds)}" if known else ", which does not reach it"
            who = f"from {power(target)} on {best.label} is faster than {leader.label}"
            sentences.append(f"{who}: {duration(times[best].seconds)}{other}")
            leader = best
    return sentences


def power(value: float) -> str:
    """Format a gap: 1e-3, 3e-4."""
    return f"{value:.0e}".replace("e-0", "e-").replace("e+00", "")


def duration(seconds: float) -> str:
    """Format a time with three significant digits: 41.2 ms, 1.3 s."""
    unit, scale = next(((u, s) for u, s in (("s", 1.0), ("ms", 1e-3)) if seconds >= 0.9995 * s), ("µs", 1e-6))
    return f"{quantity(seconds / scale)} {unit}"
