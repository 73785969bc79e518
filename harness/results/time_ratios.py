"""Ratios of times to a reference method on the same task, comparable between machines.

A ratio has an interval. For runs it is the 95 % interval over the steps (`bootstrap_statistics.estimate_slowdown`), for
accuracy studies the range over the rounds. On another machine the ratio may exceed the interval by
OTHER_MACHINE_FACTOR, because vector units and caches differ.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from statistics import median
from typing import Any, NamedTuple

from springbench.harness.results import bootstrap_statistics
from springbench.harness.results.published_set import RUN_KEYS

OTHER_MACHINE_FACTOR = 2.0
"""Factor by which a ratio may differ on another machine; archives are verified with it too."""

REFERENCE_SOLVERS = ("numba", "sparse", "hybrid", "newton")
"""Solvers that serve as reference, in order of preference; without these, the first method by name does."""

MethodKey = tuple[Any, ...]


class MethodTimes(NamedTuple):
    """Times of a method on a task.

    Attributes:
        task: scene and size; in accuracy studies also what is solved, and to which error.
        method: what differs between the methods of a task; the solver is first.
        seconds: times by step or by round [s], positive.
        is_paired_by_step: whether the times are those of steps; otherwise they are those of rounds.
        is_preempted: whether the load of the machine delayed them.
    """

    task: tuple[Any, ...]
    method: MethodKey
    seconds: Mapping[int, float]
    is_paired_by_step: bool = True
    is_preempted: bool = False


class MethodTimeRatio(NamedTuple):
    """Time of a method over that of the reference method of the same task.

    Attributes:
        task, method: as in `MethodTimes`.
        reference: the reference method.
        ratio, low, high: the ratio and its interval, measured on one machine.
        is_preempted: whether the load of the machine delayed one of the two.
    """

    task: tuple[Any, ...]
    method: MethodKey
    reference: MethodKey
    ratio: float
    low: float
    high: float
    is_preempted: bool = False

    @property
    def accepted_interval(self) -> tuple[float, float]:
        """Interval in which the ratio of another machine must lie."""
        return self.low / OTHER_MACHINE_FACTOR, self.high * OTHER_MACHINE_FACTOR

    @property
    def title(self) -> str:
        """Task, solver and reference solver, for messages."""
        return f"{' '.join(str(part) for part in self.task if part)}: {self.method[0]} over {self.reference[0]}"


MAX_PREEMPTED_SHARE = 0.1
"""Share of interrupted steps of a run, or of interrupted times of a study, above which the machine was busy."""


def list_step_times(rows: Iterable[Mapping[str, Any]]) -> list[MethodTimes]:
    """List the shortest times of all steps, for each scene, size and method.

    Args:
        rows: rows of timed runs.
    """
    steps: dict[tuple[tuple[Any, ...], MethodKey], dict[int, list[Mapping[str, Any]]]] = {}
    for row in rows:
        seconds = row.get("seconds")
        if row["phase"] == "step" and row["frame"] is not None and seconds is not None and 0.0 < seconds < math.inf:
            key = (row["scene"], row["size"]), tuple(row.get(name) for name in RUN_KEYS[2:])
            steps.setdefault(key, {}).setdefault(row["frame"], []).append(row)
    found: list[MethodTimes] = []
    for (task, method), frames in steps.items():
        seconds = {frame: min(row["seconds"] for row in rounds) for frame, rounds in frames.items()}
        preempted = [bool(row.get("preempted")) for rounds in frames.values() for row in rounds]
        found.append(MethodTimes(task, method, seconds, True, sum(preempted) > MAX_PREEMPTED_SHARE * len(preempted)))
    return found


def compute_time_ratios(times: Iterable[MethodTimes]) -> list[MethodTimeRatio]:
    """Compute the time ratio of each method to the reference method of its task."""
    tasks: dict[tuple[Any, ...], list[MethodTimes]] = {}
    for one in times:
        tasks.setdefault(one.task, []).append(one)
    found: list[MethodTimeRatio] = []
    for methods in tasks.values():
        reference = _choose_reference(methods)
        found += [
            _build_ratio(one, reference)
            for one in methods
            if one is not reference and one.seconds.keys() & reference.seconds.keys()
        ]
    return found


def _choose_reference(methods: Sequence[MethodTimes]) -> MethodTimes:
    for solver in REFERENCE_SOLVERS:
        if own := [one for one in methods if one.method[0] == solver]:
            return min(own, key=lambda one: str(one.method))
    return min(methods, key=lambda one: str(one.method))


def _build_ratio(ours: MethodTimes, theirs: MethodTimes) -> MethodTimeRatio:
    common = ours.seconds.keys() & theirs.seconds.keys()
    ratios = [ours.seconds[k] / theirs.seconds[k] for k in common]
    if len(common) < 2:
        middle = median(ours.seconds.values()) / median(theirs.seconds.values())
        found = bootstrap_statistics.ConfidenceInterval(middle, middle, middle)
    elif ours.is_paired_by_step:
        found = bootstrap_statistics.estimate_slowdown(ours.seconds, theirs.seconds)
    else:
        found = bootstrap_statistics.ConfidenceInterval(median(ratios), min(ratios), max(ratios))
    is_preempted = ours.is_preempted or theirs.is_preempted
    return MethodTimeRatio(ours.task, ours.method, theirs.method, *found, is_preempted)
