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
from springbench.harness.report.accuracy.accuracy_data import (
    AccuracyData,
    ConvergenceCurve,
    FloatArray,
    describe_stale_results,
)
from springbench.harness.report.accuracy.plot_sheet import (
    PANEL_LEFT,
    PANEL_RIGHT,
    PANEL_TOP,
    add_panel,
    draw_legend,
    draw_line,
    draw_notes,
    format_log_axis,
    notes_top,
    plot_sheet,
    sheet_paths,
)
from springbench.harness.report.accuracy.time_to_accuracy import (
    GAP_TARGETS,
    amortised_seconds,
    describe_excluded_steps,
    format_gap,
    group_by_start,
    is_contested,
    is_solvable,
)
from springbench.harness.report.page_layout import draw_text
from springbench.harness.report.plot_style import SeriesStyle, assign_label_styles
from springbench.solvers.iteration.solver_info import LOCAL_GLOBAL_FAMILY


def performance_ratios(table: AccuracyData, target: float) -> dict[str, FloatArray]:
    """Return times to the target divided by the smallest of all solvers, by label.

    Args:
        table: data of an accuracy measurement.
        target: energy gap.
    Returns: ratios (problems,); infinite where the gap is not reached.
    """
    found = solvable_races(table, target)
    return _compute_ratios(
        table, found, target, [min(amortised_seconds(curve, target) for curve in race) for race in found]
    )


def data_profile_ratios(table: AccuracyData, target: float) -> dict[str, FloatArray]:
    """Return times to the target divided by that of one baseline iteration, by label.

    Args:
        table: data of an accuracy measurement.
        target: energy gap.
    Returns: ratios (problems,), for the problems where the baseline was measured.
    """
    units = [(race, median_iteration_seconds(race, baseline_solver(table))) for race in solvable_races(table, target)]
    known = [(race, unit) for race, unit in units if np.isfinite(unit)]
    return _compute_ratios(table, [race for race, _ in known], target, [unit for _, unit in known])


def _compute_ratios(
    table: AccuracyData, ratios: Sequence[list[ConvergenceCurve]], target: float, units: Sequence[float]
) -> dict[str, FloatArray]:
    times = [{curve.label: amortised_seconds(curve, target) for curve in race} for race in ratios]
    missed = count_partial_coverage(table)
    return {
        label: np.array([each.get(label, inf) / unit for each, unit in zip(times, units, strict=True)], float)
        for label in dict.fromkeys(curve.label for curve in table.curves)
        if label not in missed
    }


def count_partial_coverage(table: AccuracyData) -> dict[str, int]:
    """Count the problems, by label, of solvers measured on fewer problems than others."""
    tried = Counter(label for race in group_by_start(table).values() for label in {curve.label for curve in race})
    return {label: count for label, count in sorted(tried.items()) if count < max(tried.values())}


def baseline_solver(table: AccuracyData) -> str:
    """Return the backend of the plain local-global iteration that data profiles use as the unit.

    Of the backends measured on most problems it is the last in alphabetical order; "" if none was measured.
    """
    tried = Counter(curve.solver for curve in table.curves if curve.family == LOCAL_GLOBAL_FAMILY)
    return max(tried, key=lambda name: (tried[name], name), default="")


def describe_omitted_solvers(table: AccuracyData) -> list[str]:
    """Describe the solvers that profiles omit, in at most one sentence."""
    count = len(group_by_start(table))
    names = ", ".join(f"{label} (on {tried} of {count})" for label, tried in count_partial_coverage(table).items())
    return [f"Not shown, as not tried on every problem: {names}."] if names else []


def cumulative_share(values: FloatArray, at: FloatArray) -> FloatArray:
    """Return the cumulative share of values at given limits.

    This is the share of `values` (k,) that is at most each of `at` (m,); shape (m,).
    """
    return np.searchsorted(np.sort(values), at, side="right") / len(values)


def solvable_races(table: AccuracyData, target: float) -> list[list[ConvergenceCurve]]:
    """Return the races for which this accuracy is meaningful.

    In these, some solver reaches the accuracy, but no initial guess does.
    """
    return [r for r in group_by_start(table).values() if is_solvable(r[0].problem, target) and is_contested(r, target)]


def median_iteration_seconds(race: Iterable[ConvergenceCurve], solver: str) -> float:
    """Return the median time of one iteration of a solver in a race [s].

    The result is nan if the solver did not take part.
    """
    for curve in race:
        if curve.solver == solver and len(curve.iterations) > 1 and np.isfinite(curve.seconds).all():
            spans = curve.seconds[:, -1] - curve.seconds[:, 0]
            return float(np.median(spans)) / (curve.iterations[-1] - curve.iterations[0])
    return np.nan


_PROFILE_KINDS = (
    ("within this many times the fastest solver's time", performance_ratios),
    ("within the time of this many iterations of {}", data_profile_ratios),
)


def draw_profiles(table: AccuracyData, stem: Path) -> list[Path]:
    """Draw performance profiles and data profiles, and return the files.

    There is a row for each kind and a column for each accuracy.
    """
    if not any(solvable_races(table, target) for target in GAP_TARGETS):
        return []
    missed = count_partial_coverage(table)
    marked = assign_label_styles((curve.label, curve.solver) for curve in table.curves if curve.label not in missed)
    words = ["The step alone, set-up apart. A solver that failed on a problem never solves it."]
    words += [
        *describe_omitted_solvers(table),
        *describe_excluded_steps(table.problems),
        *describe_stale_results(table.curves),
    ]
    steps = f"{sum(not problem.uncertified_reason for problem in table.problems)} steps, first guesses apart"
    with plot_sheet(
        stem, "Performance and data profiles", ["share of the problems solved", steps, *table.machine_words]
    ) as page:
        width = (PANEL_RIGHT - PANEL_LEFT - 50) / len(GAP_TARGETS) - 16
        height = (notes_top(words) - PANEL_TOP - 170) / 2
        for row, (heading, ratios) in enumerate(_PROFILE_KINDS):
            top = PANEL_TOP + 46 + row * (height + 96)
            draw_text(page, PANEL_LEFT + 50, top - 30, heading.format(baseline_solver(table)), size=11, weight="bold")
            for column, target in enumerate(GAP_TARGETS):
                found = ratios(table, target)
                problems = len(next(iter(found.values())))
                name = f"to a gap of {format_gap(target)}: {problems} problems"
                ax = add_panel(page, PANEL_LEFT + 50 + column * (width + 16), top, width, height, name)
                _draw_profile_steps(ax, found, marked)
                ax.tick_params(labelleft=column == 0)
        draw_legend(page, marked)
        draw_notes(page, words)
    return sheet_paths(stem)


def _draw_profile_steps(ax: Axes, ratios: Mapping[str, FloatArray], styles: Mapping[str, SeriesStyle]) -> None:
    """Draw the profiles of all solvers as steps."""
    finite = np.concatenate([values[np.isfinite(values)] for values in ratios.values()])
    low, high = finite.min(initial=1.0), 2.0 * finite.max(initial=5.0)
    for label, values in ratios.items():
        if np.isfinite(values).any():
            x = np.unique([low, *values[np.isfinite(values)], high])
            draw_line(ax, x, cumulative_share(values, x), styles[label], drawstyle="steps-post", markevery=0.3)
    format_log_axis(ax.xaxis, low, high, unit="plain")
    ax.set_ylim(-0.02, 1.03)
    ax.yaxis.set_major_formatter(lambda value, _: f"{100 * value:.0f} %")
