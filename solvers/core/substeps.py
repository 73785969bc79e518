"""The substeps of an explicit method: how many a step has, or by what error they are chosen, and what follows."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import ceil
from typing import ClassVar, Self

from solvers.core.explicit_tables import Composition, Tableau
from solvers.problem import ResidualOf, Unsupported


@dataclass(frozen=True)
class Substeps:
    """What the method chose. count: substeps of a step, where they have one length, else the fewest that are stable;
    tolerance [m]: of each where they have not, else 0; rate: of the fastest motion [1/s]; choice: in words."""

    count: int
    tolerance: float
    rate: float
    choice: str


@dataclass(frozen=True, eq=False)
class Substepping:
    """What of an explicit method is ready for a system."""

    residual_of: ClassVar[ResidualOf] = "none"
    factorisations: ClassVar[int] = 0

    method: Composition | Tableau
    substeps: Substeps

    @property
    def order(self) -> int:
        """Of the error."""
        return self.method.order

    @property
    def evaluations(self) -> int:
        """Of the forces, in a substep."""
        return self.method.evaluations

    def within(self, tolerance: float) -> Self:
        """The same with an error of each substep [m]. Raises Unsupported for substeps of one length."""
        if not self.substeps.tolerance:
            raise Unsupported("the method chooses no steps by an error")
        return replace(self, substeps=replace(self.substeps, tolerance=tolerance))

    def refined(self, times: float) -> Self:
        """The same with so many times the substeps, rounded up."""
        count = ceil(times * self.substeps.count)
        return replace(self, substeps=replace(self.substeps, count=count))
