"""Sewing springs: threads from vertex to vertex that are drawn in over time.

    E(p) = sum_e k_e/2 max(0, |p_i - p_j| - l_e(t))^2

A thread pulls where it is longer than it may be at the time of the unknown, and never pushes: strain limits whose
longest length shrinks.
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
    """Threads; longest: their lengths at a time [s], (m,) [m]."""

    longest: Callable[[float], NDArray[np.float64]]

    @classmethod
    def of(
        cls,
        rest: Positions,
        pairs: NDArray[np.int64],
        stiffness: NDArray[np.float64],
        longest: Callable[[float], NDArray[np.float64]],
    ) -> Sewing:
        """Threads between pairs (m, 2) of a rest shape (n, 3) [m] with stiffness k (m,) [N/m], as at the time zero."""
        return cls(pairs, stiffness, np.zeros(len(pairs)), longest(0.0), rest_directions(rest, pairs)[1], longest)

    def begin_step(self, start: Start) -> Sewing:
        """The energy of a step: threads are as long as they will be at the time of the unknown."""
        return replace(self, high=self.longest(start.until))
