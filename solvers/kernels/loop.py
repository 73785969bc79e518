"""The iteration loop and the stop rule, once: as Python for the driver, and compiled into kernels.

    advance until  residual <= limit  or  residual <= floor  or nothing descends any more  or all iterations are done

`over` makes the loop of what advances a state and what measures it, `compiled_over` the same loop for kernels.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numba.extending import register_jitable

from solvers.compiling import inner_closure, inner_options

ITERATIONS, TOLERANCE, FLOOR, STALLED = range(4)
"""What ended a loop: the limit of iterations, a residual, round-off in it, or that nothing descends any more."""

NEVER, LAST, EACH = range(3)
"""Which residuals are wanted."""


class Limits(NamedTuple):
    """iterations: at most; limit, floor: residuals [J^(1/2)] that end the loop where each is asked for, the latter to
    look for round-off; wanted: which residuals are."""

    iterations: int
    limit: float
    floor: float
    wanted: int


ONE = Limits(1, 0.0, 0.0, NEVER)
"""One iteration, and no residual."""


def at_most(iterations: int) -> Limits:
    """So many iterations, and the last one's residual."""
    return Limits(iterations, 0.0, 0.0, LAST)


@register_jitable(**inner_options)
def verdict(residual, limits):
    """What a residual ends: TOLERANCE, FLOOR, or nothing, which is ITERATIONS."""
    if limits.wanted != EACH:
        return ITERATIONS
    if residual <= limits.limit:
        return TOLERANCE
    return FLOOR if residual <= limits.floor else ITERATIONS


def over(advance: Callable[..., Any], residual: Callable[..., Any]) -> Callable[..., Any]:
    """The loop over what is done to a state.

    advance(state): whether it could; an iteration that could not is none. residual(state): [J^(1/2)].
    iterate(state, limits): how many iterations were done, the last residual, nan where none was asked for, and what
    ended them.
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
    """The same for kernels, over inner ones."""
    return inner_closure(over(advance, residual))
