"""Attachments: springs of zero rest length from vertices to anchor points that may move.

E(p) = sum_i k_i/2 |p_i - q_i(t)|^2
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from solvers.energies.quadratic import Quadratic
from solvers.matrices import selection_matrix_sparse
from solvers.problem import Positions, Start


@dataclass(frozen=True, eq=False)
class Attachments(Quadratic):
    """Attachments of vertices; points: anchor points (m, 3) [m] as a function of time [s]."""

    points: Callable[[float], Positions]

    @classmethod
    def of(
        cls, vertices: NDArray[np.int64], stiffness: NDArray[np.float64], points: Callable[[float], Positions], n: int
    ) -> Attachments:
        """Return attachments of vertices, at time zero.

        Args:
            vertices: (m,).
            stiffness: k (m,) [N/m].
            points: anchor points (m, 3) [m] as a function of time [s].
            n: number of vertices.
        """
        return cls(selection_matrix_sparse(vertices, n), stiffness, points(0.0), points)

    def begin_step(self, start: Start) -> Attachments:
        """Return the energy of a step, with the anchor points at the time of the stage."""
        return replace(self, d=self.points(start.until))
