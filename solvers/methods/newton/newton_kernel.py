"""Compiled iterations of Newton's method with the exact Hessian, for springs and quadratic forms.

    p <- p - t H^-1 grad g(p)

`springbench.solvers.methods.newton.newton_direct` describes the method.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_kernel
from springbench.solvers.kernels.iteration_loop import build_compiled_loop
from springbench.solvers.kernels.objective_kernels import (
    ObjectiveTerms,
    compute_inner_product,
    compute_max_magnitude,
    search_backtracking,
)
from springbench.solvers.kernels.quadratic_form_kernels import QuadraticForm
from springbench.solvers.kernels.residual_norm import ResidualNorm, compute_residual_norm
from springbench.solvers.kernels.spring_hessian import BlockIndices, assemble_hessian
from springbench.solvers.linalg.cholesky.block_cholesky import KernelFactor
from springbench.solvers.linalg.cholesky.block_multifrontal import run_stages
from springbench.solvers.model.rounding_bound import EPS

NEWTON_PROGRESS_DTYPE = np.dtype(
    [
        ("steepest_slope", np.float64),  # of the solve [J], positive
        ("residual", np.float64),  # at the current point [J^(1/2)]; negative: not yet known
        ("is_stalled", np.int64),  # whether round-off prevents descent from there
        ("num_factorisations", np.int64),  # that succeeded in the last call
        ("failed_supernode", np.int64),  # at which the last one failed in the last call, -1 for none
    ]
)
"""The progress of a solve."""


class NewtonArrays(NamedTuple):
    """Arrays of the iteration for one system.

    Attributes:
        terms: springs, inertia and penalty pins.
        form: sum of the quadratic forms.
        block_indices: indices of the Hessian's blocks.
        constant_blocks: blocks of inertia, penalty pins and the form (b, 3, 3) [N/m].
        tensions: empty, for the tensions at the positions.
        values: scratch, blocks of the Hessian (b, 3, 3) [N/m].
        factor: factor of the Hessian, overwritten.
        unpinned_trace: trace of the unpinned part of Q [N/m].
        norm: norm of residuals.
        solution: scratch, at the free vertices (f, 3) [m].
        direction: scratch (n, 3) [m], zero at vertices that are not free.
        trial_positions, trial_gradient: scratch, (n, 3) [m] and [N].
    """

    terms: ObjectiveTerms
    form: QuadraticForm
    block_indices: BlockIndices
    constant_blocks: NDArray[np.float64]
    tensions: NDArray[np.float64]
    values: NDArray[np.float64]
    factor: KernelFactor
    unpinned_trace: float
    norm: ResidualNorm
    solution: NDArray[np.float64]
    direction: NDArray[np.float64]
    trial_positions: NDArray[np.float64]
    trial_gradient: NDArray[np.float64]


@jit_inner
def _take_exact_step(state):
    """Do a step; return whether the positions changed."""
    arrays, step_data, exact_pins, p, gradient, progress = state
    now, free, x, direction = progress[0], arrays.block_indices.free_vertices, arrays.solution, arrays.direction
    if now.is_stalled == 1:
        return False
    assemble_hessian(arrays.terms, arrays.block_indices, arrays.constant_blocks, p, arrays.tensions, 1.0, arrays.values)
    for k in range(len(free)):
        for c in range(3):
            x[k, c] = gradient[free[k], c]
    factor = arrays.factor
    failed = run_stages(
        factor.fronts, factor.schedule, arrays.values, factor.panels, x, factor.scratch, factor.thread_team, None
    )
    now.failed_supernode = failed
    if failed >= 0:
        return False
    now.num_factorisations += 1
    for k in range(len(free)):
        for c in range(3):
            direction[free[k], c] = -x[k, c]
    slope = compute_inner_product(gradient, direction)
    now.steepest_slope = max(now.steepest_slope, -slope)
    now.is_stalled = 1
    if not -slope > (EPS * compute_max_magnitude(p)) ** 2 * arrays.unpinned_trace:
        return False
    q, following = arrays.trial_positions, arrays.trial_gradient
    if not search_backtracking(arrays.terms, arrays.form, step_data, exact_pins, p, direction, slope, q, following):
        return False
    now.is_stalled = 0
    for v in range(len(p)):
        for c in range(3):
            p[v, c], gradient[v, c] = q[v, c], following[v, c]
    now.residual = -1.0
    return True


@jit_inner
def _compute_residual(state):
    arrays, _, _, _, gradient, progress = state
    now = progress[0]
    if now.residual < 0.0:
        now.residual = compute_residual_norm(arrays.norm, gradient)
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
        progress: progress of the solve (1,), updated.

    Returns:
        Number of iterations, last residual [J^(1/2)] and termination reason.
    """
    progress[0].num_factorisations, progress[0].failed_supernode = 0, -1
    return _iterate_loop((arrays, step_data, exact_pins, p, gradient, progress), limits)
