"""Times of methods to errors, by round.

`springbench reproduce` compares ratios of these times between machines. For a step snapshot, it is the time until the
energy gap is at most the error (`springbench.harness.report.accuracy.time_to_accuracy`). For simulations, it is the
time of the fastest setting of a solver whose error is at most the requested one
(`springbench.harness.report.accuracy.engine_comparison`).
"""

from __future__ import annotations

from statistics import median
from typing import Any

from springbench.harness.report.accuracy.accuracy_data import AccuracyData, WorkPoint
from springbench.harness.report.accuracy.engine_comparison import ERROR_TARGETS
from springbench.harness.report.accuracy.time_to_accuracy import (
    GAP_TARGETS,
    find_time_to_accuracy,
    format_gap,
    is_solvable,
)
from springbench.harness.results.time_ratios import MethodTimes


def list_curve_times(data: AccuracyData) -> list[MethodTimes]:
    """List the times of the solvers to each of `GAP_TARGETS`, for each step snapshot."""
    found: list[MethodTimes] = []
    for curve in data.curves:
        step = curve.problem
        for target in GAP_TARGETS:
            reached = find_time_to_accuracy(curve, target) if is_solvable(step, target) else None
            if reached and reached.iteration > 0 and min(reached.rounds) > 0.0:
                where = step.scene, step.size, step.snapshot, step.integrator, curve.initial_guess
                task = (*where, f"to {format_gap(target)}")
                method = curve.solver, curve.parameters, curve.threads
                found.append(MethodTimes(task, method, dict(enumerate(reached.rounds)), False, curve.is_preempted))
    return found


def list_simulation_times(
    published: AccuracyData, repeated: AccuracyData
) -> tuple[list[MethodTimes], list[MethodTimes]]:
    """List the times of the solvers to each of `ERROR_TARGETS`, for each simulation.

    Only settings that both studies measured are compared. The published error of a setting determines which targets it
    reaches in both; whether the errors agree is compared separately.

    Args:
        published: data of the published study.
        repeated: data of its repetition.

    Returns:
        Times by round of the published and of the repeated study, in the same order.
    """
    repeated_points, published_points = (
        {_build_setting(work): work for work in side.work_points} for side in (repeated, published)
    )
    settings = [
        key
        for key in published_points
        if key in repeated_points and published_points[key].round_seconds and repeated_points[key].round_seconds
    ]
    found: tuple[list[MethodTimes], list[MethodTimes]] = ([], [])
    for target in ERROR_TARGETS:
        tasks: dict[tuple[Any, ...], list[tuple[Any, ...]]] = {}
        for key in settings:
            work = published_points[key]
            if work.error <= target:
                task = work.scene, work.size, work.t_end, f"to {format_gap(target)}"
                tasks.setdefault((*task, work.solver), []).append(key)
        for (*task, solver), keys in tasks.items():
            for listed, works in zip(found, (published_points, repeated_points), strict=True):
                best = min((works[key] for key in keys), key=lambda work: median(work.round_seconds))
                rounds = dict(enumerate(best.round_seconds))
                listed.append(MethodTimes(tuple(task), (solver,), rounds, False, best.is_preempted))
    return found


def _build_setting(work: WorkPoint) -> tuple[Any, ...]:
    how = work.solver, work.parameters, work.integrator, work.time_step, work.initial_guess
    return (work.scene, work.size, work.t_end, *how, work.max_iterations, work.residual_rtol)
