"""Compiled iterations of nonlinear conjugate gradients, for springs and quadratic forms.

The preconditioner is a factor of Q. `springbench.solvers.methods.quasi_newton.nonlinear_cg` describes the method.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_kernel
from springbench.solvers.kernels.descent_search import (
    SearchArrays,
    exceeds_roundoff,
    move_to_trial,
    read_residual,
    search_backtracking,
)
from springbench.solvers.kernels.iteration_loop import build_compiled_loop
from springbench.solvers.kernels.objective_kernels import compute_inner_product
from springbench.solvers.kernels.spring_hessian import linearise_springs, multiply_hessian
from springbench.solvers.linalg.cholesky.triangular_solve import solve_supernodal

CONJUGATE_PROGRESS_DTYPE = np.dtype(
    [
        ("is_started", np.int64),
        ("beta", np.float64),  # multiple of the last direction in the next one
        ("has_residual", np.int64),  # whether the residual at the current point is known
        ("residual", np.float64),  # [J^(1/2)]
    ]
)
"""The progress of a solve."""


class NonlinearCGArrays(NamedTuple):
    """Arrays of the iteration for one system.

    Attributes:
        search: springs and quadratic forms, line search and residual, with the factor of Q.
        linear_terms: scratch, the linearised springs (m, 4).
        hessian_product: scratch, Hessian times direction (n, 3) [N].
        gradient_change, correction_change: scratch, changes y of the gradient [N] and w of the correction [m], (n, 3).
    """

    search: SearchArrays
    linear_terms: NDArray[np.float64]
    hessian_product: NDArray[np.float64]
    gradient_change: NDArray[np.float64]
    correction_change: NDArray[np.float64]


@jit_inner
def _take_step(state):
    """Do a step; return whether the positions changed."""
    arrays, step_data, exact_pins, p, gradient, correction, direction, progress = state
    now, slope = progress[0], -compute_inner_product(gradient, correction)
    if not exceeds_roundoff(arrays.search, p, -slope):
        return False
    linearise_springs(arrays.search.objective_terms, p, arrays.linear_terms)
    found = False
    if now.beta != 0.0:
        _combine_directions(now.beta, direction, correction)
        found = _search_quadratic_model(state, compute_inner_product(gradient, direction))
    if not found:
        _combine_directions(0.0, direction, correction)
        found = _search_quadratic_model(state, slope) or search_backtracking(
            arrays.search, step_data, exact_pins, p, direction, 1.0, slope
        )
    if found:
        _accept_trial(state)
    return found


@jit_inner
def _combine_directions(beta, direction, correction):
    """Write beta d - z to d."""
    for v in range(len(direction)):
        for c in range(3):
            direction[v, c] = beta * direction[v, c] - correction[v, c]


@jit_inner
def _search_quadratic_model(state, slope):
    """Search along the direction, first at the quadratic model's minimum; return whether it descends."""
    arrays, step_data, exact_pins, p, _, _, direction, _ = state
    terms, form, product = arrays.search.objective_terms, arrays.search.quadratic_form, arrays.hessian_product
    multiply_hessian(terms, arrays.linear_terms, form, None, None, direction, product)
    curvature = compute_inner_product(direction, product)  # the direction vanishes at exactly pinned vertices
    return slope < 0.0 < curvature and search_backtracking(
        arrays.search, step_data, exact_pins, p, direction, -slope / curvature, slope
    )


@jit_inner
def _accept_trial(state):
    """Move to the trial, and compute the correction there and beta."""
    arrays, _, _, p, gradient, correction, direction, progress = state
    y, w, now = arrays.gradient_change, arrays.correction_change, progress[0]
    for v in range(len(p)):
        for c in range(3):
            y[v, c], w[v, c] = arrays.search.trial_gradient[v, c] - gradient[v, c], correction[v, c]
    move_to_trial(arrays.search, p, gradient)
    solve_supernodal(arrays.search.residual_norm.factor, gradient, correction, None)
    for v in range(len(p)):
        for c in range(3):
            w[v, c] = correction[v, c] - w[v, c]
    now.beta, now.has_residual = 0.0, 0
    change = compute_inner_product(direction, y)
    if change > 0.0:
        slope = compute_inner_product(gradient, direction)
        beta = compute_inner_product(y, correction) - compute_inner_product(w, y) * slope / change
        now.beta = beta / change if np.isfinite(beta) else 0.0


@jit_inner
def _compute_residual(state):
    arrays, _, _, _, gradient, correction, _, progress = state
    return read_residual(arrays.search, correction, gradient, progress)


_conjugate_loop = build_compiled_loop(_take_step, _compute_residual)


@jit_kernel
def run_nonlinear_cg(arrays, step_data, exact_pins, limits, p, gradient, correction, direction, progress):
    """Run the iteration loop (`springbench.solvers.kernels.iteration_loop`).

    Args:
        arrays: arrays of the system.
        step_data: data of the step.
        exact_pins: exactly pinned vertices and their targets.
        limits: limits of the loop, in iterations.
        p: positions (n, 3) [m], updated.
        gradient: gradient g there (n, 3) [N], updated.
        correction: z = Q^-1 g (n, 3) [m], updated; zero at the start.
        direction: last direction d (n, 3) [m], updated; zero at the start.
        progress: progress of the solve (1,), updated; zero at the start.

    Returns:
        Number of iterations, last residual [J^(1/2)] and termination reason.
    """
    if progress[0].is_started == 0:
        solve_supernodal(arrays.search.residual_norm.factor, gradient, correction, None)
        progress[0].is_started = 1
    return _conjugate_loop((arrays, step_data, exact_pins, p, gradient, correction, direction, progress), limits)
