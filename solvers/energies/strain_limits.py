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
from solvers.round_off import EPS


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

    def add_absolute_terms(self, p: Positions, out: NDArray[np.float64]) -> None:
        """Add k (max(1, |l - t|/l) (|p_i| + |p_j|) + 2 l) [N] to `out` (n,) at both ends of edges that are beyond
        their limits, or that round-off may take there; all others add nothing (`solvers.round_off`)."""
        _, length, beyond, _ = self._beyond(p)
        reach = self._reach(p)
        near = np.maximum(length - self.high, self.low - length) >= -EPS * (reach + length)
        lateral = np.divide(np.abs(beyond), length, out=np.full_like(length, np.inf), where=length > TINY)
        turned = np.minimum(np.maximum(1.0, lateral) * reach, reach + 2.0 * np.abs(beyond) / EPS)
        self._add_absolute(np.where(near, turned + 2.0 * length, 0.0), out)

    def hessian(self, p: Positions) -> csr_array:
        """The Hessian [N/m], shape (3n, 3n): that of springs beyond the limits, nothing within."""
        _, length, beyond, unit = self._beyond(p)
        lateral = np.divide(beyond, length, out=np.zeros_like(length), where=length > TINY)
        return self._blocks(lateral, unit, len(p), (beyond != 0.0).astype(float))
