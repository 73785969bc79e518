"""Attachments: springs of zero rest length from vertices to points that may move.

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
    """Attachments of vertices; points: where their other ends are at a time [s], (m, 3) [m]."""

    points: Callable[[float], Positions]

    @classmethod
    def of(
        cls, vertices: NDArray[np.int64], stiffness: NDArray[np.float64], points: Callable[[float], Positions], n: int
    ) -> Attachments:
        """Attachments of vertices (m,) out of n with stiffness k (m,) [N/m], as they are at the time zero."""
        return cls(selection_matrix_sparse(vertices, n), stiffness, points(0.0), points)

    def begin_step(self, start: Start) -> Attachments:
        """The energy of a step: the points are where they will be at the time of the unknown."""
        return replace(self, d=self.points(start.until))
