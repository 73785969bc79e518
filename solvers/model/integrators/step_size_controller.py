"""Step size controllers: the error estimates of the last steps determine the next step size.

    h' = h limit(safety ratio^(-beta_1/k) ratio_before^(-beta_2/k) (h/h_before)^(-alpha)),   ratio = error/tolerance

This is a digital filter (Soderlind 2003, "Digital filters in adaptive time-stepping", section 3) for errors of order
h^k. It contains the three controllers of Hairer and Wanner, Solving Ordinary Differential Equations II:

    elementary   beta = 1, 0         from one step
    PI           beta = 0.7, -0.4    proportional-integral, for stability-limited steps (section IV.2)
    predictive   beta = 2, -1, alpha = -1    of Gustafsson 1994, for implicit methods (section IV.8)

A step is accepted where ratio <= 1. A rejected step is repeated with the size of the elementary controller. The
functions are also compiled into kernels.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable
from springbench.solvers.jit.kernel_compilation import jit_inner_options

_MIN_ERROR_RATIO = 1e-10
"""Lower bound of the error ratio of an accepted step, which may be zero."""


class StepSizeController(NamedTuple):
    """The coefficients of a controller.

    Attributes:
        error_order: exponent k of the step size in the error estimate.
        beta_1, beta_2, alpha: exponents of the last error ratio, of the one before it and of the ratio of step sizes.
        min_factor, max_factor: limits of the change of the step size.
        failure_factor: change of the step size after a step without an error estimate.
        min_previous_ratio: lower bound of the previous error ratio.
        safety: safety factor.
    """

    error_order: float
    beta_1: float = 1.0
    beta_2: float = 0.0
    alpha: float = 0.0
    min_factor: float = 0.2
    max_factor: float = 5.0
    failure_factor: float = 0.5
    min_previous_ratio: float = _MIN_ERROR_RATIO
    safety: float = 0.9


def build_pi_controller(error_order: float, max_factor: float, failure_factor: float) -> StepSizeController:
    """Build a proportional-integral controller.

    Args:
        error_order: exponent of the step size in the error estimate.
        max_factor: upper limit of the change of the step size.
        failure_factor: change of the step size after a step without an error estimate.
    """
    return StepSizeController(
        error_order, 0.7, -0.4, max_factor=max_factor, failure_factor=failure_factor, min_previous_ratio=1e-4
    )


@register_jitable(**jit_inner_options)
def filter_error(control: StepSizeController, ratio: float, previous_ratio: float, step_size_ratio: float) -> float:
    """Return the unlimited change of the step size after an accepted step.

    Args:
        control: a `StepSizeController`.
        ratio: error of the step over the tolerance.
        previous_ratio: that of the previous accepted step; 1 for none.
        step_size_ratio: size of the step over that of the previous one; 1 for none.
    """
    power = control.error_order
    return (
        control.safety
        * max(ratio, _MIN_ERROR_RATIO) ** (-control.beta_1 / power)
        * max(previous_ratio, control.min_previous_ratio) ** (-control.beta_2 / power)
        * step_size_ratio ** (-control.alpha)
    )


@register_jitable(**jit_inner_options)
def choose_next_step_size(
    control: StepSizeController,
    step_size: float,
    planned_step_size: float,
    ends_frame: bool,
    ratio: float,
    previous_ratio: float,
) -> float:
    """Return the step size [s] after an accepted step.

    Args:
        control: a `StepSizeController`.
        step_size: size of the step [s].
        planned_step_size: its size [s] before the end of the frame limited it.
        ends_frame: whether the step ends the frame; the planned size is then a lower bound.
        ratio: error of the step over the tolerance.
        previous_ratio: that of the previous accepted step; 1 for none.
    """
    change = filter_error(control, ratio, previous_ratio, 1.0)
    if ends_frame:
        return max(planned_step_size, step_size * change)
    return step_size * min(control.max_factor, max(control.min_factor, change))


@register_jitable(**jit_inner_options)
def compute_rejection_factor(control: StepSizeController, ratio: float) -> float:
    """Return the change of the step size after a rejected step.

    Args:
        control: a `StepSizeController`.
        ratio: error of the step over the tolerance; may be infinite or nan.

    Returns:
        Factor of the step size, at least `min_factor`; `failure_factor` for a ratio that is infinite or nan.
    """
    if ratio < np.inf:
        return max(control.min_factor, control.safety * ratio ** (-1.0 / control.error_order))
    return control.failure_factor
