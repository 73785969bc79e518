"""Springs that only pull: cables, which go slack instead of pushing.

    E(p) = sum_e k_e/2 max(0, |v_e| - r_e)^2,   v = A p

It is the energy of strain limits with the rest length as the maximum length, so that the projection of a slack spring
is its own vector and its force is zero. The energy is convex: the Hessian k nn' + k (1 - r/l)(I - nn') of a taut spring
is positive semidefinite, and that of a slack one is zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.energies.strain_limit_energy import StrainLimits


@dataclass(frozen=True, eq=False)
class TensionOnlySprings(StrainLimits):
    """Springs without any force below their rest length, which is the maximum length."""

    @classmethod
    def from_springs(cls, springs: Springs) -> TensionOnlySprings:
        """Return springs of the same stiffness, rest length and direction that only pull."""
        slack = np.zeros_like(springs.rest_length)
        return cls(springs.edges, springs.stiffness, slack, springs.rest_length, springs.rest_direction)

    def to_springs(self) -> Springs:
        """Return springs of the same stiffness, rest length and direction that also push."""
        return Springs(self.edges, self.stiffness, self.max_length, self.rest_direction)
