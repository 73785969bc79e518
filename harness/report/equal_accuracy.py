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

from harness.base.quantities import times_as_long
from harness.report.page import factor, quantity
from harness.report.timing_table import ROUND_OFF, RunTimes

SAME = 10.0
"""Errors within this factor of the lowest count as equal."""

_LISTED = 4
"""Maximum number of runs that a sentence lists."""


class Comparison(NamedTuple):
    """Runs of one scene, size and machine that solve the same steps.

    Attributes:
        where: scene and size.
        what: name of the error.
        lowest: smallest error of these runs.
        equal: runs within a factor SAME of the lowest error or of round-off, the fastest first.
        worse: runs beyond that, each with its error divided by the lowest.
        unknown: runs whose error is unknown.
    """

    where: str
    what: str
    lowest: float
    equal: list[RunTimes]
    worse: list[tuple[RunTimes, float]]
    unknown: list[RunTimes]


def comparisons(found: Iterable[RunTimes]) -> Iterator[Comparison]:
    """Yield one comparison for each scene that has several timed runs.

    Of the groups of runs that solve the same steps, the one with the most runs of known error is chosen, then the
    largest size.
    """
    scenes: dict[str, dict[tuple[object, ...], list[RunTimes]]] = defaultdict(lambda: defaultdict(list))
    for run in found:
        if run.status == "ok" and run.step and run.asked is None:
            same = run.size, run.machine, run.node, run.integrator, run.time_step, run.frames
            scenes[run.scene][same].append(run)
    for groups in scenes.values():
        several = [_compared(group) for group in groups.values() if len(group) > 1]
        if several:
            yield max(several, key=_worth)


def sentences(compared: Comparison, names: Mapping[str, str]) -> Iterator[tuple[str, list[str]]]:
    """Describe a comparison in sentences, each with the ids of its runs.

    Args:
        compared: comparison to describe.
        names: labels of the runs by their ids.
    """
    not_compared = [
        *(f"{names[run.run_id]} (its error is {_times(by)} as large)" for run, by in compared.worse),
        *(f"{names[run.run_id]} (its error is unknown)" for run in compared.unknown),
    ]
    ids = [run.run_id for run in (*compared.equal, *(run for run, _ in compared.worse), *compared.unknown)]
    if not compared.equal:
        yield f"{compared.where}: times are not compared, for no run's error is known.", ids[:_LISTED]
        return
    first, *others = compared.equal
    error = f"{compared.what} {compared.lowest:.1e}"
    if others:
        slower = [f"{names[run.run_id]} {quantity(_ratio(run, first))} times" for run in others]
        words = f"fastest at equal accuracy is {names[first.run_id]}, {quantity(first.step or 0.0)} ms a step"
        yield (
            f"{compared.where}: {words}; {_listed(slower)} as long ({error} to {SAME:g} times that, or round-off).",
            ids[:_LISTED],
        )
    else:
        yield (
            f"{compared.where}: most accurate is {names[first.run_id]}, {error}; no other run is known to be as "
            "accurate, so times are not compared.",
            [first.run_id],
        )
    if not_compared:
        yield f"{compared.where}: not compared with it: {_listed(not_compared)}.", ids[-_LISTED:]


def _times(by: float) -> str:
    return f"{factor(by)} times" if isfinite(by) else "infinitely many times"


def _listed(words: list[str]) -> str:
    more = [f"and {len(words) - _LISTED} more"] if len(words) > _LISTED else []
    return ", ".join([*words[:_LISTED], *more])


def _ratio(run: RunTimes, other: RunTimes) -> float:
    return times_as_long(run.step or 0.0, other.step or 1.0)


def _compared(group: list[RunTimes]) -> Comparison:
    judged = {run.run_id: run.distance for run in group if _known(run.distance)}
    solved = {run.run_id: run.worst_residual for run in group if _known(run.worst_residual)}
    of_motion = len(judged) >= max(len(solved), 1)
    what, known = ("largest distance from the reference", judged) if of_motion else ("largest residual", solved)
    errors = {run_id: error for run_id, error in known.items() if error is not None}
    floors = [run.round_off for run in group if run.run_id in errors and _known(run.round_off)]
    floor = ROUND_OFF if of_motion else min((f for f in floors if f is not None), default=0.0)
    lowest = min(errors.values(), default=0.0)
    limit = SAME * max(lowest, floor)
    ordered = sorted(group, key=lambda run: run.step or 0.0)
    size = f" {group[0].size}" if group[0].size else ""
    return Comparison(
        f"{group[0].scene}{size}",
        what,
        lowest,
        [run for run in ordered if errors.get(run.run_id, limit + 1.0) <= limit],
        [
            (run, SAME * errors[run.run_id] / limit if limit else inf)
            for run in ordered
            if errors.get(run.run_id, 0.0) > limit
        ],
        [run for run in ordered if run.run_id not in errors],
    )


def _known(error: float | None) -> bool:
    return error is not None and isfinite(error) and error >= 0.0


def _worth(compared: Comparison) -> tuple[int, int]:
    runs = [*compared.equal, *(run for run, _ in compared.worse)]
    return len(runs), (runs or compared.unknown)[0].size
