"""Best-first search of a study's settings.

It finds the cheapest setting that meets an error, or the most accurate one within a cost. A method is a solver with an
integrator; its settings are a grid of time steps and tolerances. Shorter steps and smaller tolerances are assumed to
cost more. A method's last cost is therefore a lower bound of those that follow, by which
`springbench.harness.experiments.best_first_search` orders the methods. The search omits

    smaller tolerances at a time step    once one meets the error, or smaller ones no longer change it
    the rest of a method                 once it costs more than SLOWER times the best that meets the error
    everything                           once the time for the search is used up

With an error of zero, all settings up to SLOWER times the best cost are candidates.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from itertools import groupby
from math import inf
from sys import float_info
from typing import Any

from springbench.harness.config.accuracy_config import WorkSpec
from springbench.harness.experiments.best_first_search import (
    GiveUpRule,
    SearchSummary,
    SettingProposal,
    SettingProposals,
    TrialOutcome,
    search_best_first,
)
from springbench.solvers.registry import SOLVERS

SLOWER = 1.5
"""Multiple of the best cost above which a method is given up; shorter steps may need fewer iterations each."""

LEAST_LIMIT = 0.2
"""Smallest time limit of a simulation [s], so that a short interruption does not exclude a candidate."""

UNCHANGED = 0.1
"""Relative change of the excess error between two tolerances, below which smaller tolerances are omitted."""


def search_grid(
    work: Iterable[WorkSpec],
    error: float,
    best: float,
    measure: Callable[[WorkSpec], Mapping[str, Any]],
    search_time: float,
) -> SearchSummary[Mapping[str, Any]]:
    """Measure settings until no remaining one can be the cheapest that meets an error.

    Args:
        work: the settings.
        error: relative error to meet; 0 for the least within SLOWER times `best`.
        best: wall seconds per simulated second of the best known setting, infinite without one.
        measure: measures a setting within the time limit of its specification, and returns the row.
        search_time: wall time after which no simulation starts [s].

    Returns:
        The numbers of measured and of omitted settings.
    """
    specs, omitted = list(work), Counter[str]()
    t_end = max((spec.t_end for spec in specs), default=1.0)

    def run_trial(spec: WorkSpec, limit: float) -> TrialOutcome[Mapping[str, Any]]:
        time_limit = min(spec.measurement.time_limit, limit * t_end)
        return _build_outcome(
            spec, measure(replace(spec, measurement=replace(spec.measurement, time_limit=time_limit)))
        )

    rule = GiveUpRule(SLOWER, LEAST_LIMIT / t_end, _describe_slow_settings(error))
    candidates = [(0.0, _propose_settings(grid, error, rule, omitted)) for grid in _group_by_method(specs)]
    return search_best_first(
        candidates, run_trial, error, rule, best_cost=best, search_time=search_time, omitted=omitted
    )


def _propose_settings(
    grid: list[list[WorkSpec]], error: float, rule: GiveUpRule, omitted: Counter[str]
) -> SettingProposals[WorkSpec, Mapping[str, Any]]:
    """Propose the settings of a method; what it omits is counted by reason.

    Args:
        grid: settings by time step, the longest first, and in each by tolerance, the largest first.
        error: relative error to meet.
        rule: when the method is given up.
        omitted: counts of omitted settings.
    """
    bound, remaining = 0.0, sum(map(len, grid))
    for specs in grid:
        before, loosest = inf, bound
        for number, spec in enumerate(specs):
            outcome = yield SettingProposal(spec, bound, num_remaining=remaining)
            remaining, following = remaining - 1, len(specs) - 1 - number
            found, cost = outcome.error, outcome.cost
            if number == 0 and cost < inf:
                loosest = cost
            is_unsupported = outcome.result is not None and outcome.result["status"] == "unsupported"
            if is_unsupported or (outcome.is_slow and number == 0):
                omitted["the solver does not support it" if is_unsupported else rule.reason] += remaining
                return None
            if outcome.is_slow:
                reason = rule.reason
            elif found <= error:
                reason = "a larger tolerance meets the error"
            elif number and abs(before - found) <= UNCHANGED * (found - error) < inf:
                reason = "a smaller tolerance does not change the error"
            else:
                before = found
                if following and cost < inf:
                    bound = max(bound, cost)
                continue
            omitted[reason] += following
            remaining -= following
            break
        # A shorter step is assumed to cost at least as much as this one at the largest tolerance.
        bound = max(bound, loosest)
    return None


def compute_setting_cost(spec: WorkSpec, row: Mapping[str, Any]) -> float:
    """Return the wall time per simulated second of a simulation, on an otherwise idle machine.

    Where other programs interrupted a simulation on one thread, its CPU time estimates its wall time without them.

    Args:
        spec: specification of the simulation.
        row: measured row, with `seconds_per_simulated_second` [s/s], and `cpu_seconds` of the whole simulation [s].
    """
    wall, cpu = row["seconds_per_simulated_second"], row.get("cpu_seconds")
    if cpu and row.get("preempted") and spec.measurement.threads == 1 and spec.solver.name in SOLVERS:
        return min(wall, cpu / spec.t_end)
    return wall


def is_measured(row: Mapping[str, Any]) -> bool:
    """Return whether the error of a simulation is known, or too small for the reference."""
    has_time = row.get("seconds_per_simulated_second") is not None
    return row["status"] == "ok" or (row["status"] == "uncertified" and has_time)


def _describe_slow_settings(error: float) -> str:
    if not error:
        return "they or their faster neighbours take longer than the budget allows"
    return f"they or their faster neighbours take {SLOWER:g} times as long as the best within {error:g}, or too long"


def _build_outcome(spec: WorkSpec, row: Mapping[str, Any]) -> TrialOutcome[Mapping[str, Any]]:
    """Return the error and the cost of a row, infinite if there are none.

    An error that is too small for the reference becomes the smallest positive number.
    """
    cost = compute_setting_cost(spec, row) if is_measured(row) else inf
    error = row["error"] if row["status"] == "ok" else inf if cost == inf else float_info.min
    return TrialOutcome(error, cost, is_late=row["status"] == "time-limit", result=row)


def _group_by_method(work: Iterable[WorkSpec]) -> list[list[list[WorkSpec]]]:
    """Group the settings by everything except time step and tolerance."""
    by_method: dict[str, list[WorkSpec]] = {}
    for spec in work:
        others = {name: value for name, value in spec.options.items() if name != "rtol"}
        by_method.setdefault(repr((spec.solver, spec.case.integrator, others)), []).append(spec)
    found = list[list[list[WorkSpec]]]()
    for specs in by_method.values():
        specs.sort(key=lambda spec: (-spec.case.scene.time_step, -(spec.options["rtol"] or 0.0)))
        found.append([list(same) for _, same in groupby(specs, lambda spec: spec.case.scene.time_step)])
    return found
