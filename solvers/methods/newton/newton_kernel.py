"""Compiled iterations of Newton's method with the exact Hessian, for springs and quadratic forms.

    p <- p - t H^-1 grad g(p)

`springbench.solvers.methods.newton.newton_direct` describes the method.
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
    search_backtracking,
)
from springbench.solvers.kernels.iteration_loop import build_compiled_loop
from springbench.solvers.kernels.objective_kernels import compute_inner_product
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
    ]
)
"""The progress of a solve."""


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
    arrays, step_data, exact_pins, p, gradient, progress = state
    now, direction = progress[0], arrays.direction
    if now.is_stalled == 1:
        return False
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
    move_to_trial(arrays.search, p, gradient)
    now.has_residual = 0
    return True


@jit_inner
def _factorise_and_solve(arrays, p, gradient):
    """Write the direction -H^-1 g; return the supernode at which the factorisation failed, or -1."""
    free, x, factor = arrays.block_indices.free_vertices, arrays.solution, arrays.factor
    assemble_hessian(
        arrays.search.objective_terms,
        arrays.block_indices,
        arrays.constant_blocks,
        p,
        arrays.tensions,
        1.0,
        arrays.values,
    )
    for k in range(len(free)):
        for c in range(3):
            x[k, c] = gradient[free[k], c]
    failed = run_stages(
        factor.fronts, factor.schedule, arrays.values, factor.panels, x, factor.scratch, factor.thread_team, None
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
