"""What the statistics of times say, and what does not move them."""

import numpy as np
import pytest
from springbench.harness.results.bootstrap_statistics import (
    compute_min_seconds,
    estimate_added_time,
    estimate_ratio,
    estimate_slowdown,
)


def test_the_interval_contains_the_ratio_and_is_the_same_each_time():
    numerator, denominator = np.exp(0.1 * np.random.default_rng(1).standard_normal((2, 15)))
    found = estimate_ratio(3.0 * numerator, denominator)
    assert found.low < found.estimate < found.high
    assert found.low < 3.0 < found.high
    assert estimate_ratio(3.0 * numerator, denominator) == found


@pytest.mark.parametrize("rounds", [1, 2, 5])
def test_equal_times_have_an_interval_of_no_width(rounds: int):
    assert estimate_ratio(np.full(rounds, 2.0), np.ones(rounds)) == (2.0, 2.0, 2.0)
    assert estimate_added_time(np.full((rounds, 3), 0.5)) == (0.5, 0.5, 0.5)


def test_rounds_that_were_disturbed_do_not_move_the_ratio():
    denominator = np.ones(15)
    denominator[[2, 3, 7, 8, 9, 11]] = 40.0
    assert estimate_ratio(np.full(15, 6.0), denominator).estimate == 6.0


def test_what_frames_add_is_added_up_however_unequal_they_are():
    # A frame of contact among nine without: a median over frames would not see it.
    more = np.zeros((5, 10))
    more[:, 4] = 1.0
    assert estimate_added_time(more) == (0.1, 0.1, 0.1)


def test_nine_of_ten_intervals_or_more_contain_the_true_ratio():
    rng = np.random.default_rng(2)
    found = [estimate_ratio(2.0 * t, o) for t, o in np.exp(0.1 * rng.standard_normal((200, 2, 15)))]
    # A percentile bootstrap of a median of 15 is known to be a little short of its 95 %.
    assert np.mean([f.low <= 2.0 <= f.high for f in found]) > 0.9


def test_of_each_frame_the_least_of_its_rounds_counts():
    assert compute_min_seconds([(1, 3.0), (2, 5.0), (1, 2.0), (2, 7.0)]) == {1: 2.0, 2: 5.0}


def test_a_change_is_that_of_the_frames_that_both_days_have():
    old = {frame: float(frame) for frame in range(1, 8)}
    new = {frame: 1.5 * seconds for frame, seconds in old.items()} | {3: 90.0, 99: 1e9}
    found = estimate_slowdown(new, old)
    assert found.estimate == pytest.approx(1.5, rel=1e-15)
    assert found.low <= found.estimate <= found.high
