# pyright: reportUnknownMemberType=false
# Matplotlib's stubs do not type most keywords.
"""Performance profiles (Dolan and More 2002) and data profiles (More and Wild 2009) over all frozen steps.

A step from one first guess is a problem of its own. With t the time of a solver on a problem,

    performance profile  rho(tau)  = share of the problems with t <= tau * (the least t of all solvers)
    data profile         d(kappa)  = share of the problems with t <= kappa * (one iteration of the yardstick)

the yardstick being the plain local-global iteration. What is not reached, or failed, counts as infinite time. Only
solvers that were tried on as many problems as any are compared: the others' shares would tell what was tried.
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
    """By label the times to the target over the least of all solvers, (problems,); infinite where not reached."""
    found = judged(table, target)
    return _ratios(table, found, target, [min(seconds_to(curve, target) for curve in race) for race in found])


def iteration_ratios(table: Measurements, target: float) -> dict[str, Values]:
    """By label the times to the target over that of one iteration of the yardstick, where that was tried."""
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
    """By label on how many problems the solvers were tried that were tried on fewer than others."""
    tried = Counter(label for race in races(table).values() for label in {curve.label for curve in race})
    return {label: count for label, count in sorted(tried.items()) if count < max(tried.values())}


def yardstick(table: Measurements) -> str:
    """The backend of the plain local-global iteration that data profiles count in: of those that ran on most problems
    the last by alphabet; "" where none was measured."""
    tried = Counter(curve.solver for curve in table.curves if curve.family == LOCAL_GLOBAL)
    return max(tried, key=lambda name: (tried[name], name), default="")


def not_shown(table: Measurements) -> list[str]:
    """A sentence about the solvers that profiles leave out, if there are any."""
    count = len(races(table))
    names = ", ".join(f"{label} (on {tried} of {count})" for label, tried in partly_tried(table).items())
    return [f"Not shown, as not tried on every problem: {names}."] if names else []


def share(values: Values, at: Values) -> Values:
    """The share of `values` (k,) that is at most each of `at` (m,); shape (m,)."""
    return np.searchsorted(np.sort(values), at, side="right") / len(values)


def judged(table: Measurements, target: float) -> list[list[Curve]]:
    """The races that this accuracy can be judged on: some solver reaches it, none of them at once."""
    return [r for r in races(table).values() if askable(r[0].problem, target) and contested(r, target)]


def iteration_seconds(race: Iterable[Curve], solver: str) -> float:
    """Median seconds of one iteration of a solver in a race; nan where it did not take part."""
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
    """A row of performance profiles and a row of data profiles, a column for each accuracy; returns the files."""
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
    """The profiles of all solvers as steps."""
    finite = np.concatenate([values[np.isfinite(values)] for values in found.values()])
    low, high = finite.min(initial=1.0), 2.0 * finite.max(initial=5.0)
    for label, values in found.items():
        if np.isfinite(values).any():
            x = np.unique([low, *values[np.isfinite(values)], high])
            line(ax, x, share(values, x), marked[label], drawstyle="steps-post", markevery=0.3)
    log_axis(ax.xaxis, low, high, unit="plain")
    ax.set_ylim(-0.02, 1.03)
    ax.yaxis.set_major_formatter(lambda value, _: f"{100 * value:.0f} %")
