"""Velocity filters that act before a step; any other function of the velocity can be one.

    decay            v <- k v                      of dv/dt = -c v, k = exp(-c dt)
    quadratic drag   v <- m v / (m + c dt |v|)     of m dv/dt = -c |v| v

Both are exact solutions over the step and therefore stable for any step size.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from solvers.problem import Positions


@dataclass(frozen=True, slots=True)
class Decay:
    """Exponential decay of the velocity by `kept` per step."""

    kept: float

    def __call__(self, v: Positions) -> Positions:
        """Return the filtered velocity [m/s], (n, 3)."""
        return self.kept * v


@dataclass(frozen=True, slots=True, eq=False)
class QuadraticDrag:
    """Quadratic drag. mass: m (n,) [kg]; coefficient: c dt (n,) [kg s/m]."""

    mass: NDArray[np.float64]
    coefficient: NDArray[np.float64]

    def __call__(self, v: Positions) -> Positions:
        """Return the filtered velocity [m/s], (n, 3)."""
        drag, mass = self.coefficient * np.linalg.norm(v, axis=1), self.mass
        return v * np.divide(mass, mass + drag, out=np.ones_like(mass), where=drag > 0.0)[:, None]
