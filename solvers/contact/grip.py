"""Coulomb friction of pairs, lagged by one step: a convex function of positions within the step.

    E(p) = sum over pairs of mu F h(|u|),     u = (I - nn') sum_i c_i (x_i - x_i^t)

F: the barrier's force at the step's start; c, n: where the pair is nearest there, and its direction (Li et al. 2020,
"Incremental potential contact", section 5, with one lag a step: order 1 in the time step). h is the length, smoothed
where a pair slips by less than s in a step; its slope is continuous, and below 1 there:

    h(u) = u^2/s - u^3/(3 s^2)  for u < s,     u - s/3 beyond
"""

from __future__ import annotations

from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from solvers.contact import barrier
from solvers.contact.contacts import Contacts
from solvers.problem import Positions

Array = NDArray[np.float64]


class Grip(NamedTuple):
    """Contacts that grip. vertices (g, 4), with no weight where there are fewer; weights: c (g, 4); normal (g, 3);
    anchor: sum_i c_i x_i^t (g, 3) [m]; force: mu F (g,) [N]; slip: s [m]."""

    vertices: NDArray[np.int64]
    weights: Array
    normal: Array
    anchor: Array
    force: Array
    slip: float

    @classmethod
    def of(cls, contacts: Contacts, friction: float, slip: float) -> Self:
        """What is in range at the step's start does in the step. slip: s [m]."""
        between, force = contacts.between.copy(), np.empty(len(contacts.vertices))
        barrier.forces(contacts, force)
        normal = between / np.sqrt(np.einsum("ij,ij->i", between, between))[:, None]
        return cls(contacts.vertices.copy(), contacts.weights.copy(), normal, between, friction * force, slip)

    def _slipped(self, p: Positions) -> tuple[Array, Array]:
        """u (g, 3) and |u| (g,) [m]."""
        u = np.einsum("gi,gia->ga", self.weights, p[self.vertices]) - self.anchor
        u -= np.einsum("ga,ga->g", u, self.normal)[:, None] * self.normal
        return u, np.sqrt(np.einsum("ga,ga->g", u, u))

    def value(self, p: Positions) -> float:
        """The energy [J] at p (n, 3)."""
        length, s = self._slipped(p)[1], self.slip
        y = np.minimum(length / s, 1.0)
        return float(self.force @ (s * (y * y - y**3 / 3.0) + np.maximum(length - s, 0.0)))

    def add_gradient(self, p: Positions, out: Positions) -> None:
        """Add the gradient [N] at p (n, 3) to `out`."""
        u, length = self._slipped(p)
        pull = (self.force * self._rate(length))[:, None] * u
        np.add.at(out, self.vertices, self.weights[:, :, None] * pull[:, None, :])

    def _rate(self, length: Array) -> Array:
        """h'(u)/u [1/m]."""
        y = length / self.slip
        return np.where(y < 1.0, 2.0 - y, 1.0 / np.maximum(y, 1.0)) / self.slip

    def curvature(self, p: Positions) -> Array:
        """The second derivatives (g, 12, 12) [N/m] at p (n, 3), positive semidefinite."""
        u, length = self._slipped(p)
        rate, along = self._rate(length), u / np.maximum(length, 1e-300)[:, None]
        bent = np.maximum(2.0 * (1.0 - length / self.slip) / self.slip, 0.0)
        flat = np.eye(3) - self.normal[:, :, None] * self.normal[:, None, :]
        inner = rate[:, None, None] * flat + (bent - rate)[:, None, None] * along[:, :, None] * along[:, None, :]
        inner *= self.force[:, None, None]
        both = self.weights[:, :, None] * self.weights[:, None, :]
        return np.einsum("gij,gab->giajb", both, inner).reshape(len(u), 12, 12)


_NONE = np.empty((0, 3))
NO_GRIP = Grip(np.empty((0, 4), np.int64), np.empty((0, 4)), _NONE, _NONE, np.empty(0), 1.0)
