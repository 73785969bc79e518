"""Performance profiles (Dolan and More 2002) and data profiles (More and Wild 2009) over all frozen steps.

A step from one first guess is a problem of its own. With t the time of a solver on a problem,

    performance profile  rho(tau)  = share of the problems with t <= tau * (the least t of all solvers)
    data profile         d(kappa)  = share of the problems with t <= kappa * (one iteration of the yardstick)

the yardstick being the plain local-global iteration. What is not reached, failed or was never tried takes for ever.
"""

from __future__ import annotations

from collections.abc import Iterable
from math import inf
from pathlib import Path

import numpy as np

from harness.report.accuracy.sheet import (
    LEFT,
    RIGHT,
    TOP,
    files,
    foot,
    legend,
    line,
    log_axis,
    looks,
    notes,
    panel,
    sheet,
)
from harness.report.accuracy.table import Curve, Table, Values
from harness.report.accuracy.times import TARGETS, askable, contested, power, races, seconds_to
from harness.report.page import text

_YARDSTICKS = ("sparse", "numba", "dense")


def ratios(found: Iterable[list[Curve]], labels: Iterable[str], target: float, units: Iterable[float]) -> Values:
    """Times to the target in the units of their problems, infinite where not reached: (labels, problems)."""
    rows = []
    labels = list(labels)
    for race, unit in zip(found, units, strict=True):
        times = {curve.label: seconds_to(curve, target) for curve in race}
        rows.append([times.get(label, inf) / unit for label in labels])
    return np.array(rows, float).reshape(len(rows), len(labels)).T


def share(values: Values, at: Values) -> Values:
    """The share of `values` (k,) that is at most each of `at` (m,); shape (m,)."""
    return np.searchsorted(np.sort(values), at, side="right") / len(values)


def judged(table: Table, target: float) -> list[list[Curve]]:
    """The races that this accuracy can be judged on: some solver reaches it, none of them at once."""
    return [r for r in races(table).values() if askable(r[0].problem, target) and contested(r, target)]


def least(race: Iterable[Curve], target: float) -> float:
    """The least time to the target [s]."""
    return min(seconds_to(curve, target) for curve in race)


def iteration_seconds(race: Iterable[Curve], yardstick: str) -> float:
    """Median seconds of one iteration of the yardstick in a race; nan where it did not take part."""
    for curve in race:
        if curve.solver == yardstick and len(curve.iterations) > 1 and np.isfinite(curve.seconds).all():
            spans = curve.seconds[:, -1] - curve.seconds[:, 0]
            return float(np.median(spans)) / (curve.iterations[-1] - curve.iterations[0])
    return np.nan


def draw_profiles(table: Table, stem: Path) -> list[Path]:
    """A row of performance profiles and a row of data profiles, a column for each accuracy; returns the files."""
    marked = looks((curve.label, curve.solver) for curve in table.curves)
    races_of = {target: judged(table, target) for target in TARGETS}
    if not any(races_of.values()):
        return []
    everyone = {name for group in races_of.values() for race in group for name in {c.solver for c in race}}
    yardstick = next((name for name in _YARDSTICKS if name in everyone), "")
    doubtful = sum(bool(problem.doubt) for problem in table.problems)
    words = ["The step alone, set-up apart. A solver that failed, or was not tried, on a problem never solves it."]
    if doubtful:
        words.append(f"{doubtful} of {len(table.problems)} steps are left out: their minimum is not certified.")
    facts = [
        "share of the problems solved",
        f"{len(table.problems) - doubtful} steps, first guesses apart",
        *table.machine,
    ]
    with sheet(stem, "Performance and data profiles", facts) as page:
        width = (RIGHT - LEFT - 50) / len(TARGETS) - 16
        height = (foot(words) - TOP - 170) / 2
        headings = (
            "within this many times the fastest solver's time",
            f"within the time of this many iterations of {yardstick}",
        )
        for row, heading in enumerate(headings):
            top = TOP + 46 + row * (height + 96)
            text(page, LEFT + 50, top - 30, heading, size=11, weight="bold")
            for column, target in enumerate(TARGETS):
                found = races_of[target]
                name = f"to a gap of {power(target)}: {len(found)} problems"
                ax = panel(page, LEFT + 50 + column * (width + 16), top, width, height, name)
                units = [least(r, target) if row == 0 else iteration_seconds(r, yardstick) for r in found]
                known = [(r, unit) for r, unit in zip(found, units, strict=True) if np.isfinite(unit)]
                _steps(ax, known, marked, target, start=1.0 if row == 0 else 0.1)
                if column:
                    ax.tick_params(labelleft=False)
        legend(page, marked)
        notes(page, words)
    return files(stem)


def _steps(ax, known, marked, target: float, *, start: float) -> None:
    """The profiles of all solvers as steps."""
    values = ratios([r for r, _ in known], marked, target, [unit for _, unit in known])
    finite = values[np.isfinite(values)]
    low = min(start, float(finite.min(initial=start)))
    high = 2.0 * max(float(finite.max(initial=start)), 5 * start)
    for k, look in enumerate(marked.values()):
        if len(known) and np.isfinite(values[k]).any():
            x = np.unique([low, *values[k][np.isfinite(values[k])], high])
            line(ax, x, share(values[k], x), look, drawstyle="steps-post")
    log_axis(ax.xaxis, low, high, unit="plain")
    ax.set_ylim(-0.02, 1.03)
    ax.yaxis.set_major_formatter(lambda value, _: f"{100 * value:.0f} %")
