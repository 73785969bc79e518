"""Time to accuracy, amortised set-up, and crossings between solvers.

Rows contain about 12 iterates per decade. Between two of them the gap is assumed to decrease geometrically. A solver
can stop only after whole iterations: the first one at or below the accuracy counts.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import ceil, inf, log

import numpy as np
from springbench.harness.report.accuracy.accuracy_data import AccuracyData, ConvergenceCurve, SnapshotProblem
from springbench.harness.report.number_format import format_quantity

GAP_TARGETS = (1e-1, 1e-2, 1e-3, 1e-4, 1e-6)
"""Energy gaps at which solvers are compared."""

AMORTISATION_STEPS = (1, 10, 100, 1000)
"""Numbers of steps over which set-up is amortised."""

FATAL_STATUSES = ("unsupported", "diverged", "failed")
"""Statuses of curves that reach nothing; with others, such as time-limit, earlier results count."""

_HALF_DECADES = tuple(10.0 ** (-k / 2) for k in range(1, 19))  # gaps at which crossings are detected


@dataclass(frozen=True, slots=True)
class TimeToAccuracy:
    """Iteration and time at which a curve reached an accuracy.

    The time is given as median and quartiles over the rounds, and for each round [s].
    """

    iteration: int
    rounds: tuple[float, ...]
    seconds: float
    lower: float
    upper: float


def find_time_to_accuracy(curve: ConvergenceCurve, target: float) -> TimeToAccuracy | None:
    """Find when the gap is first at most `target`.

    Args:
        curve: convergence of a solver.
        target: energy gap.

    Returns:
        The iteration and its time; None if the gap is not reached, the run failed or was not timed.
    """
    at = np.flatnonzero(curve.gap <= target)
    if not len(at) or curve.status in FATAL_STATUSES:
        return None
    k = int(at[0])
    iteration, seconds = curve.iterations[k], curve.seconds[:, k]
    if k > 0 and curve.iterations[k] - curve.iterations[k - 1] > 1:
        before, start = curve.gap[k - 1], curve.iterations[k - 1]
        # A gap of round-off, possibly negative, has no logarithm.
        end = max(curve.gap[k], min(curve.problem.roundoff_gap, target))
        share = log(before / target) / log(before / end) if end < before else 1.0
        iteration = ceil(start + share * (iteration - start))
        part = (iteration - start) / (curve.iterations[k] - start)
        seconds = curve.seconds[:, k - 1] + part * (seconds - curve.seconds[:, k - 1])
    if not np.isfinite(seconds).all():
        return None
    lower, middle, upper = np.quantile(seconds, (0.25, 0.5, 0.75))
    return TimeToAccuracy(int(iteration), tuple(seconds.tolist()), float(middle), float(lower), float(upper))


def compute_amortised_seconds(curve: ConvergenceCurve, target: float, steps: int | None = None) -> float:
    """Return the median time to the accuracy [s], infinite if it is not reached.

    Args:
        curve: convergence of a solver.
        target: energy gap.
        steps: number of steps over which set-up is amortised; None to omit set-up.
    """
    reached = find_time_to_accuracy(curve, target)
    if reached is None:
        return inf
    return reached.seconds + (curve.warm_seconds / steps if steps else 0.0)


def is_solvable(problem: SnapshotProblem, target: float) -> bool:
    """Return whether the minimum is certified and the accuracy is above round-off.

    Args:
        problem: step snapshot.
        target: accuracy, an energy gap.
    """
    return not problem.uncertified_reason and target > problem.roundoff_gap


def describe_excluded_steps(problems: Iterable[SnapshotProblem]) -> list[str]:
    """Describe the steps that comparisons exclude, in at most one sentence."""
    problems = list(problems)
    doubtful = [problem.problem_label for problem in problems if problem.uncertified_reason]
    if not doubtful:
        return []
    which = f": {', '.join(doubtful)}" if len(doubtful) < 4 else ""
    return [f"{len(doubtful)} of {len(problems)} steps are left out, as their minimum is not certified{which}"]


def group_by_start(table: AccuracyData) -> dict[tuple[str, str], list[ConvergenceCurve]]:
    """Group the curves with the same start, by problem and initial guess."""
    found: dict[tuple[str, str], list[ConvergenceCurve]] = {}
    for curve in table.curves:
        found.setdefault((curve.problem.problem_digest, curve.initial_guess), []).append(curve)
    return found


def is_contested(curves: Sequence[ConvergenceCurve], target: float) -> bool:
    """Return whether a solver, but not the initial guess, reaches the accuracy.

    Args:
        curves: curves with the same problem and initial guess.
        target: accuracy, an energy gap.
    """
    times = [reached for curve in curves if (reached := find_time_to_accuracy(curve, target))]
    return bool(times) and all(reached.iteration > 0 for reached in times)


def describe_crossings(curves: Iterable[ConvergenceCurve]) -> list[str]:
    """Describe which solver is fastest to which accuracy, without set-up.

    One sentence describes the coarsest accuracy, and one each change of the fastest solver. A solver takes the lead if
    its upper quartile is below the leader's lower quartile, because a smaller difference may be chance.
    """
    curves = list(curves)
    if len(curves) < 2:
        return []
    sentences: list[str] = []
    leader: ConvergenceCurve | None = None
    for target in _HALF_DECADES:
        if not is_contested(curves, target) or target <= curves[0].problem.roundoff_gap:
            continue
        times = {curve: reached for curve in curves if (reached := find_time_to_accuracy(curve, target))}
        best = min(times, key=lambda curve: times[curve].seconds)
        if leader is None:
            sentences.append(
                f"at {format_gap(target)} {best.label} is the fastest: {format_duration(times[best].seconds)}"
            )
            leader = best
        elif leader not in times or times[best].upper < times[leader].lower:
            known = leader in times
            other = f" against {format_duration(times[leader].seconds)}" if known else ", which does not reach it"
            comparison = f"from {format_gap(target)} on {best.label} is faster than {leader.label}"
            sentences.append(f"{comparison}: {format_duration(times[best].seconds)}{other}")
            leader = best
    return sentences


def format_gap(value: float) -> str:
    """Format a gap: 1e-3, 3e-4."""
    return f"{value:.0e}".replace("e-0", "e-").replace("e+00", "")


def format_duration(seconds: float) -> str:
    """Format a time with three significant digits: 41.2 ms, 1.3 s."""
    unit, scale = next(((u, s) for u, s in (("s", 1.0), ("ms", 1e-3)) if seconds >= 0.9995 * s), ("µs", 1e-6))
    return f"{format_quantity(seconds / scale)} {unit}"


def compute_median_time(curves: Sequence[ConvergenceCurve], target: float, steps: int | None = None) -> float:
    """Return the median time over a solver's solvable problems [s].

    Args:
        curves: convergence of one solver, by problem.
        target: energy gap to be reached.
        steps: number of steps over which set-up is amortised; None to omit set-up.

    Returns:
        The median, infinite if half of them are unsolved; nan if no problem is solvable.
    """
    times = [compute_amortised_seconds(curve, target, steps) for curve in curves if is_solvable(curve.problem, target)]
    # The upper of the two middle values: a mean with infinity would hide the solved half.
    return sorted(times)[len(times) // 2] if times else np.nan
