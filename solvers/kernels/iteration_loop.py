"""The iteration loop and the stop rule, for the Python driver and for kernels.

    iterate until  residual <= limit  or  residual <= floor  or no step descends  or all iterations are done

`build_loop` builds the loop from functions that advance and measure a state, `build_compiled_loop` that for kernels.
The threads of `springbench.solvers.kernels.local_global_iteration` interleave the iterations with the substitutions of
a factor; they have the same limits and `check_residual`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numba.extending import register_jitable
from springbench.solvers.jit.kernel_compilation import jit_closure, jit_inner_options

REASON_ITERATIONS, REASON_TOLERANCE, REASON_FLOOR, REASON_STALLED = range(4)
"""The termination reason of a loop: maximum iterations, residual limit, round-off floor, or no descent."""

RESIDUAL_NEVER, RESIDUAL_LAST, RESIDUAL_EACH = range(3)
"""When residuals are computed: never, after the last iteration, or in each one."""


class LoopLimits(NamedTuple):
    """The limits of a loop.

    Attributes:
        max_iterations: maximum number of iterations.
        residual_limit: residual [J^(1/2)] that ends the loop, if the residual is computed in each iteration.
        residual_floor: residual [J^(1/2)] at which the loop ends for a check of round-off.
        residual_mode: when residuals are computed.
    """

    max_iterations: int
    residual_limit: float
    residual_floor: float
    residual_mode: int


ONE_ITERATION = LoopLimits(1, 0.0, 0.0, RESIDUAL_NEVER)
"""One iteration without a residual."""


NO_ITERATIONS = LoopLimits(0, 0.0, 0.0, RESIDUAL_LAST)
"""No iteration, but the residual."""


def iteration_limit(iterations: int) -> LoopLimits:
    """Return limits of n iterations with the last residual."""
    return LoopLimits(iterations, 0.0, 0.0, RESIDUAL_LAST)


@register_jitable(**jit_inner_options)
def needs_residual(limits, count):
    """Return whether the residual after a number of iterations is needed.

    Args:
        limits: limits of the loop.
        count: number of iterations.
    """
    is_last = count == limits.max_iterations
    return limits.residual_mode == RESIDUAL_EACH or (limits.residual_mode == RESIDUAL_LAST and is_last)


@register_jitable(**jit_inner_options)
def check_residual(residual, limits):
    """Return the termination reason of a residual.

    Args:
        residual: residual [J^(1/2)].
        limits: limits of the loop; they end it only if the residual is computed in each iteration.

    Returns:
        REASON_TOLERANCE, REASON_FLOOR, or REASON_ITERATIONS if the residual does not end the loop.
    """
    if limits.residual_mode != RESIDUAL_EACH:
        return REASON_ITERATIONS
    if residual <= limits.residual_limit:
        return REASON_TOLERANCE
    return REASON_FLOOR if residual <= limits.residual_floor else REASON_ITERATIONS


def build_loop(
    run_unchecked: Callable[..., Any], residual: Callable[..., Any], iterations_until_residual: Callable[..., Any]
) -> Callable[..., Any]:
    """Build the iteration loop of a state.

    Args:
        run_unchecked: function of the state and a number of iterations that does them and returns how many succeeded;
            after the first failed one it does no more.
        residual: function of the state that returns the residual [J^(1/2)].
        iterations_until_residual: function of the state that returns the number of iterations up to the next residual
            that may end the loop.

    Returns:
        A function (state, limits) that returns the number of iterations, the last residual (nan if none was computed)
        and the termination reason.
    """

    def iterate(state: Any, limits: Any) -> Any:
        count, found, ended = 0, np.nan, REASON_ITERATIONS
        while ended == REASON_ITERATIONS and count < limits.max_iterations:
            requested = limits.max_iterations - count
            if limits.residual_mode == RESIDUAL_EACH:
                requested = min(iterations_until_residual(state), requested)
            done = run_unchecked(state, requested)
            count += done
            if limits.residual_mode == RESIDUAL_EACH:
                found = residual(state)
                ended = check_residual(found, limits)
            if ended == REASON_ITERATIONS and done < requested:
                ended = REASON_STALLED
        if limits.residual_mode == RESIDUAL_LAST or (limits.residual_mode == RESIDUAL_EACH and count == 0):
            found = residual(state)
        return count, found, ended

    return iterate


def build_unchecked_steps(step_state: Callable[..., Any]) -> Any:
    """Build the kernel function that does iterations of a state without computing residuals.

    Args:
        step_state: does an iteration and returns whether it succeeded.

    Returns:
        The `run_unchecked` of `build_loop`.
    """

    @jit_closure
    def run_unchecked(state, num_iterations):
        for count in range(num_iterations):
            if not step_state(state):
                return count
        return num_iterations

    return run_unchecked


def build_compiled_loop(step_state: Callable[..., Any], residual: Callable[..., Any]) -> Any:
    """Build the loop for kernels from inner functions of the state.

    Args:
        step_state: does an iteration and returns whether it succeeded.
        residual: returns the residual [J^(1/2)].
    """

    @jit_closure
    def iterations_until_residual(state):
        return 1

    return jit_closure(build_loop(build_unchecked_steps(step_state), residual, iterations_until_residual))
