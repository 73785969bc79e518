"""Local-global iterations, compiled as a whole: no Python between a step's beginning and its end.

Factors of float64 solve for positions, Q p = A'K d + y. Less precise ones solve for corrections,
p <- p - Q^-1 grad g(p), with the gradient in float64: the iterations end where those of float64 do, to all of its
digits, and only the way there differs.
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
    """Compiled steps over a linear solver that is chosen by size, or given.

    linear: the solver of Q p = b; precision: of its stored entries.
    """

    minimises: ClassVar[bool] = True
    descends: ClassVar[bool] = True
    about: ClassVar[About] = About(LOCAL_GLOBAL, LIU_2013, first=True)

    linear: Linear = "auto"
    precision: Precision = "float64"

    def prepare(self, system: System) -> Prepared:
        """Raises Unsupported for energies that are neither projective nor contact, NotPositiveDefinite."""
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
    """The compiled local step for a linear solver that is called from Python."""
    bundles, _ = kernels.Bundles.of(springs, np.arange(n), np.zeros(n, np.int64), 1, n, n + 1)
    x, b = (aligned(4 * (n + 2)) for _ in range(2))
    x[4 * (n + 1)] = FAR
    zero = bundles.right(np.zeros(n + 2))

    def project(p: Positions, y: Positions, out: Positions) -> None:
        kernels.project(bundles, p, y, x, b, zero, out)

    return project
