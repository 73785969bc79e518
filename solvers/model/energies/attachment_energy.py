"""Attachments: springs of zero rest length from vertices to anchor points that may move.

E(p) = sum_i k_i/2 |p_i - q_i(t)|^2
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.model.energies.quadratic_energy import Quadratic
from springbench.solvers.model.step_problem import Positions, StepStart
from springbench.solvers.model.system_matrix_assembly import selection_matrix_sparse


@dataclass(frozen=True, eq=False)
class Attachments(Quadratic):
    """Attachments of vertices.

    Attributes:
        anchor_positions_at: anchor points (m, 3) [m] as a function of time [s].
    """

    anchor_positions_at: Callable[[float], Positions]

    @classmethod
    def from_vertices(
        cls,
        vertices: NDArray[np.int64],
        stiffness: NDArray[np.float64],
        anchor_positions_at: Callable[[float], Positions],
        n: int,
    ) -> Attachments:
        """Return attachments of vertices, at time zero.

        Args:
            vertices: (m,).
            stiffness: k (m,) [N/m].
            anchor_positions_at: anchor points (m, 3) [m] as a function of time [s].
            n: number of vertices.
        """
        return cls(selection_matrix_sparse(vertices, n), stiffness, anchor_positions_at(0.0), anchor_positions_at)

    def begin_step(self, start: StepStart) -> Attachments:
        """Return the energy of a step, with the anchor points at the stage time."""
        return replace(self, d=self.anchor_positions_at(start.stage_time))
