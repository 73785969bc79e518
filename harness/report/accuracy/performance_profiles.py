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
from collections.abc import Iterable, Sequence
from math import inf

import numpy as np
from springbench.harness.report.accuracy.accuracy_data import (
    AccuracyData,
    ConvergenceCurve,
    FloatArray,
)
from springbench.harness.report.accuracy.time_to_accuracy import (
    compute_amortised_seconds,
    group_by_start,
    is_contested,
    is_solvable,
)
from springbench.solvers.iteration.solver_info import LOCAL_GLOBAL_FAMILY


def compute_performance_ratios(table: AccuracyData, target: float) -> dict[str, FloatArray]:
    """Return times to the target divided by the smallest of all solvers, by label.

    Args:
        table: data of an accuracy measurement.
        target: energy gap.

    Returns:
        Ratios (problems,); infinite where the gap is not reached.
    """
    found = group_solvable_curves(table, target)
    return _compute_ratios(
        table, found, target, [min(compute_amortised_seconds(curve, target) for curve in curves) for curves in found]
    )


def compute_data_profile_ratios(table: AccuracyData, target: float) -> dict[str, FloatArray]:
    """Return times to the target divided by that of one baseline iteration, by label.

    Args:
        table: data of an accuracy measurement.
        target: energy gap.

    Returns:
        Ratios (problems,), for the problems where the baseline was measured.
    """
    units = [
        (curves, compute_median_iteration_seconds(curves, find_baseline_solver(table)))
        for curves in group_solvable_curves(table, target)
    ]
    known = [(curves, unit) for curves, unit in units if np.isfinite(unit)]
    return _compute_ratios(table, [curves for curves, _ in known], target, [unit for _, unit in known])


def _compute_ratios(
    table: AccuracyData, curve_groups: Sequence[list[ConvergenceCurve]], target: float, units: Sequence[float]
) -> dict[str, FloatArray]:
    times = [{curve.label: compute_amortised_seconds(curve, target) for curve in curves} for curves in curve_groups]
    missed = count_partial_coverage(table)
    return {
        label: np.array([each.get(label, inf) / unit for each, unit in zip(times, units, strict=True)], float)
        for label in dict.fromkeys(curve.label for curve in table.curves)
        if label not in missed
    }


def count_partial_coverage(table: AccuracyData) -> dict[str, int]:
    """Count the problems, by label, of solvers measured on fewer problems than others."""
    tried = Counter(label for curves in group_by_start(table).values() for label in {curve.label for curve in curves})
    return {label: count for label, count in sorted(tried.items()) if count < max(tried.values())}


def find_baseline_solver(table: AccuracyData) -> str:
    """Return the backend of the plain local-global iteration that data profiles use as the unit.

    Of the backends measured on the most problems, it is the last one in alphabetical order; "" if none was measured.
    """
    tried = Counter(curve.solver for curve in table.curves if curve.family == LOCAL_GLOBAL_FAMILY)
    return max(tried, key=lambda name: (tried[name], name), default="")


def describe_omitted_solvers(table: AccuracyData) -> list[str]:
    """Describe the solvers that profiles omit, in at most one sentence."""
    count = len(group_by_start(table))
    names = ", ".join(f"{label} (on {tried} of {count})" for label, tried in count_partial_coverage(table).items())
    return [f"Not shown, as not tried on every problem: {names}."] if names else []


def compute_cumulative_share(values: FloatArray, at: FloatArray) -> FloatArray:
    """Return the cumulative share of values at given limits.

    Args:
        values: values (k,), in any order; infinite ones count in k, but are within no finite limit.
        at: limits (m,).

    Returns:
        The share (m,) of the values that is at most each limit.
    """
    return np.searchsorted(np.sort(values), at, side="right") / len(values)


def group_solvable_curves(table: AccuracyData, target: float) -> list[list[ConvergenceCurve]]:
    """Group the curves of the problems for which an accuracy is meaningful.

    In these, the minimum is certified, and some solver reaches the accuracy, but no initial guess does.

    Args:
        table: data of an accuracy measurement.
        target: accuracy, an energy gap.

    Returns:
        Lists of curves with the same problem and initial guess.
    """
    return [r for r in group_by_start(table).values() if is_solvable(r[0].problem, target) and is_contested(r, target)]


def compute_median_iteration_seconds(curves: Iterable[ConvergenceCurve], solver: str) -> float:
    """Return the median time of one iteration of a solver on a problem [s].

    Args:
        curves: curves with the same problem and initial guess; the first timed one of the solver counts.
        solver: name of the solver.

    Returns:
        The median over the rounds; nan if the solver was not measured or not timed.
    """
    for curve in curves:
        if curve.solver == solver and len(curve.iterations) > 1 and np.isfinite(curve.seconds).all():
            spans = curve.seconds[:, -1] - curve.seconds[:, 0]
            return float(np.median(spans)) / (curve.iterations[-1] - curve.iterations[0])
    return np.nan
