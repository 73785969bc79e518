"""Velocity filters that act before a step.

    decay            v <- k v                      of dv/dt = -c v, k = exp(-c dt)
    quadratic drag   v <- m v / (m + c dt |v|)     of m dv/dt = -c |v| v

Both are exact solutions over the step and therefore stable for any step size. Any other function of the velocity can
also be a filter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.model.step_problem import Positions


@dataclass(frozen=True, slots=True)
class ExponentialDecay:
    """Exponential decay of the velocity by `decay_factor` per step."""

    decay_factor: float

    def __call__(self, v: Positions) -> Positions:
        """Return the filtered velocity [m/s], (n, 3)."""
        return self.decay_factor * v


@dataclass(frozen=True, slots=True, eq=False)
class QuadraticDrag:
    """Quadratic drag.

    Attributes:
        mass: m (n,) [kg].
        drag_coefficient: c dt (n,) [kg s/m].
    """

    mass: NDArray[np.float64]
    drag_coefficient: NDArray[np.float64]

    def __call__(self, v: Positions) -> Positions:
        """Return the filtered velocity [m/s], (n, 3)."""
        drag, mass = self.drag_coefficient * np.linalg.norm(v, axis=1), self.mass
        return v * np.divide(mass, mass + drag, out=np.ones_like(mass), where=drag > 0.0)[:, None]
