"""Exact lengths as an augmented Lagrangian has them (Hestenes 1969; Powell 1969; Rockafellar 1973 for limits).

    minimise g(p)   such that   low_e <= l_e <= high_e,   l_e = |v_e|,   v = A p

    L(p) = g(p) + sum_e k_e/2 (l_e + t_e/k_e - clip(l_e + t_e/k_e, low_e, high_e))^2

with the tensions t [N], positive where an edge pulls. An edge of L is a strain limit of stiffness k whose limits are
moved by t/k, and L is the objective of a step that keeps no lengths. Where no length is off and grad L = 0, the
conditions of Karush, Kuhn and Tucker hold with multipliers t: an edge within its limits has no tension, one at the
longest allowed pulls, one at the shortest pushes. Where L curves upwards as well, for any k, p is a minimum of g among
the positions that keep the lengths (Finsler's lemma). So what judges a step judges this one.
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
    """That of a limit, less what a push takes from it across the edge."""
    length = np.sqrt(z0 * z0 + z1 * z1 + z2 * z2)
    force = numbers[e, 0] * strain_limits.excess(numbers, e, length)
    if force == 0.0 and numbers[e, 1] < numbers[e, 2]:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    n0, n1, n2 = strain_limits.direction(numbers, e, length, z0, z1, z2)
    return line(numbers[e, 0], max(0.0, force / length) if length > TINY else 0.0, n0, n1, n2)


@dataclass(frozen=True, eq=False)
class Augmented(StrainLimits):
    """Edges of an augmented Lagrangian: their limits are moved by tensions, which may differ from step to step."""

    law: ClassVar[Law] = Law.of(_LIMITS.value, _LIMITS.gradient, _curvature, _LIMITS.rise)

    @classmethod
    def of(cls, lengths: Lengths, stiffness: NDArray[np.float64], tension: NDArray[np.float64]) -> Augmented:
        """Of lengths, stiffnesses k [N/m], all positive, and tensions t [N], both (m,)."""
        moved = tension / stiffness
        return cls(lengths.edges, stiffness, lengths.low - moved, lengths.high - moved, lengths.rest_direction)

    def begin_step(self, start: Start) -> Augmented:
        """The same: the tensions are those that it was made with."""
        return self


def joined(parts: Sequence[Lengths]) -> Lengths:
    """All lengths of the parts, in their order; none at all for no parts."""
    none = Lengths(np.empty((0, 2), np.int64), np.empty(0), np.empty(0), np.empty((0, 3)))
    fields = zip(*((x.edges, x.low, x.high, x.rest_direction) for x in (none, *parts)), strict=True)
    return Lengths(*(np.concatenate(arrays) for arrays in fields))


def off(lengths: Lengths, p: Positions) -> NDArray[np.float64]:
    """By how much each is longer than it may be at p (n, 3) [m], negative where it is shorter: (m,) [m]."""
    found = np.linalg.norm(p[lengths.edges[:, 0]] - p[lengths.edges[:, 1]], axis=1)
    return found - np.clip(found, lengths.low, lengths.high)


def penalties(system: System, lengths: Lengths) -> NDArray[np.float64]:
    """Stiffnesses k (m,) [N/m] by which an edge resists as much as its two ends do by themselves, 1/(1/q_i + 1/q_j),
    with the diagonal q of Q; of an edge between exact pins, which nothing moves, 1."""
    q = system.inertia.copy()
    for share in shares(system, [energy for energy in system.energies if isinstance(energy, ProjectiveEnergy)]):
        q += share.diagonal()
    q[system.pins.vertices] += system.pins.weight
    with np.errstate(divide="ignore"):
        gives = (1.0 / q)[lengths.edges].sum(axis=1)
    return np.divide(1.0, gives, out=np.ones(len(gives)), where=(gives > 0.0) & np.isfinite(gives))


def augmented(system: System, lengths: Lengths, stiffness: NDArray[np.float64], tension: NDArray[np.float64]) -> System:
    """The system whose objective is L, with stiffnesses [N/m] and tensions [N] of these lengths, (m,): it keeps none.

    Itself where nothing is exact.
    """
    if not len(lengths.edges):
        return replace(system, lengths=()) if system.lengths else system
    return replace(system, energies=(*system.energies, Augmented.of(lengths, stiffness, tension)), lengths=())
