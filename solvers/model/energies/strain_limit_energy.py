"""Strain limits: an edge resists only beyond its minimum or maximum length (Bouaziz et al. 2014, section 5.1).

    E(p) = sum_e k_e/2 (|v_e| - t_e)^2,   v = A p,   t_e = min(max(|v_e|, low_e), high_e)

The nearest vector of an allowed length is d_e = t_e v_e/|v_e|. So this is a projective energy, whose A'KA is part of Q
even while no limit is active.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
import scipy
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import jit_inner
from springbench.solvers.model.energies.edge_energy import ZERO_LENGTH, EdgeEnergy, unit_directions
from springbench.solvers.model.energies.element_energies import ElementLaw, Elements, axial_hessian
from springbench.solvers.model.rounding_bound import EPS
from springbench.solvers.model.step_problem import Positions

_SAFE_MARGIN = 1.0 + 4.0 * EPS
"""Margin of the squared limits within which a rounded length is certainly within the limits."""


@jit_inner
def _is_within_limits(numbers, e, squared):
    """Return whether a squared length is certainly within the limits, without a square root."""
    low, high = numbers[e, 1], numbers[e, 2]
    return low * low * _SAFE_MARGIN <= squared and squared * _SAFE_MARGIN <= high * high


@jit_inner
def length_excess(numbers, e, length):
    """Return the length [m] beyond the limits of an edge, negative below the minimum.

    Args:
        numbers: parameters (m, 6): stiffness [N/m], minimum and maximum length [m], rest direction.
        e: index of the edge.
        length: length of the edge [m].
    """
    return length - min(max(length, numbers[e, 1]), numbers[e, 2])


@jit_inner
def edge_direction(numbers, e, length, z0, z1, z2):
    """Return the unit vector of an edge; that of the rest shape for zero length.

    Args:
        numbers: parameters (m, 6): stiffness [N/m], minimum and maximum length [m], rest direction.
        e: index of the edge.
        length: length of the edge [m].
        z0, z1, z2: vector from second to first end [m].
    """
    if length <= ZERO_LENGTH:
        return numbers[e, 3], numbers[e, 4], numbers[e, 5]
    return z0 / length, z1 / length, z2 / length


@jit_inner
def _value(numbers, e, z0, z1, z2):
    squared = z0 * z0 + z1 * z1 + z2 * z2
    return (
        0.0
        if _is_within_limits(numbers, e, squared)
        else 0.5 * numbers[e, 0] * length_excess(numbers, e, np.sqrt(squared)) ** 2
    )


@jit_inner
def _gradient(numbers, e, z0, z1, z2):
    squared = z0 * z0 + z1 * z1 + z2 * z2
    if _is_within_limits(numbers, e, squared):
        return 0.0, 0.0, 0.0
    length = np.sqrt(squared)
    force = numbers[e, 0] * length_excess(numbers, e, length)
    if force == 0.0:
        return 0.0, 0.0, 0.0
    n0, n1, n2 = edge_direction(numbers, e, length, z0, z1, z2)
    return force * n0, force * n1, force * n2


@jit_inner
def _hessian(numbers, e, z0, z1, z2):
    squared, k = z0 * z0 + z1 * z1 + z2 * z2, numbers[e, 0]
    if _is_within_limits(numbers, e, squared):
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    length = np.sqrt(squared)
    beyond = length_excess(numbers, e, length)
    if beyond == 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    n0, n1, n2 = edge_direction(numbers, e, length, z0, z1, z2)
    return axial_hessian(k, k * beyond / length if length > ZERO_LENGTH else 0.0, n0, n1, n2)


@jit_inner
def _energy_change(numbers, e, z0, z1, z2, s0, s1, s2):
    t0, t1, t2 = z0 + s0, z1 + s1, z2 + s2
    before, after = z0 * z0 + z1 * z1 + z2 * z2, t0 * t0 + t1 * t1 + t2 * t2
    if _is_within_limits(numbers, e, before) and _is_within_limits(numbers, e, after):
        return 0.0
    before, after = np.sqrt(before), np.sqrt(after)
    one, other = length_excess(numbers, e, before), length_excess(numbers, e, after)
    longer = other - one
    if one * other > 0.0:  # the same limit: the difference of the lengths, which loses no digits
        longer = (s0 * (z0 + t0) + s1 * (z1 + t1) + s2 * (z2 + t2)) / (before + after)
    return 0.5 * numbers[e, 0] * longer * (one + other)


@dataclass(frozen=True, eq=False)
class StrainLimits(EdgeEnergy):
    """Edges with limited lengths.

    Attributes:
        min_length, max_length: minimum and maximum lengths (m,) [m], 0 <= low <= high.
        rest_direction: (m, 3), unit directions of edges of zero length.
    """

    min_length: NDArray[np.float64]
    max_length: NDArray[np.float64]
    rest_direction: NDArray[np.float64]

    element_law: ClassVar[ElementLaw] = ElementLaw.from_functions(_value, _gradient, _hessian, _energy_change)

    @cached_property
    def elements(self) -> Elements:
        """The edges with their stiffness, limits and directions."""
        return Elements.from_edges(self.edges, self.stiffness, self.min_length, self.max_length, self.rest_direction)

    def _evaluate_edges(self, p: Positions) -> tuple[Positions, NDArray[np.float64], NDArray[np.float64], Positions]:
        """Return v (m, 3), the length |v| (m,), its excess beyond the limits (m,) and the directions (m, 3)."""
        v = self._edge_vectors(p)
        length, unit = unit_directions(v, self.rest_direction)
        return v, length, length - np.clip(length, self.min_length, self.max_length), unit

    def value(self, p: Positions) -> float:
        """Return the energy [J] at p, shape (n, 3); zero within the limits."""
        _, _, beyond, _ = self._evaluate_edges(p)
        return 0.5 * float(self.stiffness @ beyond**2)

    def add_gradient(self, p: Positions, out: Positions) -> None:
        """Add the gradient to `out`.

        Args:
            p: positions (n, 3) [m].
            out: sum of gradients (n, 3) [N], updated.
        """
        _, _, beyond, unit = self._evaluate_edges(p)
        self._scatter_forces(beyond[:, None] * unit, out)

    def add_projection(self, p: Positions, out: Positions) -> None:
        """Add A'K d(p) to `out` (the local step).

        Args:
            p: positions (n, 3) [m], from which d is found.
            out: right-hand side (n, 3) [N], updated.
        """
        v, _, beyond, unit = self._evaluate_edges(p)
        self._scatter_forces(v - beyond[:, None] * unit, out)

    def add_absolute_terms(self, p: Positions, out: NDArray[np.float64]) -> None:
        """Add the absolute terms of the gradient to `out` at both ends (`rounding_bound`).

        They are k (max(1, |l - t|/l) (|p_i| + |p_j|) + 2 l). Only edges that exceed their limits, or may do so by
        round-off, contribute.

        Args:
            p: positions (n, 3) [m].
            out: sum of absolute terms (n,) [N], updated.
        """
        _, length, beyond, _ = self._evaluate_edges(p)
        reach = self._endpoint_norms(p)
        near = np.maximum(length - self.max_length, self.min_length - length) >= -EPS * (reach + length)
        lateral = np.divide(np.abs(beyond), length, out=np.full_like(length, np.inf), where=length > ZERO_LENGTH)
        turned = np.minimum(np.maximum(1.0, lateral) * reach, reach + 2.0 * np.abs(beyond) / EPS)
        self._scatter_absolute_terms(np.where(near, turned + 2.0 * length, 0.0), out)

    def hessian(self, p: Positions) -> scipy.sparse.csr_array:
        """Return the Hessian [N/m], shape (3n, 3n): that of springs beyond the limits, zero within them."""
        _, length, beyond, unit = self._evaluate_edges(p)
        lateral = np.divide(beyond, length, out=np.zeros_like(length), where=length > ZERO_LENGTH)
        return self._block_hessian(
            lateral, unit, len(p), ((beyond != 0.0) | (self.min_length == self.max_length)).astype(float)
        )
