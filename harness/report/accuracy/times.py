"""Seconds to an accuracy: when a curve first reaches a gap, what set-up adds, and where solvers overtake each other.

Rows keep about 12 iterates a decade. Between two that are kept the gap is taken to fall geometrically, and a solver
can stop at whole iterations alone: the first at or below the accuracy counts.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import ceil, inf, log

import numpy as np

from harness.report.accuracy.measured import Curve, Measurements, Problem
from harness.report.page import quantity

TARGETS = (1e-1, 1e-2, 1e-3, 1e-4, 1e-6)
"""The gaps at which solvers are compared."""

STEPS = (1, 10, 100, 1000)
"""The numbers of steps over which set-up is spread."""

FATAL = ("unsupported", "diverged", "failed")
"""Statuses of curves that reach nothing; the others, such as time-limit, keep what they reached before."""

_FINE = tuple(10.0 ** (-k / 2) for k in range(1, 19))  # half decades, in which solvers overtake each other


@dataclass(frozen=True, slots=True)
class Reached:
    """When a curve came to an accuracy: the iteration; seconds: median and quartiles over the rounds."""

    iteration: int
    seconds: float
    lower: float
    upper: float


def reach(curve: Curve, target: float) -> Reached | None:
    """When the gap is first at most `target`; None where it never is, or the run failed, or was not timed."""
    at = np.flatnonzero(curve.gap <= target)
    if not len(at) or curve.status in FATAL:
        return None
    k = int(at[0])
    iteration, seconds = curve.iterations[k], curve.seconds[:, k]
    if k > 0 and curve.iterations[k] - curve.iterations[k - 1] > 1:
        before, start = curve.gap[k - 1], curve.iterations[k - 1]
        # A gap of round-off, even negative, has no logarithm.
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
    """Median seconds to the accuracy, infinite where it is not reached; with set-up spread over `steps` if given."""
    reached = reach(curve, target)
    if reached is None:
        return inf
    return reached.seconds + (curve.warm / steps if steps else 0.0)


def askable(problem: Problem, target: float) -> bool:
    """Whether an accuracy can be judged: the minimum is certified and the accuracy is above round-off."""
    return not problem.doubt and target > problem.round_off


def left_out(problems: Iterable[Problem]) -> list[str]:
    """A sentence about the steps that comparisons leave out, if there are any."""
    problems = list(problems)
    doubtful = [problem.name for problem in problems if problem.doubt]
    if not doubtful:
        return []
    which = f": {', '.join(doubtful)}" if len(doubtful) < 4 else ""
    return [f"{len(doubtful)} of {len(problems)} steps are left out, as their minimum is not certified{which}"]


def races(table: Measurements) -> dict[tuple[str, str], list[Curve]]:
    """The curves that race from the same start: by problem and first guess, in the order of the rows."""
    found: dict[tuple[str, str], list[Curve]] = {}
    for curve in table.curves:
        found.setdefault((curve.problem.digest, curve.first_guess), []).append(curve)
    return found


def contested(race: Sequence[Curve], target: float) -> bool:
    """Whether the accuracy is one that some solver reaches and the first guess does not have already."""
    times = [reached for curve in race if (reached := reach(curve, target))]
    return bool(times) and all(reached.iteration > 0 for reached in times)


def crossings(race: Iterable[Curve]) -> list[str]:
    """Who is the fastest to which accuracy, set-up apart: a sentence for the coarsest, and one for each change.

    A solver takes the lead where its upper quartile is below the leader's lower one: less may be chance.
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
    """A gap in words: 1e-3, 3e-4."""
    return f"{value:.0e}".replace("e-0", "e-").replace("e+00", "")


def duration(seconds: float) -> str:
    """A time in words with three significant digits: 41.2 ms, 1.3 s."""
    unit, scale = next(((u, s) for u, s in (("s", 1.0), ("ms", 1e-3)) if seconds >= 0.9995 * s), ("µs", 1e-6))
    return f"{quantity(seconds / scale)} {unit}"
