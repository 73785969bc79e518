"""Length constraints by an augmented Lagrangian (Hestenes 1969; Powell 1969; Rockafellar 1973 for inequalities).

    minimise g(p)   such that   low_e <= l_e <= high_e,   l_e = |v_e|,   v = A p

    L(p) = g(p) + sum_e k_e/2 (l_e + t_e/k_e - clip(l_e + t_e/k_e, low_e, high_e))^2

with the tensions t [N], positive if an edge pulls. An edge of L is a strain limit of stiffness k whose limits are
shifted by t/k, and L is the objective of a step without length constraints. If all constraints are satisfied and
grad L = 0, the Karush-Kuhn-Tucker conditions hold with multipliers t: an edge within its limits has no tension, one at
its maximum length pulls, and one at its minimum length pushes. If L also has positive curvature, for any k, then p is a
minimum of g among the feasible positions (Finsler's lemma). So the checks of an unconstrained step apply to this one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import inner
from solvers.energies import strain_limits
from solvers.energies.edges import TINY
from solvers.energies.elements import Law, line
from solvers.energies.strain_limits import StrainLimits
from solvers.held import Lengths
from solvers.matrices import shares
from solvers.problem import Positions, ProjectiveEnergy, Start, System

_LIMITS = StrainLimits.law.one


@inner
def _curvature(numbers, e, z0, z1, z2):
    """Return the Hessian of a strain limit without the negative transverse part of a compressed edge."""
    length = np.sqrt(z0 * z0 + z1 * z1 + z2 * z2)
    force = numbers[e, 0] * strain_limits.excess(numbers, e, length)
    if force == 0.0 and numbers[e, 1] < numbers[e, 2]:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    n0, n1, n2 = strain_limits.direction(numbers, e, length, z0, z1, z2)
    return line(numbers[e, 0], max(0.0, force / length) if length > TINY else 0.0, n0, n1, n2)


@dataclass(frozen=True, eq=False)
class Augmented(StrainLimits):
    """Edges of an augmented Lagrangian, whose limits are shifted by tensions that may change from step to step."""

    law: ClassVar[Law] = Law.of(_LIMITS.value, _LIMITS.gradient, _curvature, _LIMITS.rise)

    @classmethod
    def of(cls, lengths: Lengths, stiffness: NDArray[np.float64], tension: NDArray[np.float64]) -> Augmented:
        """Return edges with positive stiffnesses k [N/m] and tensions t [N], both (m,)."""
        moved = tension / stiffness
        return cls(lengths.edges, stiffness, lengths.low - moved, lengths.high - moved, lengths.rest_direction)

    def begin_step(self, start: Start) -> Augmented:
        """Return the energy itself, because the tensions are fixed."""
        return self


def joined(parts: Sequence[Lengths]) -> Lengths:
    """Concatenate length constraints in their order; an empty set for no parts."""
    none = Lengths(np.empty((0, 2), np.int64), np.empty(0), np.empty(0), np.empty((0, 3)))
    fields = zip(*((x.edges, x.low, x.high, x.rest_direction) for x in (none, *parts)), strict=True)
    return Lengths(*(np.concatenate(arrays) for arrays in fields))


def off(lengths: Lengths, p: Positions) -> NDArray[np.float64]:
    """Return the constraint violations at p (n, 3) [m], negative below the minimum length: (m,) [m]."""
    found = np.linalg.norm(p[lengths.edges[:, 0]] - p[lengths.edges[:, 1]], axis=1)
    return found - np.clip(found, lengths.low, lengths.high)


def penalties(system: System, lengths: Lengths) -> NDArray[np.float64]:
    """Return stiffnesses k (m,) [N/m] by which an edge resists as much as its two ends do, 1/(1/q_i + 1/q_j).

    Here q is the diagonal of Q. An edge between exact pins, which cannot move, gets the value 1.
    """
    q = system.inertia.copy()
    for share in shares(system, [energy for energy in system.energies if isinstance(energy, ProjectiveEnergy)]):
        q += share.diagonal()
    q[system.pins.vertices] += system.pins.weight
    with np.errstate(divide="ignore"):
        gives = (1.0 / q)[lengths.edges].sum(axis=1)
    return np.divide(1.0, gives, out=np.ones(len(gives)), where=(gives > 0.0) & np.isfinite(gives))


def augmented(system: System, lengths: Lengths, stiffness: NDArray[np.float64], tension: NDArray[np.float64]) -> System:
    """Return the system without length constraints whose objective is L.

    Without constraints the result has the objective of the system itself.

    Args:
        system: the system with constraints.
        lengths: its constraints.
        stiffness: stiffnesses k (m,) [N/m].
        tension: tensions t (m,) [N].
    """
    if not len(lengths.edges):
        return replace(system, lengths=()) if system.lengths else system
    return replace(system, energies=(*system.energies, Augmented.of(lengths, stiffness, tension)), lengths=())
