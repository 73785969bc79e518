"""Linear springs (Liu et al. 2013, eq. 7 to 9).

    E(p) = sum_e k_e/2 (|v_e| - r_e)^2,   v = A p,   grad E = A'K (v - d),   d_e = r_e v_e / |v_e|

A spring of zero length has no direction. It is assigned that of its rest shape, or a fixed direction if the rest length
is zero too. The gradient of the energy and all solvers use this convention, so that they compute the same step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray
from springbench.solvers.model.energies.edge_energy import ZERO_LENGTH, EdgeEnergy, rest_directions, unit_directions
from springbench.solvers.model.rounding_bound import EPS
from springbench.solvers.model.step_problem import Positions


@dataclass(frozen=True, eq=False)
class Springs(EdgeEnergy):
    """Springs between pairs of vertices.

    Attributes:
        edges: (m, 2).
        stiffness: k (m,) [N/m], not negative.
        rest_length: r (m,) [m], not negative.
        rest_direction: (m, 3), unit directions of springs of zero length.

    Example:
        >>> import numpy as np
        >>> rest = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
        >>> springs = springbench.Springs.from_rest_shape(rest, np.array([[0, 1]]), stiffness=np.array([100.0]))
        >>> springs.value(3.0 * rest)
        200.0
    """

    rest_length: NDArray[np.float64]
    rest_direction: NDArray[np.float64]

    @classmethod
    def from_rest_shape(cls, rest: Positions, edges: NDArray[np.int64], stiffness: NDArray[np.float64]) -> Springs:
        """Return springs whose rest shape is `rest`.

        Rest lengths that differ only by the round-off of positions are made equal.

        Args:
            rest: rest positions (n, 3) [m].
            edges: (m, 2).
            stiffness: (m,) [N/m].
        """
        length, direction = rest_directions(rest, edges)
        round_off = 4.0 * np.finfo(float).eps * float(np.abs(rest).max(initial=0.0))
        return cls(edges, stiffness, _merge_lengths(length, round_off), direction)

    @classmethod
    def from_parts(cls, parts: Sequence[Springs]) -> Springs:
        """Concatenate the springs of all parts in their order; an empty set for no parts."""
        if len(parts) == 1:
            return parts[0]
        none = cls(np.empty((0, 2), np.int64), np.empty(0), np.empty(0), np.empty((0, 3)))
        fields = zip(*((s.edges, s.stiffness, s.rest_length, s.rest_direction) for s in (none, *parts)), strict=True)
        return cls(*(np.concatenate(arrays) for arrays in fields))

    def value(self, p: Positions) -> float:
        """Return the elastic energy [J] at p, shape (n, 3)."""
        return 0.5 * float(self.stiffness @ (self.edge_lengths(p) - self.rest_length) ** 2)

    def rest_hessian(self, lateral_ratio: float, n: int) -> scipy.sparse.csr_array:
        """Return the Hessian of the rest shape with a given transverse stiffness.

        A spring of zero rest length has stiffness k in all directions.

        Args:
            lateral_ratio: transverse stiffness of the other springs relative to k.
            n: number of vertices.

        Returns:
            Hessian (3n, 3n) [N/m].
        """
        across = np.where(self.rest_length == 0.0, 1.0, lateral_ratio)
        return self._block_hessian(across, self.rest_direction, n)

    def add_gradient(self, p: Positions, out: Positions) -> None:
        """Add the gradient A'K (A p - d) to `out`.

        Args:
            p: positions (n, 3) [m].
            out: sum of gradients (n, 3) [N], updated.
        """
        v = self._edge_vectors(p)
        _, unit = unit_directions(v, self.rest_direction)
        self._scatter_forces(v - self.rest_length[:, None] * unit, out)

    def add_projection(self, p: Positions, out: Positions) -> None:
        """Add A'K d(p) to `out` (the local step).

        Args:
            p: positions (n, 3) [m], from which d is found.
            out: right-hand side (n, 3) [N], updated.
        """
        _, unit = unit_directions(self._edge_vectors(p), self.rest_direction)
        self._scatter_forces(self.rest_length[:, None] * unit, out)

    def add_absolute_terms(self, p: Positions, out: NDArray[np.float64]) -> None:
        """Add the absolute terms of the gradient to `out` at both ends (`rounding_bound`).

        They are k (max(1, r/l - 1) (|p_i| + |p_j|) + l + r). The error of a unit direction is at most of order 1, so
        that a spring of nearly zero length adds 2 k r / eps.

        Args:
            p: positions (n, 3) [m].
            out: sum of absolute terms (n,) [N], updated.
        """
        length, r = self.edge_lengths(p), self.rest_length
        lateral = np.divide(r, length, out=np.full_like(length, np.inf), where=length > ZERO_LENGTH) - 1.0
        reach = self._endpoint_norms(p)
        turned = np.minimum(np.maximum(1.0, np.where(r > 0.0, lateral, 1.0)) * reach, reach + 2.0 * r / EPS)
        self._scatter_absolute_terms(turned + length + r, out)

    def hessian(self, p: Positions) -> scipy.sparse.csr_array:
        """Return the Hessian [N/m], shape (3n, 3n).

        It is k (nn' + (1 - r/l)(I - nn')) per spring, n its direction, l its length. A spring of zero length and
        positive rest length has no defined transverse stiffness; it is set to zero.
        """
        length, unit = unit_directions(self._edge_vectors(p), self.rest_direction)
        ratio = np.divide(self.rest_length, length, out=np.ones_like(length), where=length > ZERO_LENGTH)
        return self._block_hessian(np.where(self.rest_length == 0.0, 1.0, 1.0 - ratio), unit, len(p))


def _merge_lengths(lengths: NDArray[np.float64], round_off: float) -> NDArray[np.float64]:
    """Return lengths (m,) [m], each replaced by the smallest of its group.

    Consecutive lengths of a group, in ascending order, differ by at most `round_off` [m].
    """
    order = np.argsort(lengths, kind="stable")
    ascending = lengths[order]
    first = np.diff(ascending, prepend=-np.inf) > round_off
    out = np.empty_like(lengths)
    out[order] = ascending[first][np.cumsum(first) - 1]
    return out
