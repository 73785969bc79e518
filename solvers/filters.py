"""Filters of the velocity before a step; any other function of it may be one.

    decay            v <- kept v                   of dv/dt = -c v, kept = exp(-c dt)
    quadratic drag   v <- m v / (m + c dt |v|)     of m dv/dt = -c |v| v

Both are exact solutions over the step, and stable at any length of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from solvers.problem import Positions


@dataclass(frozen=True, slots=True)
class Decay:
    """kept: what is left of the velocity."""

    kept: float

    def __call__(self, v: Positions) -> Positions:
        """The changed velocity [m/s], (n, 3)."""
        return self.kept * v


@dataclass(frozen=True, slots=True, eq=False)
class QuadraticDrag:
    """mass: m (n,) [kg]; coefficient: c dt (n,) [kg s/m]."""

    mass: NDArray[np.float64]
    coefficient: NDArray[np.float64]

    def __call__(self, v: Positions) -> Positions:
        """The changed velocity [m/s], (n, 3)."""
        drag, mass = self.coefficient * np.linalg.norm(v, axis=1), self.mass
        return v * np.divide(mass, mass + drag, out=np.ones_like(mass), where=drag > 0.0)[:, None]
