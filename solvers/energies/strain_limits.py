"""Strain limits: an edge resists only where it is longer or shorter than it may be (Bouaziz et al. 2014, section 5.1).

    E(p) = sum_e k_e/2 (|v_e| - t_e)^2,   v = A p,   t_e = min(max(|v_e|, low_e), high_e)

The nearest vector of an allowed length is d_e = t_e v_e/|v_e|: a projective energy, whose A'KA is in Q even while no
limit is reached.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from solvers.energies.edges import TINY, Edges, directions
from solvers.problem import Positions


@dataclass(frozen=True, eq=False)
class StrainLimits(Edges):
    """Edges whose lengths are limited.

    low, high: the lengths allowed (m,) [m], 0 <= low <= high; rest_direction: (m, 3), unit vectors that edges of zero
    length take.
    """

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    rest_direction: NDArray[np.float64]

    def _beyond(self, p: Positions) -> tuple[Positions, NDArray[np.float64], NDArray[np.float64], Positions]:
        """v (m, 3), the length |v| and by how much it is beyond the limits (m,), the directions (m, 3)."""
        v = self._along(p)
        length, unit = directions(v, self.rest_direction)
        return v, length, length - np.clip(length, self.low, self.high), unit

    def value(self, p: Positions) -> float:
        """The energy [J] at p, shape (n, 3); zero within the limits."""
        _, _, beyond, _ = self._beyond(p)
        return 0.5 * float(self.stiffness @ beyond**2)

    def add_gradient(self, p: Positions, out: Positions) -> None:
        """Add the gradient [N], shape (n, 3), to `out`."""
        _, _, beyond, unit = self._beyond(p)
        self._add(beyond[:, None] * unit, out)

    def add_projection(self, p: Positions, out: Positions) -> None:
        """The local step: add A'K d(p) [N], shape (n, 3), to `out`."""
        v, _, beyond, unit = self._beyond(p)
        self._add(v - beyond[:, None] * unit, out)

    def hessian(self, p: Positions) -> csr_array:
        """The Hessian [N/m], shape (3n, 3n): that of springs beyond the limits, nothing within."""
        _, length, beyond, unit = self._beyond(p)
        lateral = np.divide(beyond, length, out=np.zeros_like(length), where=length > TINY)
        return self._blocks(lateral, unit, len(p), (beyond != 0.0).astype(float))
