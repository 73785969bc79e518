"""When a step along a direction descends enough, once: as Python, and within kernels.

    g(p + t d) - g(p) <= DECREASE t (slope + t curvature/2)       Armijo (1966); curvature for directions from a saddle
    grad g(p + t d) d <= (2 flatter - 1) slope                    approximate Wolfe (Hager and Zhang 2005), instead of
                                                                  it where round-off hides how far g falls

with slope = grad g(p) d. How the next length is found is the method's own: half of it, or where a parabola is least.
"""

from __future__ import annotations

from numba.extending import register_jitable

from solvers.compiling import inner_options

DECREASE = 1e-4
"""Of what the slope promises, the least that a step must bring."""


@register_jitable(**inner_options)
def falls(rise: float, length: float, slope: float, curvature: float) -> bool:
    """Whether the objective falls enough by a step of this length; rise [J]: by how much it rises."""
    return rise <= DECREASE * length * (slope + 0.5 * length * curvature)


@register_jitable(**inner_options)
def flattens(there: float, slope: float, flatter: float) -> bool:
    """Whether the slope `there` has shrunk enough from the one at the beginning [J]."""
    return there <= (2.0 * flatter - 1.0) * slope
