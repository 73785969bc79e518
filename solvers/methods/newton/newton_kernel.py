"""Compiled iterations of Newton's method with the exact Hessian, for springs and quadratic forms.

    p <- p - t H^-1 grad g(p)

`springbench.solvers.methods.newton.newton_direct` describes the method.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_inner_options, jit_kernel
from springbench.solvers.kernels.descent_search import (
    SearchArrays,
    exceeds_roundoff,
    move_to_trial,
    search_backtracking,
)
from springbench.solvers.kernels.iteration_loop import (
    REASON_ITERATIONS,
    build_compiled_loop,
    check_residual,
    needs_residual,
)
from springbench.solvers.kernels.objective_kernels import (
    change_objective,
    compute_inner_product,
    compute_product_with_displacement,
)
from springbench.solvers.kernels.residual_norm import compute_residual_norm
from springbench.solvers.kernels.spring_hessian import BlockIndices, assemble_hessian
from springbench.solvers.linalg.cholesky.block_cholesky import KernelFactor
from springbench.solvers.linalg.cholesky.block_multifrontal import run_stages

NEWTON_PROGRESS_DTYPE = np.dtype(
    [
        ("is_stalled", np.int64),  # whether round-off prevents descent from the current point
        ("num_factorisations", np.int64),  # that succeeded in the last call
        ("failed_supernode", np.int64),  # at which the last one failed in the last call, -1 for none
        ("steepest_slope", np.float64),  # of the solve [J], positive
        ("has_residual", np.int64),  # whether the residual at the current point is known
        ("residual", np.float64),  # [J^(1/2)]
        ("slope", np.float64),  # of measured steps: along the last displacement [J], positive
        ("agrees_with_model", np.int64),  # of measured steps: whether the decrease in the last one agreed
        ("decrement_ratio", np.float64),  # g'H^-1 g after over before the last step that agreed
    ]
)
"""The progress of a solve."""

_MODEL_RANGE = (0.3, 0.7)
"""Range of the decrease, as a fraction of the slope, in which a step agrees with the quadratic model: half of it for a
full step on a quadratic function, three quarters for half a step."""


@register_jitable(**jit_inner_options)
def agrees_with_model(decrease: float, slope: float) -> bool:
    """Return whether the decrease in a step agrees with the quadratic model.

    Args:
        decrease: decrease of the objective [J]; zero if it is round-off.
        slope: derivative along the displacement at its start [J], positive for descent.
    """
    return decrease == 0.0 or _MODEL_RANGE[0] * slope <= decrease <= _MODEL_RANGE[1] * slope


class NewtonArrays(NamedTuple):
    """Arrays of the iteration for one system.

    Attributes:
        search: springs and quadratic forms, line search and residual.
        block_indices: indices of the Hessian's blocks.
        constant_blocks: blocks of inertia, penalty pins and the form (b, 3, 3) [N/m].
        tensions: empty, for the tensions at the positions.
        values: scratch, blocks of the Hessian (b, 3, 3) [N/m].
        factor: factor of the Hessian, overwritten.
        solution: scratch, at the free vertices (f, 3) [m].
        direction: scratch (n, 3) [m], zero at vertices that are not free.
    """

    search: SearchArrays
    block_indices: BlockIndices
    constant_blocks: NDArray[np.float64]
    tensions: NDArray[np.float64]
    values: NDArray[np.float64]
    factor: KernelFactor
    solution: NDArray[np.float64]
    direction: NDArray[np.float64]


@jit_inner
def _take_exact_step(state):
    """Do a step; return whether the positions changed."""
    arrays, _, _, p, gradient, progress = state
    if progress[0].is_stalled == 1 or not _find_exact_step(state):
        return False
    move_to_trial(arrays.search, p, gradient)
    progress[0].has_residual = 0
    return True


@jit_inner
def _find_exact_step(state):
    """Find the trial point of a step; return whether there is one."""
    arrays, step_data, exact_pins, p, gradient, progress = state
    now, direction = progress[0], arrays.direction
    now.failed_supernode = _factorise_and_solve(arrays, p, gradient)
    if now.failed_supernode >= 0:
        return False
    now.num_factorisations += 1
    slope = compute_inner_product(gradient, direction)
    now.steepest_slope = max(now.steepest_slope, -slope)
    if not exceeds_roundoff(arrays.search, p, -slope) or not search_backtracking(
        arrays.search, step_data, exact_pins, p, direction, 1.0, slope
    ):
        now.is_stalled = 1
        return False
    return True


@jit_inner
def _factorise_and_solve(arrays, p, gradient):
    """Write the direction -H^-1 g; return the supernode at which the factorisation failed, or -1."""
    assemble_hessian(
        arrays.search.objective_terms,
        arrays.block_indices,
        arrays.constant_blocks,
        p,
        arrays.tensions,
        1.0,
        arrays.values,
    )
    return solve_negative(arrays, arrays.factor.schedule, gradient)


@jit_inner
def solve_negative(arrays, schedule, gradient):
    """Write the direction -H^-1 g.

    Args:
        arrays: arrays of the system, with the blocks of the Hessian.
        schedule: schedule of the factor, to factorise the Hessian first or to solve with the last factor.
        gradient: gradient g (n, 3) [N].

    Returns:
        The supernode at which the factorisation failed, or -1.
    """
    free, x, factor = arrays.block_indices.free_vertices, arrays.solution, arrays.factor
    for k in range(len(free)):
        for c in range(3):
            x[k, c] = gradient[free[k], c]
    failed = run_stages(
        factor.fronts, schedule, arrays.values, factor.panels, x, factor.scratch, factor.thread_team, None
    )
    if failed < 0:
        for k in range(len(free)):
            for c in range(3):
                arrays.direction[free[k], c] = -x[k, c]
    return failed


@jit_inner
def _compute_residual(state):
    arrays, _, _, _, gradient, progress = state
    now = progress[0]
    if now.has_residual == 0:
        now.residual, now.has_residual = compute_residual_norm(arrays.search.residual_norm, gradient), 1
    return now.residual


_iterate_loop = build_compiled_loop(_take_exact_step, _compute_residual)


@jit_kernel
def run_exact_steps(arrays, step_data, exact_pins, limits, p, gradient, progress):
    """Run the iteration loop (`springbench.solvers.kernels.iteration_loop`) until the Hessian has no factor.

    The termination reason is then REASON_STALLED, and `failed_supernode` is not negative.

    Args:
        arrays: arrays of the system.
        step_data: data of the step.
        exact_pins: exactly pinned vertices and their targets.
        limits: limits of the loop, in iterations.
        p: positions (n, 3) [m], updated.
        gradient: gradient there (n, 3) [N], updated.
        progress: progress of the solve (1,), updated; zero at the start.

    Returns:
        Number of iterations, last residual [J^(1/2)] and termination reason.
    """
    progress[0].num_factorisations, progress[0].failed_supernode = 0, -1
    return _iterate_loop((arrays, step_data, exact_pins, p, gradient, progress), limits)


@jit_kernel
def run_measured_steps(arrays, step_data, exact_pins, limits, max_ratio, p, gradient, decreases, progress):
    """Run steps as long as they agree with the quadratic model and converge fast enough.

    The convergence of a step is measured by the ratio of the squared Newton decrements g'H^-1 g after and before it,
    both with the Hessian before it.

    Args:
        arrays: arrays of the system.
        step_data: data of the step.
        exact_pins: exactly pinned vertices and their targets.
        limits: limits of the loop, in iterations.
        max_ratio: largest ratio at which the steps continue.
        p: positions (n, 3) [m], updated.
        gradient: gradient there (n, 3) [N], updated.
        decreases: output, decrease of the objective in each step [J]; its length limits their number.
        progress: progress of the solve (1,), updated. If the Hessian had no factor, `failed_supernode` is not negative;
            if no step was found, `is_stalled` is 1.

    Returns:
        Number of iterations, last residual [J^(1/2)] or NaN, and termination reason.
    """
    state, now = (arrays, step_data, exact_pins, p, gradient, progress), progress[0]
    count, residual, ended = 0, np.nan, REASON_ITERATIONS
    now.num_factorisations, now.failed_supernode, now.is_stalled = 0, -1, 0
    now.agrees_with_model, now.decrement_ratio = 1, 0.0
    while (
        count < min(limits.max_iterations, len(decreases))
        and ended == REASON_ITERATIONS
        and now.agrees_with_model == 1
        and now.decrement_ratio <= max_ratio
    ):
        if not _take_measured_step(state, decreases[count:]):
            break
        count += 1
        if needs_residual(limits, count):
            residual = compute_residual_norm(arrays.search.residual_norm, gradient)
            ended = check_residual(residual, limits)
    return count, residual, ended


@jit_inner
def _take_measured_step(state, decrease):
    """Do a step, and compare it with the quadratic model; return whether the positions changed."""
    arrays, step_data, _, p, gradient, progress = state
    now, search, q = progress[0], arrays.search, arrays.search.trial_positions
    if not _find_exact_step(state):
        return False
    slope = -compute_product_with_displacement(gradient, p, q)
    decrease[0] = max(0.0, -change_objective(search.objective_terms, search.quadratic_form, step_data, p, q))
    move_to_trial(search, p, gradient)
    now.slope, now.agrees_with_model = slope, 0
    if agrees_with_model(decrease[0], slope):
        now.agrees_with_model = 1
        if slope > 0.0:
            solve_negative(arrays, arrays.factor.solve_schedule, gradient)
            now.decrement_ratio = -compute_inner_product(gradient, arrays.direction) / slope
    return True
