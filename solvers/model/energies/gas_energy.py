"""A fixed amount of gas at constant temperature in a closed surface.

Its pressure p and volume V satisfy p V = p0 V0. Its energy is

    E(x) = -p0 V0 ln(V/V0),   V = sum over triangles of a.(b x c)/6,   grad E = -(p0 V0/V) grad V
    Hess E = p/V grad V grad V' - p Hess V,   p = p0 V0/V

The gas needs springs that enclose it, or it expands without limit. The energy is infinite for an inverted surface, so
that a line search rejects it. The energy is not projective.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray
from springbench.solvers.model.step_problem import Positions
from springbench.solvers.model.system_matrix_assembly import drop_zeros

_INVERTED_VOLUME_FRACTION = 1e-3
"""Fraction of the rest volume that replaces a non-positive volume in the gradient."""

_LEVI_CIVITA = np.array([np.cross(np.eye(3), e) for e in np.eye(3)])
"""[a]x = sum_k a_k LC[k] is the matrix of the cross product, [a]x b = a x b."""


@dataclass(frozen=True, eq=False)
class Gas:
    """Gas in a closed surface.

    Attributes:
        triangles: (f, 3), oriented outwards.
        rest_pressure: p0 [Pa] at the rest volume.
        rest_volume: rest volume V0 [m^3].
    """

    triangles: NDArray[np.int64]
    rest_pressure: float
    rest_volume: float

    def volume_at(self, p: Positions) -> float:
        """Return V [m^3] at p, shape (n, 3); negative if the surface is inverted."""
        a, b, c = self._corner_positions(p)
        return float(np.einsum("ij,ij->", a, np.cross(b, c))) / 6.0

    def _corner_positions(self, p: Positions) -> list[Positions]:
        x = p - p.mean(axis=0)  # the volume does not depend on the origin; far from it the terms would cancel
        return [x[corner] for corner in self.triangles.T]

    def value(self, p: Positions) -> float:
        """Return the energy [J] at p, shape (n, 3), zero at rest.

        It is infinite if the volume is not positive.
        """
        volume = self.volume_at(p)
        return (
            -self.rest_pressure * self.rest_volume * float(np.log(volume / self.rest_volume))
            if volume > 0.0
            else np.inf
        )

    def _pressure_at(self, p: Positions) -> tuple[float, float]:
        """Return the pressure [Pa] and the volume [m^3] at which it is evaluated."""
        volume = self.volume_at(p)
        volume = volume if volume > 0.0 else _INVERTED_VOLUME_FRACTION * self.rest_volume
        return self.rest_pressure * self.rest_volume / volume, volume

    def _volume_gradient(self, p: Positions) -> Positions:
        """Return grad V, (n, 3) [m^2]."""
        a, b, c = self._corner_positions(p)
        out = np.zeros_like(p)
        for corner, area in zip(self.triangles.T, (np.cross(b, c), np.cross(c, a), np.cross(a, b)), strict=True):
            np.add.at(out, corner, area / 6.0)
        return out

    def add_gradient(self, p: Positions, out: Positions) -> None:
        """Add the gradient to `out`.

        Args:
            p: positions (n, 3) [m].
            out: sum of gradients (n, 3) [N], updated.
        """
        out -= self._pressure_at(p)[0] * self._volume_gradient(p)

    def add_absolute_terms(self, p: Positions, out: NDArray[np.float64]) -> None:
        """Add the absolute terms of the gradient to `out` (`rounding_bound`).

        They are p |b||c|/6 plus the effect of the rounding of b and c at each corner of each triangle a b c, and
        p/V |grad V| times the error of V.

        Args:
            p: positions (n, 3) [m].
            out: sum of absolute terms (n,) [N], updated.
        """
        pressure, volume = self._pressure_at(p)
        size, relative = (np.linalg.norm(x, axis=1) for x in (p, p - p.mean(axis=0)))
        size = size + np.abs(p).mean(axis=0).sum()  # the mean is rounded too
        areas = np.zeros_like(out)
        for k, corner in enumerate(self.triangles.T):
            i, j = (self.triangles[:, (k + step) % 3] for step in (1, 2))
            areas += np.bincount(
                corner, (relative[i] * relative[j] + size[i] * relative[j] + relative[i] * size[j]) / 6.0, len(out)
            )
        slope = np.linalg.norm(self._volume_gradient(p), axis=1)
        off = float(areas @ relative) / 3.0 + float(slope @ size)
        out += pressure * (areas + off / volume * slope)

    def hessian(self, p: Positions) -> scipy.sparse.csr_array:
        """Return the Hessian [N/m], shape (3n, 3n), without zero entries, its term of rank one included."""
        column = self.low_rank_columns(p).ravel()
        return drop_zeros(scipy.sparse.csr_array(self.sparse_hessian(p) + np.outer(column, column)))

    def sparse_hessian(self, p: Positions) -> scipy.sparse.csr_array:
        """Return -p Hess V [N/m], shape (3n, 3n), sparse and indefinite."""
        return drop_zeros(scipy.sparse.csr_array(-self._pressure_at(p)[0] * self._volume_hessian(p)))

    def low_rank_columns(self, p: Positions) -> NDArray[np.float64]:
        """Return u = (p/V)^(1/2) grad V [(N/m)^(1/2)], shape (n, 3, 1); u u' is the rest of the Hessian."""
        pressure, volume = self._pressure_at(p)
        return (np.sqrt(pressure / volume) * self._volume_gradient(p))[:, :, None]

    def _volume_hessian(self, p: Positions) -> scipy.sparse.csr_array:
        n = len(p)
        cross = [np.einsum("fk,kij->fij", x, _LEVI_CIVITA) / 6.0 for x in self._corner_positions(p)]
        rows, columns, blocks = [], [], []
        for k in range(3):  # d/d(next) and d/d(previous) of next x previous, the gradient at corner k
            i, j, l = (self.triangles[:, (k + step) % 3] for step in range(3))
            rows += [i, i]
            columns += [j, l]
            blocks += [-cross[(k + 2) % 3], cross[(k + 1) % 3]]
        row, column = (3 * np.concatenate(part)[:, None, None] for part in (rows, columns))
        row, column = np.broadcast_arrays(row + np.arange(3)[:, None], column + np.arange(3))
        values = np.concatenate(blocks)
        return scipy.sparse.csr_array(
            scipy.sparse.coo_array((values.ravel(), (row.ravel(), column.ravel())), shape=(3 * n, 3 * n))
        )
