# pyright: reportUnknownMemberType=false
# Matplotlib's stubs do not type most keywords.
"""Performance profiles and data profiles over all step snapshots.

Performance profiles follow Dolan and More 2002, data profiles More and Wild 2009. A step with one initial guess is one
problem. With t the time of a solver on a problem,

    performance profile  rho(tau)  = share of the problems with t <= tau * (the smallest t of all solvers)
    data profile         d(kappa)  = share of the problems with t <= kappa * (one iteration of the baseline)

where the baseline is the plain local-global iteration. An accuracy that is not reached, or a failure, counts as
infinite time. Only solvers that were measured on the maximum number of problems are compared, because the shares of the
others would depend on the selection of problems.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from math import inf
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from harness.report.accuracy.measured import Curve, Measurements, Values, by_other_code
from harness.report.accuracy.sheet import (
    LEFT,
    RIGHT,
    TOP,
    files,
    foot,
    legend,
    line,
    log_axis,
    notes,
    panel,
    sheet,
)
from harness.report.accuracy.times import TARGETS, askable, contested, left_out, power, races, seconds_to
from harness.report.page import text
from harness.report.style import Mark, looks
from solvers.about import LOCAL_GLOBAL


def least_ratios(table: Measurements, target: float) -> dict[str, Values]:
    """Return times to the target divided by the smallest of all solvers, by label.

    Args:
        table: data of an accuracy measurement.
        target: energy gap.
    Returns: ratios (problems,); infinite where the gap is not reached.
    """
    found = judged(table, target)
    return _ratios(table, found, target, [min(seconds_to(curve, target) for curve in race) for race in found])


def iteration_ratios(table: Measurements, target: float) -> dict[str, Values]:
    """Return times to the target divided by that of one baseline iteration, by label.

    Args:
        table: data of an accuracy measurement.
        target: energy gap.
    Returns: ratios (problems,), for the problems where the baseline was measured.
    """
    units = [(race, iteration_seconds(race, yardstick(table))) for race in judged(table, target)]
    known = [(race, unit) for race, unit in units if np.isfinite(unit)]
    return _ratios(table, [race for race, _ in known], target, [unit for _, unit in known])


def _ratios(
    table: Measurements, found: Sequence[list[Curve]], target: float, units: Sequence[float]
) -> dict[str, Values]:
    times = [{curve.label: seconds_to(curve, target) for curve in race} for race in found]
    missed = partly_tried(table)
    return {
        label: np.array([each.get(label, inf) / unit for each, unit in zip(times, units, strict=True)], float)
        for label in dict.fromkeys(curve.label for curve in table.curves)
        if label not in missed
    }


def partly_tried(table: Measurements) -> dict[str, int]:
    """Count the problems, by label, of solvers measured on fewer problems than others."""
    tried = Counter(label for race in races(table).values() for label in {curve.label for curve in race})
    return {label: count for label, count in sorted(tried.items()) if count < max(tried.values())}


def yardstick(table: Measurements) -> str:
    """Return the backend of the plain local-global iteration that data profiles use as the unit.

    Of the backends measured on most problems it is the last in alphabetical order; "" if none was measured.
    """
    tried = Counter(curve.solver for curve in table.curves if curve.family == LOCAL_GLOBAL)
    return max(tried, key=lambda name: (tried[name], name), default="")


def not_shown(table: Measurements) -> list[str]:
    """Describe the solvers that profiles omit, in at most one sentence."""
    count = len(races(table))
    names = ", ".join(f"{label} (on {tried} of {count})" for label, tried in partly_tried(table).items())
    return [f"Not shown, as not tried on every problem: {names}."] if names else []


def share(values: Values, at: Values) -> Values:
    """Return the cumulative share of values at given limits.

    This is the share of `values` (k,) that is at most each of `at` (m,); shape (m,).
    """
    return np.searchsorted(np.sort(values), at, side="right") / len(values)


def judged(table: Measurements, target: float) -> list[list[Curve]]:
    """Return the races for which this accuracy is meaningful.

    In these, some solver reaches the accuracy, but no initial guess does.
    """
    return [r for r in races(table).values() if askable(r[0].problem, target) and contested(r, target)]


def iteration_seconds(race: Iterable[Curve], solver: str) -> float:
    """Return the median time of one iteration of a solver in a race [s].

    The result is nan if the solver did not take part.
    """
    for curve in race:
        if curve.solver == solver and len(curve.iterations) > 1 and np.isfinite(curve.seconds).all():
            spans = curve.seconds[:, -1] - curve.seconds[:, 0]
            return float(np.median(spans)) / (curve.iterations[-1] - curve.iterations[0])
    return np.nan


_KINDS = (
    ("within this many times the fastest solver's time", least_ratios),
    ("within the time of this many iterations of {}", iteration_ratios),
)


def draw_profiles(table: Measurements, stem: Path) -> list[Path]:
    """Draw performance profiles and data profiles, and return the files.

    There is a row for each kind and a column for each accuracy.
    """
    if not any(judged(table, target) for target in TARGETS):
        return []
    missed = partly_tried(table)
    marked = looks((curve.label, curve.solver) for curve in table.curves if curve.label not in missed)
    words = ["The step alone, set-up apart. A solver that failed on a problem never solves it."]
    words += [*not_shown(table), *left_out(table.problems), *by_other_code(table.curves)]
    steps = f"{sum(not problem.doubt for problem in table.problems)} steps, first guesses apart"
    with sheet(stem, "Performance and data profiles", ["share of the problems solved", steps, *table.machine]) as page:
        width = (RIGHT - LEFT - 50) / len(TARGETS) - 16
        height = (foot(words) - TOP - 170) / 2
        for row, (heading, ratios) in enumerate(_KINDS):
            top = TOP + 46 + row * (height + 96)
            text(page, LEFT + 50, top - 30, heading.format(yardstick(table)), size=11, weight="bold")
            for column, target in enumerate(TARGETS):
                found = ratios(table, target)
                problems = len(next(iter(found.values())))
                name = f"to a gap of {power(target)}: {problems} problems"
                ax = panel(page, LEFT + 50 + column * (width + 16), top, width, height, name)
                _steps(ax, found, marked)
                ax.tick_params(labelleft=column == 0)
        legend(page, marked)
        notes(page, words)
    return files(stem)


def _steps(ax: Axes, found: Mapping[str, Values], marked: Mapping[str, Mark]) -> None:
    """Draw the profiles of all solvers as steps."""
    finite = np.concatenate([values[np.isfinite(values)] for values in found.values()])
    low, high = finite.min(initial=1.0), 2.0 * finite.max(initial=5.0)
    for label, values in found.items():
        if np.isfinite(values).any():
            x = np.unique([low, *values[np.isfinite(values)], high])
            line(ax, x, share(values, x), marked[label], drawstyle="steps-post", markevery=0.3)
    log_axis(ax.xaxis, low, high, unit="plain")
    ax.set_ylim(-0.02, 1.03)
    ax.yaxis.set_major_formatter(lambda value, _: f"{100 * value:.0f} %")
