"""Sewing springs: threads between vertices that shorten over time.

    E(p) = sum_e k_e/2 max(0, |p_i - p_j| - l_e(t))^2

A thread pulls if it is longer than its limit at the time of the stage, and never pushes. So these are strain limits
whose maximum length decreases.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from solvers.energies.edges import rest_directions
from solvers.energies.strain_limits import StrainLimits
from solvers.problem import Positions, Start


@dataclass(frozen=True, eq=False)
class Sewing(StrainLimits):
    """Threads; longest: their maximum lengths (m,) [m] as a function of time [s]."""

    longest: Callable[[float], NDArray[np.float64]]

    @classmethod
    def of(
        cls,
        rest: Positions,
        pairs: NDArray[np.int64],
        stiffness: NDArray[np.float64],
        longest: Callable[[float], NDArray[np.float64]],
    ) -> Sewing:
        """Return threads between pairs of vertices, at time zero.

        Args:
            rest: rest positions (n, 3) [m].
            pairs: (m, 2).
            stiffness: k (m,) [N/m].
            longest: maximum lengths (m,) [m] as a function of time [s].
        """
        return cls(pairs, stiffness, np.zeros(len(pairs)), longest(0.0), rest_directions(rest, pairs)[1], longest)

    def begin_step(self, start: Start) -> Sewing:
        """Return the energy of a step, with the maximum lengths at the time of the stage."""
        return replace(self, high=self.longest(start.until))
