"""Two-stage activation of offset geometric contact (OGC): quadratic at first contact, logarithmic near zero.

    g(d) = (r - d)^2/2                          for r/2 <= d < r,        0 beyond r
           (r/2)^2 (1/2 - ln(2 d/r))            for 0 < d < r/2

per stiffness [N/m], with the contact radius r. Both parts meet with equal values, slopes and curvatures, which
determines the factor and the point r/2. Source: Chen et al. 2025, "Offset geometric contact", ACM TOG 44(4); ipctk has
the same function as `TwoStageBarrier`.
"""

from __future__ import annotations

from springbench.solvers.jit.kernel_compilation import jit_inner


@jit_inner
def offset_force(d, radius):
    """Return -g'(d) [m] and g''(d), per stiffness.

    Args:
        d: distance [m], above 0.
        radius: contact radius r [m].
    """
    if d >= radius:
        return 0.0, 0.0
    if 2.0 * d >= radius:
        return radius - d, 1.0
    factor = 0.25 * radius * radius
    return factor / d, factor / (d * d)
