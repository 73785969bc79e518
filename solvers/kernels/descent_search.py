"""Parts of compiled descent methods for springs and quadratic forms: line search, round-off and residual."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_inner_options
from springbench.solvers.kernels.line_search_conditions import MAX_HALVINGS
from springbench.solvers.kernels.objective_kernels import ObjectiveTerms, compute_max_magnitude, try_step
from springbench.solvers.kernels.quadratic_form_kernels import QuadraticForm
from springbench.solvers.kernels.residual_norm import ResidualNorm, compute_norm_of_correction
from springbench.solvers.model.rounding_bound import EPS


class SearchArrays(NamedTuple):
    """Arrays of a descent method for one system.

    Attributes:
        objective_terms: springs, inertia and penalty pins.
        quadratic_form: sum of the quadratic forms.
        unpinned_trace: trace of the unpinned part of Q [N/m].
        residual_norm: norm of residuals.
        trial_positions, trial_gradient: scratch, (n, 3) [m] and [N].
    """

    objective_terms: ObjectiveTerms
    quadratic_form: QuadraticForm
    unpinned_trace: float
    residual_norm: ResidualNorm
    trial_positions: NDArray[np.float64]
    trial_gradient: NDArray[np.float64]


@register_jitable(**jit_inner_options)
def bound_decrement_roundoff(max_magnitude: float, unpinned_trace: float) -> float:
    """Return a bound of g' H^-1 g [J] for a gradient g that is round-off.

    Args:
        max_magnitude: largest absolute coordinate of the positions [m].
        unpinned_trace: trace of the unpinned part of Q [N/m].
    """
    return (EPS * max_magnitude) ** 2 * unpinned_trace


@jit_inner
def exceeds_roundoff(arrays, p, decrement):
    """Return whether g' H^-1 g exceeds its bound for a gradient g that is round-off.

    Args:
        arrays: arrays of the system.
        p: positions (n, 3) [m].
        decrement: g' H^-1 g, or another norm of the gradient [J].
    """
    return decrement > bound_decrement_roundoff(compute_max_magnitude(p), arrays.unpinned_trace)


@jit_inner
def search_backtracking(arrays, step_data, exact_pins, p, direction, step_size, slope):
    """Find the first of the step sizes t, t/2, ... at which the objective decreases enough.

    Args:
        arrays: arrays of the system; the trial's positions and gradient are written there.
        step_data: data of the step.
        exact_pins: exactly pinned vertices, which are moved to their targets.
        p: current positions (n, 3) [m].
        direction: search direction (n, 3) [m].
        step_size: first step size t.
        slope: derivative along the direction [J].

    Returns:
        Whether there is one.
    """
    terms = arrays.objective_terms, arrays.quadratic_form, step_data, exact_pins
    q, gradient = arrays.trial_positions, arrays.trial_gradient
    for _ in range(MAX_HALVINGS if slope < 0.0 < step_size else 0):
        if try_step(*terms, p, direction, step_size, slope, 0.0, q, gradient)[1]:
            return True
        step_size *= 0.5
    return False


@jit_inner
def move_to_trial(arrays, p, gradient):
    """Copy the positions and the gradient of the last trial.

    Args:
        arrays: arrays of the system.
        p: output, positions (n, 3) [m].
        gradient: output, gradient there (n, 3) [N].
    """
    for v in range(len(p)):
        for c in range(3):
            p[v, c], gradient[v, c] = arrays.trial_positions[v, c], arrays.trial_gradient[v, c]


@jit_inner
def read_residual(arrays, correction, gradient, progress):
    """Return the residual [J^(1/2)] at the current point, which is computed once.

    Args:
        arrays: arrays of the system.
        correction: Q^-1 g (n, 3) [m].
        gradient: gradient g (n, 3) [N].
        progress: progress of the solve (1,), with the fields `residual` and `has_residual`.
    """
    now = progress[0]
    if now.has_residual == 0:
        now.residual, now.has_residual = compute_norm_of_correction(arrays.residual_norm, correction, gradient), 1
    return now.residual
