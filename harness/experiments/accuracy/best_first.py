"""Best-first search for the cheapest setting of a study that meets an error, or the most accurate one within a cost.

A method is a solver with an integrator; its settings are time steps and tolerances. Shorter steps and smaller
tolerances are assumed to cost more. A method's last cost is therefore a lower bound of those that follow. The method
with the smallest bound is measured next. The search omits

    smaller tolerances at a time step    once one meets the error, or smaller ones no longer change it
    the rest of a method                 once it costs more than SLOWER times the best that meets the error
    everything                           once the time for the search is used up

With an error of zero, all settings up to SLOWER times the best cost are candidates.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from heapq import heapify, heappop, heappush
from itertools import groupby
from math import inf
from sys import float_info
from time import monotonic
from typing import Any

from springbench.harness.config.accuracy_config import WorkSpec
from springbench.solvers.registry import SOLVERS

SLOWER = 1.5
"""Multiple of the best cost above which a method is given up; shorter steps may need fewer iterations each."""

LEAST_LIMIT = 0.2
"""Smallest time limit of a simulation [s], so that a short interruption does not exclude a candidate."""

UNCHANGED = 0.1
"""Relative change of the excess error between two tolerances, below which smaller tolerances are omitted."""

OUT_OF_TIME = "the time for the search was used up"


@dataclass(frozen=True, slots=True)
class SearchSummary:
    """Summary of a search.

    Attributes:
        measured: number of settings that were measured or known.
        settings: number of all settings.
        reasons: number of omitted settings by reason.
    """

    measured: int
    settings: int
    reasons: Mapping[str, int]

    @property
    def is_complete(self) -> bool:
        """Whether the search ended within its time."""
        return OUT_OF_TIME not in self.reasons

    def __str__(self) -> str:
        reasons = "".join(f"; {count} not: {reason}" for reason, count in self.reasons.items())
        return f"{self.measured} of {self.settings} settings measured{reasons}"


@dataclass(slots=True)
class _Method:
    """Settings of a method that remain to be measured.

    Attributes:
        grid: settings by time step, the longest first, and in each by tolerance, the largest first.
        errors: errors at the current time step.
        loosest: cost of the largest tolerance at the current time step.
        bound: lower bound of the costs that follow.
    """

    grid: list[list[WorkSpec]]
    errors: list[float] = field(default_factory=list[float])
    loosest: float = 0.0
    bound: float = 0.0

    @property
    def num_remaining(self) -> int:
        return sum(map(len, self.grid))

    def skip_to_next_step(self) -> int:
        """Proceed to the next time step, and return the number of omitted tolerances."""
        left = len(self.grid.pop(0))
        self.errors, self.bound = [], max(self.bound, self.loosest)
        return left

    def skip_all(self) -> int:
        """Give up the method, and return the number of omitted settings."""
        left = self.num_remaining
        self.grid = []
        return left


def search(
    work: Iterable[WorkSpec],
    error: float,
    best: float,
    measure: Callable[[WorkSpec], Mapping[str, Any]],
    search_time: float,
) -> SearchSummary:
    """Measure settings until no remaining one can be the cheapest that meets an error.

    Args:
        work: the settings.
        error: relative error to meet; 0 for the least within SLOWER times `best`.
        best: wall seconds per simulated second of the best known setting, infinite without one.
        measure: measures a setting within the time limit of its specification, and returns the row.
        search_time: wall time after which no simulation starts [s].
    """
    methods = _methods(work)
    settings, measured, reasons, end = (
        sum(one.num_remaining for one in methods),
        0,
        Counter[str](),
        monotonic() + search_time,
    )
    heap = [(0.0, number) for number in range(len(methods))]
    heapify(heap)
    while heap:
        bound, number = heappop(heap)
        one = methods[number]
        if bound > SLOWER * best:
            reasons[_slow(error)] += one.skip_all()
            continue
        if monotonic() > end:
            reasons[OUT_OF_TIME] += one.skip_all()
            continue
        spec = one.grid[0].pop(0)
        row = measure(_limited(spec, best))
        measured += 1
        found, cost = _outcome(spec, row)
        if found <= error:
            best = min(best, cost)
        if not one.errors:
            one.loosest = cost if cost < inf else one.bound
        late = row["status"] == "time-limit" or SLOWER * best < cost < inf
        if row["status"] == "unsupported":
            reasons["the solver does not support it"] += one.skip_all()
        elif late and not one.errors:
            reasons[_slow(error)] += one.skip_all()
        elif late:
            reasons[_slow(error)] += one.skip_to_next_step()
        elif found <= error:
            reasons["a larger tolerance meets the error"] += one.skip_to_next_step()
        elif one.errors and abs(one.errors[-1] - found) <= UNCHANGED * (found - error) < inf:
            reasons["a smaller tolerance does not change the error"] += one.skip_to_next_step()
        elif not one.grid[0]:
            one.skip_to_next_step()
        else:
            one.errors.append(found)
            one.bound = max(one.bound, cost) if cost < inf else one.bound
        if one.num_remaining:
            heappush(heap, (one.bound, number))
    return SearchSummary(measured, settings, {reason: count for reason, count in reasons.items() if count})


def compute_setting_cost(spec: WorkSpec, row: Mapping[str, Any]) -> float:
    """Return the wall time per simulated second of a simulation's row, on an otherwise idle machine.

    Where other programs interrupted a single thread of ours, its processor time is what it takes alone.
    """
    wall, cpu = row["seconds_per_simulated_second"], row.get("cpu_seconds")
    if cpu and row.get("preempted") and spec.measurement.threads == 1 and spec.solver.name in SOLVERS:
        return min(wall, cpu / spec.t_end)
    return wall


def is_measured(row: Mapping[str, Any]) -> bool:
    """Return whether a simulation ended well: its error is known, or too small for the reference."""
    has_time = row.get("seconds_per_simulated_second") is not None
    return row["status"] == "ok" or (row["status"] == "uncertified" and has_time)


def _slow(error: float) -> str:
    if not error:
        return "they or their faster neighbours take longer than the budget allows"
    return f"they or their faster neighbours take {SLOWER:g} times as long as the best within {error:g}, or too long"


def _outcome(spec: WorkSpec, row: Mapping[str, Any]) -> tuple[float, float]:
    """Return the error and the cost of a row, infinite if there are none; an unmeasurably small error is almost 0."""
    cost = compute_setting_cost(spec, row) if is_measured(row) else inf
    return row["error"] if row["status"] == "ok" else inf if cost == inf else float_info.min, cost


def _limited(spec: WorkSpec, best: float) -> WorkSpec:
    """Return the specification with a time limit of SLOWER times the best cost."""
    limit = max(LEAST_LIMIT, SLOWER * best * spec.t_end)
    return replace(spec, measurement=replace(spec.measurement, time_limit=min(spec.measurement.time_limit, limit)))


def _methods(work: Iterable[WorkSpec]) -> list[_Method]:
    """Group the settings by everything except time step and tolerance."""
    by_method: dict[str, list[WorkSpec]] = {}
    for spec in work:
        others = {name: value for name, value in spec.options.items() if name != "rtol"}
        by_method.setdefault(repr((spec.solver, spec.case.integrator, others)), []).append(spec)
    found = list[_Method]()
    for specs in by_method.values():
        specs.sort(key=lambda spec: (-spec.case.scene.time_step, -(spec.options["rtol"] or 0.0)))
        found.append(_Method([list(same) for _, same in groupby(specs, lambda spec: spec.case.scene.time_step)]))
    return found
