"""Dashpots: the force f = -c n n'(v_i - v_j) opposes the rate of change of an edge's length.

The direction n is that at the start of the step, so the force is linear. Integrators of order 2 evaluate n at positions
that are extrapolated to the time of the stage, and preserve their order. Since the stage moves with the velocity
rate (x - origin), the force is the gradient of

    E(x) = sum_e c_e rate/2 (n_e'(A x - A origin)_e)^2

This is a projective energy (Bouaziz et al. 2014): the vectors d_e without a velocity along n_e form a plane. Equal and
opposite forces along the lagged edge conserve linear momentum and, for implicit Euler, angular momentum.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
import scipy
from numpy.typing import NDArray

from solvers.compiling import inner
from solvers.energies.edges import Edges, directions, rest_directions
from solvers.energies.elements import Elements, Law, line
from solvers.problem import Positions, Start


@inner
def _closing(numbers, e, z0, z1, z2):
    return numbers[e, 1] * z0 + numbers[e, 2] * z1 + numbers[e, 3] * z2 - numbers[e, 4]


@inner
def _value(numbers, e, z0, z1, z2):
    return 0.5 * numbers[e, 0] * _closing(numbers, e, z0, z1, z2) ** 2


@inner
def _gradient(numbers, e, z0, z1, z2):
    force = numbers[e, 0] * _closing(numbers, e, z0, z1, z2)
    return force * numbers[e, 1], force * numbers[e, 2], force * numbers[e, 3]


@inner
def _curvature(numbers, e, z0, z1, z2):
    return line(numbers[e, 0], 0.0, numbers[e, 1], numbers[e, 2], numbers[e, 3])


@inner
def _rise(numbers, e, z0, z1, z2, s0, s1, s2):
    closer = numbers[e, 1] * s0 + numbers[e, 2] * s1 + numbers[e, 3] * s2
    return numbers[e, 0] * closer * (_closing(numbers, e, z0, z1, z2) + 0.5 * closer)


@dataclass(frozen=True, eq=False)
class Dashpots(Edges):
    """Dashpots along edges.

    Attributes:
        stiffness: c (m,) [N s/m] initially, i.e. c rate [N/m] at a rate of 1/s; c rate in a step.
        direction: n (m, 3), initially that of the rest shape.
        offset: n'A origin (m,) [m], initially 0.
    """

    direction: Positions
    offset: NDArray[np.float64]

    lagged: ClassVar[bool] = True
    law: ClassVar[Law] = Law.of(_value, _gradient, _curvature, _rise, constant=True)

    @cached_property
    def elements(self) -> Elements:
        """The edges with their damping, directions and offsets."""
        return Elements.along(self.edges, self.stiffness, self.direction, self.offset)

    @classmethod
    def along(cls, rest: Positions, edges: NDArray[np.int64], damping: NDArray[np.float64]) -> Dashpots:
        """Return dashpots along edges of a rest shape.

        Args:
            rest: rest positions (n, 3) [m].
            edges: (m, 2).
            damping: coefficients c (m,) [N s/m].
        """
        _, direction = rest_directions(rest, edges)
        return cls(edges, damping, direction, np.zeros(len(edges)))

    def begin_step(self, start: Start) -> Dashpots:
        """Return the energy of a step."""
        _, n = directions(self._along(start.expected), self.direction)
        offset = _dot(n, self._along(start.origin))
        return replace(self, stiffness=start.rate * self.stiffness, direction=n, offset=offset)

    def _closing(self, p: Positions) -> NDArray[np.float64]:
        """Return n'(A p - A origin), (m,) [m]."""
        return _dot(self.direction, self._along(p)) - self.offset

    def value(self, p: Positions) -> float:
        """Return the energy [J] at p, shape (n, 3): half the energy dissipated in the time 1/rate."""
        return 0.5 * float(self.stiffness @ self._closing(p) ** 2)

    def add_gradient(self, p: Positions, out: Positions) -> None:
        """Add the gradient [N], shape (n, 3), to `out`."""
        self._add(self._closing(p)[:, None] * self.direction, out)

    def add_projection(self, p: Positions, out: Positions) -> None:
        """Add A'K d(p) [N], shape (n, 3), to `out` (the local step)."""
        self._add(self._along(p) - self._closing(p)[:, None] * self.direction, out)

    def add_absolute_terms(self, p: Positions, out: NDArray[np.float64]) -> None:
        """Add k (|p_i| + |p_j| + |offset|) [N] to `out` (n,) at both ends (`rounding_bound`)."""
        self._add_absolute(self._reach(p) + np.abs(self.offset), out)

    def hessian(self, p: Positions) -> scipy.sparse.csr_array:
        """Return the Hessian [N/m], shape (3n, 3n), with k nn' per edge."""
        return self._blocks(np.zeros(len(self.edges)), self.direction, len(p))


class RayleighDashpots(Dashpots):
    """The stiffness-proportional part of Rayleigh damping of springs."""


def _dot(a: Positions, b: Positions) -> NDArray[np.float64]:
    return np.einsum("ij,ij->i", a, b)
