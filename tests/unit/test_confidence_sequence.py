"""The sequential test: its error when it looks after every turn, on calm and on bursty machines, and what it finds."""

from itertools import pairwise
from math import factorial

import numpy as np
import pytest
from numpy.typing import NDArray
from springbench.harness.experiments.regression.confidence_sequence import (
    SequentialTest,
    compute_critical_count,
    compute_interval,
)
from springbench.harness.results.regression_verdict import RegressionVerdict

from tests.bench.replay_study import find_first_verdict

NUM_BLOCKS, SAMPLES = 400, 1000


def machine(rng: np.random.Generator, calls: int, noise: float, bursts: bool) -> NDArray[np.float64]:
    """How much longer each of a row of calls takes than on an idle machine.

    Bursts begin before 2 % of the calls, last for 12 on average, some turns, and make a call two to four times as long.
    """
    times = np.exp(noise * rng.standard_normal(calls))
    if bursts:
        busy = np.zeros(calls, bool)
        for begin in np.flatnonzero(rng.random(calls) < 0.02):
            busy[begin : begin + rng.geometric(1 / 12)] = True
        times[busy] *= rng.uniform(2, 4, busy.sum())
    return times


def sample(seed: int, slower: float = 1.0, noise: float = 0.02, *, bursts: bool = False) -> NDArray[np.float64]:
    """The log ratios of turns of a program and one that takes `slower` as long."""
    rng = np.random.default_rng(seed)
    times = machine(rng, 4 * NUM_BLOCKS, noise, bursts).reshape(NUM_BLOCKS, 4)
    outer, inner = times[:, [0, 3]].sum(axis=1), times[:, 1:3].sum(axis=1)
    abba = rng.random(NUM_BLOCKS) < 0.5
    return np.log(slower * np.where(abba, outer, inner) / np.where(abba, inner, outer))


def test_the_fewest_blocks_that_reject_are_those_of_the_martingale():
    # Exact integers: 2^n B(2 + k, 2 + n - k) / B(2, 2) = 6 * 2^n (k + 1)! (n - k + 1)! / (n + 3)!
    def martingale(n: int, k: int) -> float:
        return 6 * 2**n * factorial(k + 1) * factorial(n - k + 1) / factorial(n + 3)

    for n in (1, 5, 15, 16, 17, 40, 101):
        k = compute_critical_count(n, 0.001)
        assert k == n + 1 or martingale(n, k) >= 1000
        assert martingale(n, min(k, n + 1) - 1) < 1000
    assert compute_critical_count(15, 0.001) == 16
    assert compute_critical_count(16, 0.001) == 16


@pytest.mark.parametrize("bursts", [False, True], ids=["calm", "bursty"])
def test_a_decision_after_every_block_errs_as_rarely_as_stated(bursts: bool):
    # The limit is the true ratio, so every answer is wrong. At an error of 5 % more than 71 of 1000 would come about
    # once in a thousand repetitions of this test (binomial); the seeds are fixed.
    rule = SequentialTest(1.0, alpha=0.05)
    wrong = [
        find_first_verdict(rule, sample(seed, bursts=bursts))[0] is not RegressionVerdict.INCONCLUSIVE
        for seed in range(SAMPLES)
    ]
    assert 0 < sum(wrong) <= 71


@pytest.mark.parametrize("bursts", [False, True], ids=["calm", "bursty"])
def test_the_interval_covers_the_true_ratio_at_every_number_of_blocks(bursts: bool):
    missed = 0
    for seed in range(200):
        x = sample(seed, 1.05, bursts=bursts)
        found = [compute_interval(x[:n], alpha=0.05) for n in (1, 10, 20, 50, 100, 200, 400)]
        missed += not all(f.low <= 1.05 <= f.high for f in found)
        assert all(f.low <= f.ratio <= f.high for f in found)
    assert missed <= 20  # 5 % of 200, and twice that would come once in a thousand


@pytest.mark.parametrize("bursts", [False, True], ids=["calm", "bursty"])
@pytest.mark.parametrize(("slower", "limit", "within"), [(1.05, 1.03, 200), (1.1, 1.03, 60), (1.02, 1.01, 400)])
def test_a_slowdown_is_found(slower: float, limit: float, within: int, bursts: bool):
    found = [find_first_verdict(SequentialTest(limit), sample(seed, slower, bursts=bursts)) for seed in range(200)]
    assert sum(answer is RegressionVerdict.FAIL and turns <= within for answer, turns in found) >= 190
    assert not any(answer is RegressionVerdict.PASS for answer, _ in found)


def test_equal_programs_pass_and_none_fails():
    found = [find_first_verdict(SequentialTest(1.03), sample(seed, bursts=seed % 2 == 0)) for seed in range(SAMPLES)]
    assert {answer for answer, _ in found} == {RegressionVerdict.PASS}


def test_noise_too_large_for_the_limit_is_undecided_and_not_passed():
    found = [find_first_verdict(SequentialTest(1.03), sample(seed, 1.05, noise=0.5))[0] for seed in range(200)]
    assert found.count(RegressionVerdict.INCONCLUSIVE) >= 190  # the interval of 400 such turns is .3 wide
    assert RegressionVerdict.PASS not in found


def test_the_first_verdict_is_that_of_a_test_after_each_block():
    rule = SequentialTest(1.03)
    for seed in range(20):
        x = sample(seed, 1.0 + 0.01 * seed)
        looked = next(
            (
                (a, n)
                for n in range(1, NUM_BLOCKS + 1)
                if (a := rule.decide_verdict(x[:n])) is not RegressionVerdict.INCONCLUSIVE
            ),
            None,
        )
        assert find_first_verdict(rule, x) == (looked or (RegressionVerdict.INCONCLUSIVE, NUM_BLOCKS))


def test_a_verdict_follows_from_the_interval():
    for seed in range(20):
        x = sample(seed, 1.0 + 0.005 * seed)
        for n in (10, 20, 50, 400):
            found, answer = compute_interval(x[:n]), SequentialTest(1.03).decide_verdict(x[:n])
            assert (found.low > 1.03) == (answer is RegressionVerdict.FAIL)
            assert (found.high < 1.03) == (answer is RegressionVerdict.PASS)


def test_one_block_that_was_disturbed_without_end_changes_nothing():
    x = sample(1)
    x[7] = 1e300
    assert compute_interval(x).high < 1.01


def test_a_smaller_error_takes_more_blocks():
    needed = [compute_critical_count(100, alpha) for alpha in (0.05, 0.01, 0.001, 1e-6)]
    assert all(a < b for a, b in pairwise(needed))


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ({"max_ratio": 0.0}, "max_ratio: got 0.0"),
        ({"max_ratio": -1.0}, "max_ratio: got -1.0"),
        ({"max_ratio": float("nan")}, "max_ratio: got nan"),
        ({"max_ratio": 1.03, "alpha": 0.0}, "alpha: got 0.0"),
        ({"max_ratio": 1.03, "alpha": 1.0}, "alpha: got 1.0"),
    ],
)
def test_an_impossible_rule_is_refused(given: dict[str, float], named: str):
    with pytest.raises(ValueError, match=named):
        SequentialTest(**given)
