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
from springbench.solvers.model.energies.edge_energy import rest_directions
from springbench.solvers.model.energies.strain_limit_energy import StrainLimits
from springbench.solvers.model.step_problem import Positions, StepStart


@dataclass(frozen=True, eq=False)
class Sewing(StrainLimits):
    """Threads between pairs of vertices.

    Attributes:
        max_length_at: maximum lengths (m,) [m] as a function of time [s].
    """

    max_length_at: Callable[[float], NDArray[np.float64]]

    @classmethod
    def from_rest_shape(
        cls,
        rest: Positions,
        pairs: NDArray[np.int64],
        stiffness: NDArray[np.float64],
        max_length_at: Callable[[float], NDArray[np.float64]],
    ) -> Sewing:
        """Return threads between pairs of vertices, at time zero.

        Args:
            rest: rest positions (n, 3) [m].
            pairs: (m, 2).
            stiffness: k (m,) [N/m].
            max_length_at: maximum lengths (m,) [m] as a function of time [s].
        """
        return cls(
            pairs, stiffness, np.zeros(len(pairs)), max_length_at(0.0), rest_directions(rest, pairs)[1], max_length_at
        )

    def begin_step(self, start: StepStart) -> Sewing:
        """Return the energy of a step, with the maximum lengths at the stage time."""
        return replace(self, max_length=self.max_length_at(start.stage_time))
