"""The best-first search chooses what a full search chooses, and measures less."""

from __future__ import annotations

from collections import Counter
from math import inf
from random import Random
from types import SimpleNamespace
from typing import Any

import pytest
from springbench.harness.config.accuracy_config import BenchmarkCase, MeasurementSettings, WorkSpec
from springbench.harness.config.sweep_config import SolverSpec
from springbench.harness.experiments.accuracy.setting_grid import LEAST_LIMIT, SLOWER, search_grid
from springbench.harness.experiments.best_first_search import (
    OUT_OF_TIME,
    GiveUpRule,
    SettingProposal,
    SettingProposals,
    TrialOutcome,
    search_best_first,
)

STEPS, TOLERANCES, SOLVERS = (0.4, 0.2, 0.1, 0.05, 0.025), (1e-1, 1e-2, 1e-3), ("a", "b", "c", "d", "e")


def specs() -> list[WorkSpec]:
    return [
        WorkSpec(
            BenchmarkCase("scene", SimpleNamespace(time_step=dt), 4, "implicit-euler"),  # type: ignore[arg-type]
            1.0,
            SolverSpec(solver, {}),
            {"initial_guess": "previous", "max_iterations": 9, "rtol": tolerance},
            MeasurementSettings(1, rounds=1, time_limit=1e3),
        )
        for solver in SOLVERS
        for tolerance in reversed(TOLERANCES)
        for dt in reversed(STEPS)
    ]


def table(seed: int) -> dict[Any, dict[str, Any]]:
    """Errors a dt^p + b tolerance, costs c dt^-q (1 + d log 1/tolerance); some methods diverge at long steps."""
    random, found = Random(seed), dict[Any, dict[str, Any]]()
    for solver in SOLVERS:
        a, b, c, d = (10.0 ** random.uniform(*at) for at in ((-2, 1), (-3, 0), (-1, 2), (-2, 0)))
        p, q, stable = random.choice((1, 2, 4)), random.uniform(0.5, 1.0), random.choice((1.0, 0.11))
        for one in (one for one in specs() if one.solver.name == solver):
            dt, tolerance = one.case.scene.time_step, one.options["rtol"]
            error = a * dt**p + b * tolerance
            cost = c * dt**-q * (1.0 + d * TOLERANCES.index(tolerance))
            row = {"status": "ok", "error": error, "seconds_per_simulated_second": cost}
            found[key(one)] = row if dt <= stable else {"status": "diverged"}
    return found


def key(spec: WorkSpec) -> tuple[Any, ...]:
    return spec.solver.name, spec.case.scene.time_step, spec.options["rtol"]


class MeasuredTable:
    """Rows of a table, cut off at the time limits of the specifications."""

    def __init__(self, rows: dict[Any, dict[str, Any]]) -> None:
        self.rows, self.found = rows, dict[Any, dict[str, Any]]()

    def __call__(self, spec: WorkSpec) -> dict[str, Any]:
        row = self.rows[key(spec)]
        if row["status"] == "ok" and row["seconds_per_simulated_second"] > spec.measurement.time_limit:
            row = {"status": "time-limit"}
        self.found[key(spec)] = row
        return row

    def best(self, error: float) -> Any:
        return cheapest(self.found, error)


def cheapest(rows: dict[Any, dict[str, Any]], error: float) -> Any:
    within = {at: row["seconds_per_simulated_second"] for at, row in rows.items() if row.get("error", inf) <= error}
    return min(within, key=within.__getitem__, default=None)


def test_the_choice_is_that_of_a_full_search():
    measured = none = 0
    for seed in range(200):
        rows = table(seed)
        measure = MeasuredTable(rows)
        omitted = search_grid(specs(), 1e-2, inf, measure, 60.0)
        assert measure.best(1e-2) == cheapest(rows, 1e-2), seed
        assert omitted.is_complete
        assert omitted.num_trials == len(measure.found) == len(specs()) - sum(omitted.reasons.values())
        none += cheapest(rows, 1e-2) is None
        measured += omitted.num_trials
    assert none < 50
    assert measured < 0.5 * 200 * len(specs())


