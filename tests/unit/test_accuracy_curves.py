"""Curves: which iterates are evaluated, by which reference, what ends them, and what their clock counts."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from itertools import count, islice, pairwise
from time import perf_counter, sleep
from typing import Any, cast

import numpy as np
import pytest
from springbench.harness.errors import RunFailed
from springbench.harness.experiments.accuracy import convergence_curves
from springbench.harness.experiments.accuracy.convergence_curves import (
    ScoredCurve,
    is_scored_iteration,
    measure_convergence,
)
from springbench.harness.experiments.accuracy.step_scales import compute_vertex_distances
from springbench.harness.reference.certified_minimum import refine_minimum
from springbench.harness.reference.reference_evaluator import ReferenceEvaluator, StationarityReading
from springbench.harness.simulation.instrumentation_pass import EnergyNorm
from springbench.solvers.methods.local_global.reference_local_global import SparseLocalGlobal
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.step_problem import Positions, StepProblem

from tests.preemption_retry import retry_if_preempted
from tests.scene_builders import build_cloth, build_first_problem
from tests.unit.test_certified_minimum import FLAT

PROBLEM = build_first_problem(build_cloth(6, "exact"))


@cache
def minimum() -> Positions:
    """Computed on first use: collecting tests compiles nothing."""
    return refine_minimum(PROBLEM, PROBLEM.current_positions, NewtonSolver()).positions


def test_each_early_iterate_is_graded_and_then_twelve_a_decade() -> None:
    graded = [number for number in range(100_001) if is_scored_iteration(number)]
    assert graded[:51] == list(range(51))
    for decade in (100, 1000, 10_000):
        assert sum(decade <= number < 10 * decade for number in graded) == 12
        assert {decade, 2 * decade, 5 * decade} <= set(graded)


def test_stationarity_is_the_step_of_local_global_relative_to_that_at_the_current_positions() -> None:
    oracle, norm = ReferenceEvaluator(PROBLEM.system), EnergyNorm(PROBLEM.system)
    prepared = SparseLocalGlobal().prepare(PROBLEM.system)
    points = [PROBLEM.current_positions, *(p.copy() for p in islice(prepared.iterates(PROBLEM), 4))]
    steps = [norm(after - before) for before, after in pairwise(points)]
    for p, step in zip(points, steps, strict=False):
        # Two factorisations of one matrix solve it, each to round-off in a condition number of 1e3.
        assert oracle.measure_stationarity(PROBLEM, p).stationarity == pytest.approx(step / steps[0], rel=1e-9)
    assert (
        oracle.measure_stationarity(PROBLEM, minimum()).stationarity < 1e-12
    )  # round-off of a gradient of 1 at the start


def test_distances_leave_out_what_is_pinned() -> None:
    moved = PROBLEM.current_positions.copy()
    moved[PROBLEM.system.pins.vertices] += 5.0
    free = PROBLEM.system.free_vertices
    moved[free[0], 1] += 0.3
    largest, rms = compute_vertex_distances(PROBLEM.system, moved, PROBLEM.current_positions)
    assert (largest, rms) == pytest.approx((0.3, 0.3 / len(free) ** 0.5), rel=1e-12)  # round-off of a difference


class ScriptedSolver:
    """Prepared: a given sequence of iterates."""

    def __init__(self, iterate: Callable[[int], Positions], pause: float = 0.0) -> None:
        self.iterate, self.pause = iterate, pause

    def iterates(self, problem: StepProblem) -> Iterator[Positions]:
        for number in count(1):
            sleep(self.pause)
            yield self.iterate(number)


def towards(share: Callable[[int], float]) -> Callable[[int], Positions]:
    """Iterates on the line from the minimum (share 0) to the current positions (1) and beyond."""
    return lambda number: minimum() + share(number) * (PROBLEM.current_positions - minimum())


def curve(prepared: Any, **more: Any) -> ScoredCurve:
    limits: dict[str, Any] = {"max_iterations": 200, "time_limit": 60.0, "num_rounds": 2} | more
    return measure_convergence(
        prepared, PROBLEM, ReferenceEvaluator(PROBLEM.system), PROBLEM.value(minimum()), **limits
    )


ENDS = {
    "it converges": (towards(lambda n: 0.5**n), "ok", ""),
    "it converges too slowly": (towards(lambda n: 1 / (1 + n)), "ok", "limit of iterations"),
    "it stands still far off": (towards(lambda n: max(0.5**n, 0.01)), "no-progress", "do not change"),
    "it pauses": (towards(lambda n: 0.5 ** (n // convergence_curves.MAX_UNCHANGED_ITERATES)), "ok", ""),
    "it goes to and fro": (towards(lambda n: 0.5 + 0.1 * (n % 2)), "no-progress", "limit of iterations"),
    "it explodes": (towards(lambda n: 10.0**n), "diverged", "exploded"),
    "it is not a number": (towards(lambda n: np.nan if n == 3 else 0.5 / n), "diverged", "after 3 iterations"),
}


@pytest.mark.parametrize(("iterate", "status", "reason"), ENDS.values(), ids=ENDS)
def test_a_curve_states_its_termination_reason(iterate: Callable[[int], Positions], status: str, reason: str) -> None:
    found = curve(ScriptedSolver(iterate))
    assert found.status == status
    assert reason in found.reason
    assert found.iterate_indices[0] == 0
    assert (
        len(found.iterate_indices)
        == len(found.g)
        == len(found.stationarity)
        == len(found.positions)
        == len(found.seconds)
    )


def test_a_curve_ends_at_its_time_limit_without_the_iterates_that_compile() -> None:
    found = curve(ScriptedSolver(towards(lambda n: 1 / (1 + n)), pause=0.02), time_limit=0.05, num_rounds=1)
    assert found.status == "time-limit"
    # Sleeping takes at least the requested time: three iterates after the warm-up are over the limit, perhaps fewer.
    assert (
        convergence_curves.NUM_WARMUP_ITERATES < found.iterate_indices[-1] <= convergence_curves.NUM_WARMUP_ITERATES + 3
    )
    assert found.seconds[-1, 0] >= 0.02 * found.iterate_indices[-1]


def test_a_curve_does_not_end_where_a_kernel_is_compiled() -> None:
    first_calls = {4, 7}

    def iterate(number: int) -> Positions:
        if number in first_calls:
            first_calls.remove(number)
            sleep(0.3)
        return towards(lambda n: 0.5**n)(number)

    found = curve(ScriptedSolver(iterate), time_limit=0.2, num_rounds=1)
    assert (found.status, first_calls) == ("ok", set())


def test_scores_are_those_of_the_reference_and_time_stamps_ascend_in_each_round() -> None:
    prepared = SparseLocalGlobal().prepare(PROBLEM.system)
    found = curve(prepared, max_iterations=120, num_rounds=3)
    assert found.iterate_indices == [number for number in range(121) if is_scored_iteration(number)]
    for number, p, g in zip(found.iterate_indices[1:], found.positions[1:], found.g[1:], strict=True):
        expected = next(islice(prepared.iterates(PROBLEM), number - 1, None))
        assert np.array_equal(p, expected)
        assert g == PROBLEM.value(expected)
    assert found.seconds.shape == (len(found.iterate_indices), 3)
    assert (found.seconds[0] == 0.0).all()
    assert (np.diff(found.seconds, axis=0) > 0.0).all()


@pytest.mark.parametrize("scale", [1e-3, 2.0])
def test_time_stamps_that_another_clock_contradicts_are_a_failure(
    scale: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(convergence_curves, "perf_counter", lambda: scale * perf_counter())
    prepared = SparseLocalGlobal().prepare(PROBLEM.system)
    with pytest.raises(RunFailed, match="the times of iterates add up to"):
        retry_if_preempted(lambda: ([{"preempted": curve(prepared, max_iterations=120).preempted}], None))


def test_passes_that_differ_in_the_last_bit_are_a_failure() -> None:
    calls = count()

    def iterate(number: int) -> Positions:
        p = towards(lambda n: 0.5**n)(number)
        p[-1, 1] = np.nextafter(p[-1, 1], np.inf) if next(calls) > 40 else p[-1, 1]
        return p

    with pytest.raises(RunFailed, match="differ from those of the graded pass"):
        curve(ScriptedSolver(iterate))


def at_a_saddle(iterate: Callable[[int], Positions]) -> ScoredCurve:
    above = refine_minimum(FLAT, FLAT.current_positions, NewtonSolver())
    limits: dict[str, Any] = {"max_iterations": 40, "time_limit": 60.0, "num_rounds": 1}
    return measure_convergence(
        cast("Any", ScriptedSolver(iterate)),
        STARTED_NEAR_SADDLE,
        ReferenceEvaluator(FLAT.system),
        above.objective,
        **limits,
    )


STARTED_NEAR_SADDLE = replace(
    FLAT, current_positions=FLAT.current_positions + np.array([[0.0], [0.0], [0.0], [0.0], [1e-3]])
)
"""A step whose current positions are near the saddle at which FLAT's are."""


def test_a_solver_that_ends_at_a_saddle_is_reported_so_and_has_not_converged() -> None:
    found = at_a_saddle(lambda number: FLAT.current_positions)
    assert found.stationarity[-1] <= convergence_curves.STATIONARITY_TOLERANCE
    assert found.status == "saddle"
    assert "saddle, where the curvature is -" in found.reason


def test_a_solver_that_leaves_a_saddle_continues_to_its_minimum() -> None:
    above = refine_minimum(FLAT, FLAT.current_positions, NewtonSolver()).positions
    found = at_a_saddle(lambda number: FLAT.current_positions if number < 3 else above)
    assert (found.status, found.iterate_indices[-1]) == ("ok", 3)


def test_a_stationarity_that_is_no_number_is_a_divergence(monkeypatch: pytest.MonkeyPatch) -> None:
    reading = StationarityReading(np.inf, 0.0, np.inf)
    monkeypatch.setattr(ReferenceEvaluator, "measure_stationarity", lambda self, problem, p: reading)
    assert curve(ScriptedSolver(towards(lambda n: 0.5**n))).status == "diverged"
