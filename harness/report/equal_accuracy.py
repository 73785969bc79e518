"""Comparison of run times at equal accuracy, within a sweep.

Two runs are compared if they solve the same steps on the same machine and the same error is known for both: the largest
distance from the reference motion where the runs were verified, otherwise the largest residual of a step. A run of
unknown error never counts as equally accurate.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from math import inf, isfinite
from typing import NamedTuple

from springbench.harness.report.number_format import format_factor, format_quantity
from springbench.harness.report.timing_table import ROUNDOFF_RATIO, RunTimes
from springbench.harness.results.quantities import compute_slowdown

EQUAL_ERROR_FACTOR = 10.0
"""Errors within this factor of the lowest count as equal."""

_MAX_LISTED = 4
"""Maximum number of runs that a sentence lists."""


class AccuracyComparison(NamedTuple):
    """Runs of one scene, size and machine that solve the same steps.

    Attributes:
        group_label: scene and size.
        error_label: name of the error.
        lowest_error: smallest error of these runs.
        equal_runs: runs within a factor EQUAL_ERROR_FACTOR of the lowest error or of round-off, the fastest first.
        worse_runs: runs beyond that, each with its error over the lowest error or round-off, whichever is larger.
        unknown_runs: runs whose error is unknown.
    """

    group_label: str
    error_label: str
    lowest_error: float
    equal_runs: list[RunTimes]
    worse_runs: list[tuple[RunTimes, float]]
    unknown_runs: list[RunTimes]


def compare_runs(timed_runs: Iterable[RunTimes]) -> Iterator[AccuracyComparison]:
    """Yield one comparison for each scene that has several timed runs.

    Of the groups of runs that solve the same steps, the one with the most runs of known error is chosen, then the
    largest size.
    """
    scenes: dict[str, dict[tuple[object, ...], list[RunTimes]]] = defaultdict(lambda: defaultdict(list))
    for run in timed_runs:
        if run.status == "ok" and run.step and run.error_requested is None:
            same = run.size, run.machine_id, run.node_id, run.integrator, run.time_step, run.frames
            scenes[run.scene][same].append(run)
    for groups in scenes.values():
        several = [_compare_group(group) for group in groups.values() if len(group) > 1]
        if several:
            yield max(several, key=_comparison_rank)


def describe_comparison(comparison: AccuracyComparison, names: Mapping[str, str]) -> Iterator[tuple[str, list[str]]]:
    """Describe a comparison in sentences, each with the ids of its runs.

    Args:
        comparison: comparison to describe.
        names: labels of the runs by their ids.
    """
    not_compared = [
        *(f"{names[run.run_id]} (its error is {_format_factor(by)} as large)" for run, by in comparison.worse_runs),
        *(f"{names[run.run_id]} (its error is unknown)" for run in comparison.unknown_runs),
    ]
    ids = [
        run.run_id
        for run in (*comparison.equal_runs, *(run for run, _ in comparison.worse_runs), *comparison.unknown_runs)
    ]
    if not comparison.equal_runs:
        yield f"{comparison.group_label}: times are not compared, for no run's error is known.", ids[:_MAX_LISTED]
        return
    first, *others = comparison.equal_runs
    error = f"{comparison.error_label} {comparison.lowest_error:.1e}"
    if others:
        slower = [f"{names[run.run_id]} {format_quantity(_compute_time_ratio(run, first))} times" for run in others]
        words = f"fastest at equal accuracy is {names[first.run_id]}, {format_quantity(first.step or 0.0)} ms a step"
        yield (
            f"{comparison.group_label}: {words}; {_join_words(slower)} as long ({error} to "
            f"{EQUAL_ERROR_FACTOR:g} times that, or round-off).",
            ids[:_MAX_LISTED],
        )
    else:
        yield (
            f"{comparison.group_label}: most accurate is {names[first.run_id]}, "
            f"{error}; no other run is known to be as "
            "accurate, so times are not compared.",
            [first.run_id],
        )
    if not_compared:
        yield f"{comparison.group_label}: not compared with it: {_join_words(not_compared)}.", ids[-_MAX_LISTED:]


def _format_factor(by: float) -> str:
    return f"{format_factor(by)} times" if isfinite(by) else "infinitely many times"


def _join_words(words: list[str]) -> str:
    more = [f"and {len(words) - _MAX_LISTED} more"] if len(words) > _MAX_LISTED else []
    return ", ".join([*words[:_MAX_LISTED], *more])


def _compute_time_ratio(run: RunTimes, other: RunTimes) -> float:
    return compute_slowdown(run.step or 0.0, other.step or 1.0)


def _compare_group(group: list[RunTimes]) -> AccuracyComparison:
    distances = {run.run_id: run.reference_distance for run in group if _is_known_error(run.reference_distance)}
    solved = {run.run_id: run.worst_residual for run in group if _is_known_error(run.worst_residual)}
    of_motion = len(distances) >= max(len(solved), 1)
    what, known = ("largest distance from the reference", distances) if of_motion else ("largest residual", solved)
    errors = {run_id: error for run_id, error in known.items() if error is not None}
    floors = [run.roundoff_residual for run in group if run.run_id in errors and _is_known_error(run.roundoff_residual)]
    floor = ROUNDOFF_RATIO if of_motion else min((f for f in floors if f is not None), default=0.0)
    lowest = min(errors.values(), default=0.0)
    limit = EQUAL_ERROR_FACTOR * max(lowest, floor)
    ordered = sorted(group, key=lambda run: run.step or 0.0)
    size = f" {group[0].size}" if group[0].size else ""
    return AccuracyComparison(
        f"{group[0].scene}{size}",
        what,
        lowest,
        [run for run in ordered if errors.get(run.run_id, limit + 1.0) <= limit],
        [
            (run, EQUAL_ERROR_FACTOR * errors[run.run_id] / limit if limit else inf)
            for run in ordered
            if errors.get(run.run_id, 0.0) > limit
        ],
        [run for run in ordered if run.run_id not in errors],
    )


def _is_known_error(error: float | None) -> bool:
    return error is not None and isfinite(error) and error >= 0.0


def _comparison_rank(comparison: AccuracyComparison) -> tuple[int, int]:
    runs = [*comparison.equal_runs, *(run for run, _ in comparison.worse_runs)]
    return len(runs), (runs or comparison.unknown_runs)[0].size
