"""Reproduction of figures 2 and 3 of Liu et al. 2013.

Own curves are drawn over the paper's, and their differences are listed. The paper's values are read from its figures
and text: the relative error (g - g*)/(g0 - g*), g0 at the inertial target, of the curtain (1 m x 1 m, 1 kg, dt = 1/30
s). Figure 2 is one step of the 81 x 81 curtain on one core of 2012; figure 3 has means over 50 frames. The paper does
not state pins, damping and frames.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from springbench.harness.report.accuracy.accuracy_data import (
    LONG_CURVE_ITERATIONS,
    AccuracyData,
    ConvergenceCurve,
    SnapshotProblem,
)
from springbench.harness.report.accuracy.time_to_accuracy import FATAL_STATUSES
from springbench.solvers.iteration.solver_info import LOCAL_GLOBAL_FAMILY

LIU2013_FIGURE_2 = {1: (3.61e-1, 5.4e-3), 10: (1.96e-1, 50.6e-3), 100: (4.02e-2, 0.501), 1000: (2.98e-4, 5.05)}
"""Iterations of local-global: relative error, seconds."""

LIU2013_FIGURE_2_NEWTON = ((1.45, 4.1e-4), (1.75, 4.6e-6))
"""Newton with preconditioned conjugate gradients: seconds, relative error."""

LIU2013_ITERATIONS = (1, 10, 50, 100)

LIU2013_FIGURE_3 = {
    (81, 1200): (0.16, 0.048, 0.0206, 0.0130),
    (41, 600): (0.123, 0.038, 0.0125, 0.0069),
    (21, 300): (0.061, 0.016, 0.0032, 0.00104),
    (11, 150): (0.035, 0.0039, 6.7e-5, 1.3e-5),
    (21, 600): (0.114, 0.033, 0.0062, 0.00195),
    (21, 1200): (0.237, 0.100, 0.035, 0.0156),
    (21, 2400): (0.26, 0.132, 0.062, 0.035),
}
"""Vertices per side and stiffness [N/m]: mean relative error after each of LIU2013_ITERATIONS of local-global."""

MAX_ERROR_RATIO = 2.0
"""Ratio to the paper's error beyond which a sentence reports the difference."""


class PaperComparison(NamedTuple):
    """One point of a curve: own error, the paper's error, and averaged frames."""

    curve: str
    iterations: int
    own_error: float
    published_error: float
    frames: int

    @property
    def error_ratio(self) -> float:
        """The own error divided by the paper's."""
        return self.own_error / self.published_error

    @property
    def description(self) -> str:
        """The comparison in words."""
        when = f"after {self.iterations} iteration{'s' if self.iterations > 1 else ''}"
        over = f"over {self.frames} frame{'s' if self.frames > 1 else ''}"
        values = (
            f"ours {self.own_error:.2g} {over}, the paper's {self.published_error:.2g}, ratio {self.error_ratio:.2g}"
        )
        return f"{self.curve}, {when}: {values}"


def curtain_stiffness(problem: SnapshotProblem) -> float:
    """Return the springs' stiffness [N/m] of the paper's curtain, whose vertices share 1 kg."""
    return problem.stiffness_ratio / (problem.vertices * problem.time_step**2)


def compare_with_paper(table: AccuracyData) -> list[PaperComparison]:
    """Return all points of the paper for which the rows have a counterpart."""
    found: list[PaperComparison] = []
    for curve in select_long_curves(table)[:1]:
        for iterations, (theirs, _) in LIU2013_FIGURE_2.items():
            ours = gap_at_iteration(curve, iterations)
            if np.isfinite(ours):
                found.append(PaperComparison("figure 2", iterations, ours, theirs, 1))
    for (side, k), values in LIU2013_FIGURE_3.items():
        curves = _select_curtain_curves(table, side, k)
        for iterations, theirs in zip(LIU2013_ITERATIONS, values, strict=True):
            errors = [gap_at_iteration(curve, iterations) for curve in curves]
            known = [error for error in errors if np.isfinite(error)]
            if known:
                name = f"figure 3, {side} × {side}, k = {k}"
                found.append(PaperComparison(name, iterations, float(np.mean(known)), theirs, len(known)))
    return found


def gap_at_iteration(curve: ConvergenceCurve, iterations: int) -> float:
    """Return the gap after n iterations, at least round-off.

    A curve that converged before n iterations counts with its last gap.

    Args:
        curve: convergence of a solver.
        iterations: n; an iterate that was not recorded has no known gap.

    Returns:
        The gap; nan if it is unknown or the minimum is not certified.
    """
    if curve.problem.uncertified_reason or not len(curve.iterations) or curve.status in FATAL_STATUSES:
        return np.nan
    k = int(np.searchsorted(curve.iterations, iterations, side="right")) - 1
    ended = curve.iterations[-1] < iterations and curve.status == "ok"
    exact = curve.iterations[k] == iterations or ended
    return max(float(curve.gap[k]), curve.problem.roundoff_gap) if exact else np.nan


def select_own_curves(table: AccuracyData) -> Iterator[ConvergenceCurve]:
    """Select the paper's local-global by the fastest measured backend, from the paper's initial guess."""
    paper = [c for c in table.curves if c.problem.is_liu2013 and c.initial_guess == "inertial"]
    theirs = [c for c in paper if c.family == LOCAL_GLOBAL_FAMILY]
    solver = min(theirs, key=_iteration_seconds).solver if theirs else None
    return (curve for curve in paper if curve.solver == solver)


def _iteration_seconds(curve: ConvergenceCurve) -> float:
    """Return the time of one iteration per vertex [s].

    Times are per vertex because sizes differ; infinite if nothing was timed.
    """
    done = curve.iterations.max(initial=0.0) * curve.problem.vertices
    seconds = float(np.median(curve.seconds[:, -1])) if len(curve.iterations) else np.nan
    return seconds / done if done and np.isfinite(seconds) else np.inf


def select_long_curves(table: AccuracyData) -> list[ConvergenceCurve]:
    """Select the own curves of the step of figure 2."""
    return [
        c
        for c in select_own_curves(table)
        if c.problem.vertices == 81**2 and c.iterations.max(initial=0.0) >= LONG_CURVE_ITERATIONS
    ]


def _select_curtain_curves(table: AccuracyData, side: int, k: float) -> list[ConvergenceCurve]:
    """Select the curves of one curtain, with a stiffness tolerance of 10 %.

    The tolerance allows for different counts of pins, and still separates all stiffnesses.
    """
    return [
        c
        for c in select_own_curves(table)
        if c.problem.vertices == side**2 and abs(curtain_stiffness(c.problem) / k - 1) < 0.1
    ]
