"""Compiled local-global iterations: a step runs without Python from start to end.

Factors in float64 solve for positions, Q p = A'K d + y. Less precise factors solve for corrections,
p <- p - Q^-1 grad g(p), with the gradient in float64. Both converge to the same limit, to all digits of float64; only
the intermediate iterates differ.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from solvers.about import LIU_2013, LOCAL_GLOBAL, About
from solvers.contact.touching import without_contact
from solvers.core.bounds import without_bounded
from solvers.core.compiled import FAR, PreparedCompiled, compiled
from solvers.core.prefactored import Project, prepared, projective
from solvers.energies.springs import Springs
from solvers.kernels import springs as kernels
from solvers.linear.choice import Linear, Precision, factorise
from solvers.memory import aligned
from solvers.problem import Positions, Prepared, System


@dataclass(frozen=True)
class CompiledLocalGlobal:
    """Compiled local-global with a linear solver that is selected by size, or given.

    Args:
        linear: solver of Q p = b.
        precision: floating-point type of its stored entries.
    """

    minimises: ClassVar[bool] = True
    descends: ClassVar[bool] = True
    about: ClassVar[About] = About(LOCAL_GLOBAL, LIU_2013, first=True)

    linear: Linear = "auto"
    precision: Precision = "float64"

    def prepare(self, system: System) -> Prepared:
        """Prepare the method for a system.

        Raises:
            Unsupported: if an energy is neither projective nor contact.
            NotPositiveDefinite: if the system leaves some positions undetermined.
        """
        if without_contact(system) is not system:
            from solvers.contact.local_global import local_global  # for those who need it

            return local_global(self, system)
        if without_bounded(system) is not system:
            from solvers.contact.pairs_local_global import local_global

            return local_global(self, system)
        energies = projective(system, "numba")
        springs = [energy for energy in energies if isinstance(energy, Springs)]
        alone = [Springs.joined(springs)] if len(springs) == len(energies) else []
        base = prepared(
            system,
            alone or energies,
            lambda Q: factorise(Q, self.linear, self.precision),
            rounded=self.precision != "float64",
        )
        found = compiled(base)
        if isinstance(found, PreparedCompiled):
            return found
        local = {"project": _projection(alone[0], system.vertices)} if alone else {}
        return replace(base, choice=f"{base.choice}; {found}", **local)


def _projection(springs: Springs, n: int) -> Project:
    """Compile the local step for a linear solver that is called from Python."""
    bundles, _ = kernels.Bundles.of(springs, np.arange(n), np.zeros(n, np.int64), 1, n, n + 1)
    x, b = (aligned(4 * (n + 2)) for _ in range(2))
    x[4 * (n + 1)] = FAR
    zero = bundles.right(np.zeros(n + 2))

    def project(p: Positions, y: Positions, out: Positions) -> None:
        kernels.project(bundles, p, y, x, b, zero, out)

    return project
