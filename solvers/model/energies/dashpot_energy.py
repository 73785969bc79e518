"""Dashpots: the force f = -c n n'(v_i - v_j) opposes the rate of change of edge lengths.

The direction n is that at the start of the step, so the force is linear. Integrators of order 2 evaluate n at positions
that are extrapolated to the time of the stage, and preserve their order. Since the stage moves with the velocity
velocity_rate (x - velocity_origin), the force is the gradient of

    E(x) = sum_e c_e velocity_rate/2 (n_e'(A x - A velocity_origin)_e)^2

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
from springbench.solvers.jit.kernel_compilation import jit_inner
from springbench.solvers.model.energies.edge_energy import EdgeEnergy, rest_directions, unit_directions
from springbench.solvers.model.energies.element_energies import ElementLaw, Elements, axial_hessian
from springbench.solvers.model.step_problem import Positions, StepStart


@jit_inner
def _closing_length(numbers, e, z0, z1, z2):
    return numbers[e, 1] * z0 + numbers[e, 2] * z1 + numbers[e, 3] * z2 - numbers[e, 4]


@jit_inner
def _value(numbers, e, z0, z1, z2):
    return 0.5 * numbers[e, 0] * _closing_length(numbers, e, z0, z1, z2) ** 2


@jit_inner
def _gradient(numbers, e, z0, z1, z2):
    force = numbers[e, 0] * _closing_length(numbers, e, z0, z1, z2)
    return force * numbers[e, 1], force * numbers[e, 2], force * numbers[e, 3]


@jit_inner
def _hessian(numbers, e, z0, z1, z2):
    return axial_hessian(numbers[e, 0], 0.0, numbers[e, 1], numbers[e, 2], numbers[e, 3])


@jit_inner
def _energy_change(numbers, e, z0, z1, z2, s0, s1, s2):
    closer = numbers[e, 1] * s0 + numbers[e, 2] * s1 + numbers[e, 3] * s2
    return numbers[e, 0] * closer * (_closing_length(numbers, e, z0, z1, z2) + 0.5 * closer)


@dataclass(frozen=True, eq=False)
class Dashpots(EdgeEnergy):
    """Dashpots along edges.

    Attributes:
        stiffness: c (m,) [N s/m] initially, i.e. c velocity_rate [N/m] at a rate of 1/s; c velocity_rate in a step.
        direction: n (m, 3), initially that of the rest shape.
        offset: n'A velocity_origin (m,) [m], initially 0.
    """

    direction: Positions
    offset: NDArray[np.float64]

    is_lag_extrapolated: ClassVar[bool] = True
    is_dissipative: ClassVar[bool] = True
    """Whether the gradient is a damping force, which stores no energy."""
    element_law: ClassVar[ElementLaw] = ElementLaw.from_functions(
        _value, _gradient, _hessian, _energy_change, has_constant_hessian=True
    )

    @cached_property
    def elements(self) -> Elements:
        """The edges with their damping, directions and offsets."""
        return Elements.from_edges(self.edges, self.stiffness, self.direction, self.offset)

    @classmethod
    def from_rest_shape(cls, rest: Positions, edges: NDArray[np.int64], damping: NDArray[np.float64]) -> Dashpots:
        """Return dashpots along edges of a rest shape.

        Args:
            rest: rest positions (n, 3) [m].
            edges: (m, 2).
            damping: coefficients c (m,) [N s/m].
        """
        _, direction = rest_directions(rest, edges)
        return cls(edges, damping, direction, np.zeros(len(edges)))

    def begin_step(self, start: StepStart) -> Dashpots:
        """Return the energy of a step."""
        lagged = start.lagged_positions
        v = self._edge_vectors(lagged)
        _, n = unit_directions(v, self.direction)
        offset = _row_dots(n, v if start.velocity_origin is lagged else self._edge_vectors(start.velocity_origin))
        return replace(self, stiffness=start.velocity_rate * self.stiffness, direction=n, offset=offset)

    def _closing_length(self, p: Positions) -> NDArray[np.float64]:
        """Return n'(A p - A velocity_origin), (m,) [m]."""
        return _row_dots(self.direction, self._edge_vectors(p)) - self.offset

    def value(self, p: Positions) -> float:
        """Return the energy [J] at p, shape (n, 3): half the energy dissipated in the time 1/velocity_rate."""
        return 0.5 * float(self.stiffness @ self._closing_length(p) ** 2)

    def add_gradient(self, p: Positions, out: Positions) -> None:
        """Add the gradient to `out`.

        Args:
            p: positions (n, 3) [m].
            out: sum of gradients (n, 3) [N], updated.
        """
        self._scatter_forces(self._closing_length(p)[:, None] * self.direction, out)

    def add_projection(self, p: Positions, out: Positions) -> None:
        """Add A'K d(p) to `out` (the local step).

        Args:
            p: positions (n, 3) [m], from which d is found.
            out: right-hand side (n, 3) [N], updated.
        """
        self._scatter_forces(self._edge_vectors(p) - self._closing_length(p)[:, None] * self.direction, out)

    def add_absolute_terms(self, p: Positions, out: NDArray[np.float64]) -> None:
        """Add k (|p_i| + |p_j| + |offset|) [N] to `out` at both ends (`rounding_bound`).

        Args:
            p: positions (n, 3) [m].
            out: sum of absolute terms (n,) [N], updated.
        """
        self._scatter_absolute_terms(self._endpoint_norms(p) + np.abs(self.offset), out)

    def hessian(self, p: Positions) -> scipy.sparse.csr_array:
        """Return the Hessian [N/m], shape (3n, 3n), with k nn' per edge."""
        return self._block_hessian(np.zeros(len(self.edges)), self.direction, len(p))


class RayleighDashpots(Dashpots):
    """The stiffness-proportional part of Rayleigh damping of springs."""


def _row_dots(a: Positions, b: Positions) -> NDArray[np.float64]:
    return np.einsum("ij,ij->i", a, b)
