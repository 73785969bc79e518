"""The iteration loop and the stop rule, as Python for the driver and compiled into kernels.

    iterate until  residual <= limit  or  residual <= floor  or no step descends  or all iterations are done

`over` builds the loop from functions that advance and measure a state, `compiled_over` that for kernels.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numba.extending import register_jitable

from solvers.compiling import inner_closure, inner_options

ITERATIONS, TOLERANCE, FLOOR, STALLED = range(4)
"""The termination reason of a loop: maximum iterations, residual limit, round-off floor, or no descent."""

NEVER, LAST, EACH = range(3)
"""When residuals are computed."""


class Limits(NamedTuple):
    """The limits of a loop.

    Attributes:
        iterations: maximum number of iterations.
        limit: residual [J^(1/2)] that ends the loop, if the residual is computed in each iteration.
        floor: residual [J^(1/2)] at which the loop ends for a check of round-off.
        wanted: when residuals are computed.
    """

    iterations: int
    limit: float
    floor: float
    wanted: int


ONE = Limits(1, 0.0, 0.0, NEVER)
"""One iteration without a residual."""


def at_most(iterations: int) -> Limits:
    """Return limits of n iterations with the last residual."""
    return Limits(iterations, 0.0, 0.0, LAST)


@register_jitable(**inner_options)
def verdict(residual, limits):
    """Return the termination reason of a residual; ITERATIONS if it does not end the loop."""
    if limits.wanted != EACH:
        return ITERATIONS
    if residual <= limits.limit:
        return TOLERANCE
    return FLOOR if residual <= limits.floor else ITERATIONS


def over(advance: Callable[..., Any], residual: Callable[..., Any]) -> Callable[..., Any]:
    """Build the iteration loop of a state.

    Args:
        advance: function of the state that does an iteration and returns whether it succeeded; a failed one does not
            count.
        residual: function of the state that returns the residual [J^(1/2)].

    Returns:
        A function (state, limits) that returns the number of iterations, the last residual (nan if none was computed)
        and the termination reason.
    """

    def iterate(state: Any, limits: Any) -> Any:
        count, found, ended = 0, np.nan, ITERATIONS
        while ended == ITERATIONS and count < limits.iterations:
            moved = advance(state)
            if moved:
                count += 1
            if limits.wanted == EACH:
                found = residual(state)
                ended = verdict(found, limits)
            if ended == ITERATIONS and not moved:
                ended = STALLED
        if limits.wanted == LAST or (limits.wanted == EACH and count == 0):
            found = residual(state)
        return count, found, ended

    return iterate


def compiled_over(advance: Callable[..., Any], residual: Callable[..., Any]) -> Any:
    """Build the loop for kernels from inner functions."""
    return inner_closure(over(advance, residual))
