"""The substeps of an explicit method: their fixed number or their error tolerance, and derived properties."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import ceil
from typing import ClassVar, Self

from solvers.core.explicit_tables import Composition, Tableau
from solvers.problem import ResidualOf, Unsupported


@dataclass(frozen=True)
class Substeps:
    """The choice of substeps.

    Attributes:
        count: substeps of a step for a fixed size, else the smallest stable number.
        tolerance: error tolerance of a substep [m] for an adaptive size, else 0.
        rate: rate of the fastest motion [1/s].
        choice: description in words.
    """

    count: int
    tolerance: float
    rate: float
    choice: str


@dataclass(frozen=True, eq=False)
class Substepping:
    """The part of an explicit method that is set up for a system."""

    residual_of: ClassVar[ResidualOf] = "none"
    factorisations: ClassVar[int] = 0

    method: Composition | Tableau
    substeps: Substeps

    @property
    def order(self) -> int:
        """Order of the error."""
        return self.method.order

    @property
    def evaluations(self) -> int:
        """Evaluations of the forces per substep."""
        return self.method.evaluations

    def within(self, tolerance: float) -> Self:
        """Return the solver with another error tolerance [m] of substeps.

        Raises Unsupported for a fixed size.
        """
        if not self.substeps.tolerance:
            raise Unsupported("the method chooses no steps by an error")
        return replace(self, substeps=replace(self.substeps, tolerance=tolerance))

    def refined(self, times: float) -> Self:
        """Return the solver with a multiple of the substeps, rounded up."""
        count = ceil(times * self.substeps.count)
        return replace(self, substeps=replace(self.substeps, count=count))
