"""A Hessian that has a Cholesky factor: the exact one, else the nearest of a few that are more and more convex."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from solvers.core.objective import Hessian

LEVELS = ((1.0, 0.0), (0.9, 0.0), (0.5, 0.0), (0.0, 0.0), *((0.0, 10.0**k) for k in range(-4, 9, 2)))
"""What is kept of negative lateral parts, and what multiple of a diagonal is added: the first that factorises."""


def factorised(hessian: Hessian, diagonal: NDArray[np.float64], shift: NDArray[np.float64] | float = 0.0) -> int | None:
    """The level at which a Hessian with `shift` on its diagonal [N/m] was factorised, 0 for the exact one; None for
    none. diagonal: what is added multiples of, (3 f,) [N/m]."""
    return next((k for k, (keep, by) in enumerate(LEVELS) if hessian.factorise(keep, shift + by * diagonal)), None)
