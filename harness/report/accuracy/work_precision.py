"""Error of simulations against wall time: Pareto front, default and cheapest settings."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from springbench.harness.report.accuracy.accuracy_data import WorkPoint
from springbench.harness.report.accuracy.time_to_accuracy import format_duration
from springbench.harness.report.number_format import format_quantity
from springbench.solvers.iteration.solver_info import LOCAL_GLOBAL_FAMILY

ERROR_TARGETS = (0.1, 0.03, 0.01, 0.003, 0.001)
"""Errors at which the Pareto front is described in words."""


def is_default_setting(work: WorkPoint) -> bool:
    """Return whether this is the most common setting.

    It is implicit Euler at 1/30 s with 50 iterations of local-global.
    """
    same_method = work.family == LOCAL_GLOBAL_FAMILY and work.integrator == "implicit-euler"
    return (
        same_method and work.residual_rtol is None and work.max_iterations == 50 and abs(30 * work.time_step - 1) < 1e-9
    )


def find_default_setting(works: Iterable[WorkPoint]) -> WorkPoint | None:
    """Find the most common setting among these, by the fastest of its backends."""
    return min(
        (w for w in works if is_default_setting(w) and is_complete(w)),
        key=lambda w: w.seconds_per_simulated_second,
        default=None,
    )


def find_pareto_front(works: Iterable[WorkPoint]) -> list[WorkPoint]:
    """Return the Pareto front in time and error, the cheapest first."""
    front: list[WorkPoint] = []
    for work in sorted((w for w in works if is_complete(w)), key=lambda w: (w.seconds_per_simulated_second, w.error)):
        if not front or work.error < front[-1].error:
            front.append(work)
    return front


def describe_cheapest_settings(works: Sequence[WorkPoint]) -> list[str]:
    """Describe the cheapest setting for each error, compared with the default setting's method."""
    base = find_default_setting(works)
    words: list[str] = []
    if base:
        words.append(
            f"the default ({base.setting_label}) has an error of {100 * base.error:.2g} % "
            f"for {format_duration(base.seconds_per_simulated_second)} a simulated second"
        )
    for error in ERROR_TARGETS:
        best = next((work for work in find_pareto_front(works) if work.error <= error), None)
        if best:
            euler = min(
                (w for w in works if is_same_method(w, base) and is_complete(w) and w.error <= error),
                key=lambda w: w.seconds_per_simulated_second,
                default=None,
            )
            against = (
                f", 1/{format_quantity(euler.seconds_per_simulated_second / best.seconds_per_simulated_second)} "
                "of what the default's method needs"
                if euler
                else ""
            )
            words.append(
                f"{100 * error:g} %: {best.setting_label}: {format_duration(best.seconds_per_simulated_second)} "
                f"a simulated second{against}"
            )
    return words


def is_same_method(work: WorkPoint, base: WorkPoint | None) -> bool:
    """Return whether a simulation differs from the default only in the time step.

    Args:
        work: simulation.
        base: simulation with the default setting; None equals no simulation.
    """
    return base is not None and (work.label, work.integrator, work.residual_rtol, work.max_iterations) == (
        base.label,
        base.integrator,
        base.residual_rtol,
        base.max_iterations,
    )


def is_complete(work: WorkPoint) -> bool:
    """Return whether a simulation succeeded, with an error and a time that can be drawn."""
    return work.status == "ok" and 0.0 < work.error < np.inf and 0.0 < work.seconds_per_simulated_second < np.inf
