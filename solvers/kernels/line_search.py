"""Conditions of sufficient decrease of a line search, for Python and for kernels.

    g(p + t d) - g(p) <= DECREASE t (slope + t curvature/2)    Armijo (1966); curvature for steps from a saddle
    grad g(p + t d) d <= (2 flatter - 1) slope                 approximate Wolfe (Hager and Zhang 2005), if
                                                                      round-off hides the decrease of g

with slope = grad g(p) d. Each method chooses the next step size itself: half of it, or the minimum of a parabola.
"""

from __future__ import annotations

from numba.extending import register_jitable

from solvers.compiling import inner_options

DECREASE = 1e-4
"""Smallest decrease of a step, as a fraction of the linear prediction."""


@register_jitable(**inner_options)
def falls(rise: float, length: float, slope: float, curvature: float) -> bool:
    """Return whether the objective decreases enough for a step size, given its change [J]."""
    return rise <= DECREASE * length * (slope + 0.5 * length * curvature)


@register_jitable(**inner_options)
def flattens(there: float, slope: float, flatter: float) -> bool:
    """Return whether the slope [J] at the new point has decreased enough from the initial one."""
    return there <= (2.0 * flatter - 1.0) * slope