def test_a_method_stored_as_cheap_excludes_slower_methods_at_once():
    rows = {key(one): {"status": "ok", "error": 1.0, "seconds_per_simulated_second": 10.0} for one in specs()}
    measure = MeasuredTable(rows)
    omitted = search_grid(specs(), 1e-2, 1.0, measure, 60.0)
    assert set(measure.found) == {(solver, 0.4, 0.1) for solver in SOLVERS}
    assert all(row["status"] == "time-limit" for row in measure.found.values())
    assert "take 1.5 times as long" in str(omitted)


def test_an_error_too_small_to_measure_meets_the_target_and_limits_the_others():
    exact = {"status": "uncertified", "error": None, "seconds_per_simulated_second": 1.0}
    slow = {"status": "ok", "error": 1.0, "seconds_per_simulated_second": 10.0}
    measure = MeasuredTable({key(one): exact if one.solver.name == "a" else slow for one in specs()})
    search_grid(specs(), 1e-2, inf, measure, 60.0)
    assert {at[2] for at in measure.found if at[0] == "a"} == {0.1}, "smaller tolerances are left out"
    assert {at for at in measure.found if at[0] != "a"} == {(solver, 0.4, 0.1) for solver in SOLVERS[1:]}


@pytest.mark.parametrize(("best", "limit"), [(1.0, SLOWER), (1e-3, LEAST_LIMIT), (inf, 1e3)])
def test_a_simulation_may_take_little_more_than_the_best(best: float, limit: float):
    given = list[float]()

    def measure(spec: WorkSpec) -> dict[str, Any]:
        given.append(spec.measurement.time_limit)
        return {"status": "unsupported"}

    omitted = search_grid(specs(), 1e-2, best, measure, 60.0)
    assert given == [limit] * len(SOLVERS)
    assert omitted.reasons == {"the solver does not support it": len(specs()) - len(SOLVERS)}


def test_after_its_search_time_nothing_begins():
    omitted = search_grid(specs(), 1e-2, inf, MeasuredTable(table(0)), -1.0)
    assert (omitted.num_trials, omitted.is_complete) == (0, False)
    assert omitted.reasons == {OUT_OF_TIME: len(specs())}


def test_within_a_cost_the_choice_is_near_the_least_error_in_hindsight():
    """With an error of 0, over 50 random tables: at most 1.3 times the least error of all settings within the cost."""
    ratios = list[float]()
    for seed in range(50):
        rows = table(seed)
        ok = [row for row in rows.values() if row["status"] == "ok"]
        costs = sorted(row["seconds_per_simulated_second"] for row in ok)
        limit = costs[len(costs) // 3]

        def find_least(found: dict[Any, dict[str, Any]], limit: float = limit) -> float:
            within = (row for row in found.values() if row.get("seconds_per_simulated_second", inf) <= limit)
            return min((row["error"] for row in within), default=inf)

        measure = MeasuredTable(rows)
        search_grid(specs(), 0.0, 2.0 * limit / SLOWER, measure, 60.0)
        ratios.append(find_least(measure.found) / find_least(rows))
    assert max(ratios) <= 1.3


@pytest.mark.parametrize("ends_at_answer", [True, False])
def test_a_reason_for_which_nothing_is_omitted_is_not_listed(ends_at_answer: bool):
    def propose() -> SettingProposals[int, None]:
        return (yield SettingProposal(1))

    summary = search_best_first(
        [(0.0, propose())],
        lambda setting, limit: TrialOutcome(0.0, 1.0),
        0.1,
        GiveUpRule(2.0, 0.0),
        omitted=Counter({"they diverge": 0, "they are slow": 2}),
        ends_at_answer=ends_at_answer,
    )
    assert summary.reasons == {"they are slow": 2}
    assert (summary.answer is not None) == ends_at_answer
