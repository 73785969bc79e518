"""Contract: the step size controllers against the formulas of Hairer and Wanner, and their limits."""

from __future__ import annotations

import numpy as np
import pytest
from springbench.solvers.model.integrators.step_size_controller import (
    StepSizeController,
    build_pi_controller,
    choose_next_step_size,
    compute_rejection_factor,
    filter_error,
)

ELEMENTARY = StepSizeController(4.0)
PI = build_pi_controller(5.0, max_factor=6.0, failure_factor=0.5)
PREDICTIVE = StepSizeController(3.0, beta_1=2.0, beta_2=-1.0, alpha=-1.0)


@pytest.mark.parametrize(("ratio", "before", "steps"), [(0.5, 0.9, 1.0), (0.01, 0.5, 2.0), (1.0, 1e-3, 0.25)])
def test_each_controller_has_its_formula(ratio, before, steps):
    assert filter_error(ELEMENTARY, ratio, before, steps) == pytest.approx(0.9 * ratio**-0.25)
    assert filter_error(PI, ratio, before, steps) == pytest.approx(0.9 * ratio**-0.14 * before**0.08)
    assert filter_error(PREDICTIVE, ratio, before, steps) == pytest.approx(
        0.9 * steps * (before / ratio**2) ** (1.0 / 3.0)
    )


def test_an_error_of_zero_has_a_finite_factor():
    assert filter_error(ELEMENTARY, 0.0, 1.0, 1.0) == pytest.approx(0.9 * 1e-10**-0.25)
    assert filter_error(PI, 1.0, 0.0, 1.0) == pytest.approx(0.9 * 1e-4**0.08)


def test_a_step_size_changes_within_limits_and_the_end_of_a_frame_never_decreases_it():
    assert choose_next_step_size(PI, 0.1, 0.1, False, 0.0, 1.0) == pytest.approx(0.6)
    assert choose_next_step_size(PI, 0.1, 0.1, False, 1.0, 1e-4) == pytest.approx(0.1 * 0.9 * 1e-4**0.08)
    assert choose_next_step_size(PI, 0.1, 0.1, True, 1.0, 1e-4) == 0.1
    assert choose_next_step_size(PI, 0.01, 0.1, True, 0.5, 1.0) == 0.1
    steep = PI._replace(beta_2=-10.0)
    assert choose_next_step_size(steep, 0.1, 0.1, False, 1.0, 1e-4) == pytest.approx(0.02)


def test_a_rejected_step_is_reduced_by_its_error_within_limits():
    assert compute_rejection_factor(PI, 16.0) == pytest.approx(0.9 * 16.0**-0.2)
    assert compute_rejection_factor(PI, 1e30) == 0.2
    assert compute_rejection_factor(PI, np.inf) == compute_rejection_factor(PI, np.nan) == 0.5
