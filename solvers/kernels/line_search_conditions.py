"""Conditions of sufficient decrease of a line search, for Python and for kernels.

    g(p + t d) - g(p) <= ARMIJO_FRACTION t (slope + t curvature/2)    Armijo (1966); curvature for steps from a saddle
    grad g(p + t d) d <= (2 wolfe_fraction - 1) slope                 approximate Wolfe (Hager and Zhang 2005), if
                                                                      round-off hides the decrease of g

with slope = grad g(p) d. Each method chooses the next step size itself: half of it, or the minimum of a parabola.
"""

from __future__ import annotations

from numba.extending import register_jitable
from springbench.solvers.jit.kernel_compilation import jit_inner_options

ARMIJO_FRACTION = 1e-4
"""Smallest decrease of a step, as a fraction of the linear prediction."""

MAX_HALVINGS = 60
"""Maximum number of halvings; after it a step has no significant digit left."""


@register_jitable(**jit_inner_options)
def is_armijo_step(objective_change: float, step_size: float, slope: float, curvature: float) -> bool:
    """Return whether the objective decreases enough for a step size.

    Args:
        objective_change: g(p + t d) - g(p) [J].
        step_size: t, as a multiple of the direction.
        slope, curvature: first and second derivative along the direction at p [J].
    """
    return objective_change <= ARMIJO_FRACTION * step_size * (slope + 0.5 * step_size * curvature)


@register_jitable(**jit_inner_options)
def is_approximate_wolfe_step(new_slope: float, slope: float, wolfe_fraction: float) -> bool:
    """Return whether the slope has decreased enough.

    Args:
        new_slope: derivative along the direction at the new point [J].
        slope: derivative along the direction at the initial point [J].
        wolfe_fraction: fraction of the condition, below 1/2.
    """
    return new_slope <= (2.0 * wolfe_fraction - 1.0) * slope
