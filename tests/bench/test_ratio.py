"""What the statistics of the gates see, and what they do not."""

import numpy as np
import pytest

from tests.bench.ratio import Ratio

TURNS = 15


def noisy(slowdown: float, noise: float, seed: int) -> Ratio:
    """The ratio of times with log-normal noise, the candidate slower by a factor."""
    times = np.exp(noise * np.random.default_rng(seed).standard_normal((TURNS, 3)))
    return Ratio.of(slowdown * times[:, :2], times[:, 2])


def test_a_steady_drift_of_the_machine_cancels():
    time = 1.0 + 0.01 * np.arange(3 * TURNS).reshape(TURNS, 3)
    ratio = Ratio.of(2.0 * time[:, [0, 2]], time[:, 1])
    # Exact but for round-off.
    assert (ratio.low, ratio.median, ratio.high) == pytest.approx((2.0, 2.0, 2.0), rel=1e-14)


def test_the_same_times_give_the_same_interval():
    assert noisy(1.0, 0.1, seed=1) == noisy(1.0, 0.1, seed=1)


# 15 % is what ratios of wall times spread on a loaded machine, 1 % on an idle one.
@pytest.mark.parametrize(("slowdown", "noise"), [(1.35, 0.15), (1.05, 0.01)])
def test_a_slowdown_is_seen_through_noise(slowdown: float, noise: float):
    seen = [noisy(slowdown, noise, seed).exceeds(1.02) for seed in range(200)]
    # An interval of 15 turns at 15 % is 0.1 wide on either side, so hardly any of 1.35 reaches down to 1.02.
    assert np.mean(seen) > 0.95


def test_noise_alone_hardly_ever_fails_a_gate():
    failed = [noisy(1.0, 0.15, seed).exceeds(1.02) for seed in range(400)]
    # The interval is two-sided: at most 2.5 % of them lie above the true ratio, fewer above a limit beyond it.
    assert np.mean(failed) < 0.025


def test_one_disturbed_turn_does_not_move_the_median():
    times = np.ones((TURNS, 3))
    times[4, 0] = 50.0
    assert Ratio.of(times[:, :2], times[:, 2]).median == 1.0
