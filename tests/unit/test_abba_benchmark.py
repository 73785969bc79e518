"""Turns of two programs: fair orders, a budget, and a slowdown that is believed only when it is found twice."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import islice
from random import Random

import pytest
from springbench.harness.experiments.regression.abba_benchmark import (
    BLOCK_ORDERS,
    BenchmarkResult,
    LayoutRandomiser,
    ProgramPair,
    TimedBlock,
    draw_block_orders,
    run_confirmed_benchmark,
    run_paired_benchmark,
)
from springbench.harness.experiments.regression.confidence_sequence import (
    RatioInterval,
    SequentialTest,
)
from springbench.harness.results.regression_verdict import RegressionVerdict

RULE = SequentialTest(1.03)


def clock(seconds: float) -> Callable[[], float]:
    return lambda: seconds


@pytest.mark.parametrize(
    ("ratio", "answer"),
    [(1.0, RegressionVerdict.PASS), (1.05, RegressionVerdict.FAIL), (1.03, RegressionVerdict.INCONCLUSIVE)],
)
def test_a_benchmark_ends_with_its_verdict(ratio: float, answer: RegressionVerdict):
    # The third ratio is the limit itself: neither above nor below, so that only the budget ends it.
    found = run_paired_benchmark(
        ProgramPair(clock(ratio), clock(1.0)),
        RULE,
        time_budget=60.0 if answer is not RegressionVerdict.INCONCLUSIVE else 0.05,
    )
    assert found.verdict is answer
    if answer is not RegressionVerdict.INCONCLUSIVE:
        assert len(found.blocks) == 16  # the fewest that can decide at an error of 0.1 %
        assert (found.interval.low, found.interval.high) == pytest.approx((ratio, ratio))


def test_both_orders_come_equally_often():
    drawn = list(islice(draw_block_orders(Random(1)), 1000))
    assert set(drawn) == set(BLOCK_ORDERS)
    assert abs(drawn.count("ABBA") - 500) < 50  # three standard deviations


def test_a_steady_drift_cancels_in_each_turn():
    for order in BLOCK_ORDERS:
        assert TimedBlock(order, (1.0, 1.1, 1.2, 1.3)).log_ratio == pytest.approx(0.0, abs=1e-15)


def test_work_is_rebuilt_between_turns_in_its_share_of_the_time(monkeypatch: pytest.MonkeyPatch):
    now, turns, renewed = [0.0], list[None](), list[int]()

    def renew() -> None:
        renewed.append(len(turns))
        now[0] += 1.0

    monkeypatch.setattr("springbench.harness.experiments.regression.abba_benchmark.perf_counter", lambda: now[0])
    monkeypatch.setattr("springbench.harness.experiments.regression.abba_benchmark.REBUILD_TIME_SHARE", 0.2)
    renewing = LayoutRandomiser(renew)
    for _ in range(12):
        turns.append(None)
        now[0] += 1.0
        renewing.rebuild_after(1.0)
    assert renewed == [1, 4, 8, 12]  # after the first turn, and then after every fourth: a fifth of the time


def test_a_comparison_rebuilds_the_work_of_both_until_it_is_decided():
    renewed = list[None]()
    found = run_paired_benchmark(
        ProgramPair(clock(1.0), clock(1.0), lambda: renewed.append(None)), RULE, time_budget=60.0
    )
    assert (found.verdict, len(found.blocks)) == (RegressionVerdict.PASS, 16)
    assert 1 <= len(renewed) <= 15


def pairs(*ratios: float) -> tuple[Callable[..., object], list[float]]:
    """Starts of programs whose ratios of times are these, one start after the other; what has been started."""
    left, started = iter(ratios), []

    @contextmanager
    def start() -> Iterator[ProgramPair]:
        started.append(next(left))
        yield ProgramPair(clock(started[-1]), clock(1.0))

    return start, started


@pytest.mark.parametrize(
    ("ratios", "answer"),
    [
        ((1.0,), RegressionVerdict.PASS),
        ((1.06, 1.05), RegressionVerdict.FAIL),
        (
            (1.06, 1.0),
            RegressionVerdict.INCONCLUSIVE,
        ),  # two processes of the same code may differ by where their memory lies
    ],
)
def test_a_slowdown_is_accepted_if_a_second_start_confirms_it(ratios: tuple[float, ...], answer: RegressionVerdict):
    start, started = pairs(*ratios)
    found = run_confirmed_benchmark(start, RULE, time_budget=60.0)  # type: ignore[arg-type]
    assert found.verdict is answer
    assert (tuple(started), found.num_process_pairs) == (ratios, len(ratios))
    assert (found.interval.low, found.interval.high) == (pytest.approx(min(ratios)), pytest.approx(max(ratios)))


def test_the_budget_is_that_of_both_comparisons(monkeypatch: pytest.MonkeyPatch):
    slow = run_confirmed_benchmark(pairs(1.06, 1.05)[0], RULE, time_budget=60.0)  # type: ignore[arg-type]
    budgets: list[float] = []

    def run_comparison(start: object, rule: SequentialTest, budget: float) -> BenchmarkResult:
        budgets.append(budget)
        return replace(slow, sequential_test=rule, elapsed_seconds=45.0)

    monkeypatch.setattr(
        "springbench.harness.experiments.regression.abba_benchmark._run_restarted_benchmark", run_comparison
    )
    for budget in (60.0, 30.0):
        run_confirmed_benchmark(pairs(1.0)[0], RULE, time_budget=budget)  # type: ignore[arg-type]
    assert budgets == [60.0, 15.0, 30.0, 0.0]


def test_programs_are_restarted_as_long_as_a_comparison_lasts(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(
        "springbench.harness.experiments.regression.abba_benchmark.RESTART_SECONDS", 0.0
    )  # a start for each turn
    start, started = pairs(*[1.0] * 16)
    found = run_confirmed_benchmark(start, RULE, time_budget=60.0)  # type: ignore[arg-type]
    assert (found.verdict, found.num_process_pairs, len(found.blocks), len(started)) == (
        RegressionVerdict.PASS,
        16,
        16,
        16,
    )


def test_process_pairs_that_differ_permanently_decide_nothing_together(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("springbench.harness.experiments.regression.abba_benchmark.RESTART_SECONDS", 0.0)
    start, _ = pairs(*[1.05, 1.0] * 10_000)
    found = run_confirmed_benchmark(start, RULE, time_budget=0.05)  # type: ignore[arg-type]
    assert found.verdict is RegressionVerdict.INCONCLUSIVE
    assert found.num_process_pairs == len(found.blocks) > 16
    assert found.elapsed_seconds == pytest.approx(0.05, abs=0.05)


@pytest.mark.parametrize(
    ("answer", "limit", "interval", "said"),
    [
        (RegressionVerdict.FAIL, 1.03, (1.061, 1.052, 1.07), "fail: slower by 6.1 % [5.2, 7.0] (limit 3.0 %)"),
        (RegressionVerdict.PASS, 1.03, (1.003, 0.99, 1.012), "pass: at most 1.2 % slower (limit 3.0 %)"),
        (RegressionVerdict.PASS, 1.03, (0.9, 0.89, 0.91), "pass: ratio 0.9 [0.89, 0.91] (limit 1.03)"),
        (RegressionVerdict.FAIL, 0.45, (0.5, 0.48, 0.52), "fail: ratio 0.5 [0.48, 0.52] (limit 0.45)"),
        (RegressionVerdict.FAIL, 1.03, (3.0, 2.9, 3.1), "fail: ratio 3 [2.9, 3.1] (limit 1.03)"),
        (
            *(RegressionVerdict.INCONCLUSIVE, 1.03, (1.01, 0.96, 1.07)),
            "inconclusive: ratio 0.96 to 1.07 (limit 1.03) after 120 s, load average 7",
        ),
        (
            *(RegressionVerdict.INCONCLUSIVE, 1.03, (1.01, 0.0, float("inf"))),
            "inconclusive: 1 blocks only (limit 1.03) after 120 s, load average 7",
        ),
    ],
)
def test_a_result_states_what_was_measured(
    answer: RegressionVerdict, limit: float, interval: tuple[float, float, float], said: str
):
    turn = TimedBlock("ABBA", (1.0, 1.0, 1.0, 1.0))
    assert str(BenchmarkResult(answer, SequentialTest(limit), RatioInterval(*interval), (turn,), 120.0, 7.2)) == said
