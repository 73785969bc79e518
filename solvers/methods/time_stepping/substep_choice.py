"""The substeps of an explicit method, which have a fixed number or an error tolerance."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import ceil
from typing import ClassVar, Self

from springbench.solvers.methods.time_stepping.explicit_tableaus import ExplicitTableau, SplittingMethod
from springbench.solvers.model.step_problem import ResidualIterate, Unsupported


@dataclass(frozen=True)
class SubstepChoice:
    """The choice of substeps.

    Attributes:
        num_substeps: substeps of a step for a fixed size, else the smallest stable number.
        tolerance: error tolerance of a substep [m] for an adaptive size, else 0.
        fastest_rate: rate of the fastest motion [1/s].
        description: description in words.
    """

    num_substeps: int
    tolerance: float
    fastest_rate: float
    description: str


@dataclass(frozen=True, eq=False)
class PreparedSubstepping:
    """The part of an explicit method that is set up for a system."""

    residual_iterate: ClassVar[ResidualIterate] = "none"
    num_factorisations: ClassVar[int] = 0

    method: SplittingMethod | ExplicitTableau
    substep_choice: SubstepChoice

    @property
    def order(self) -> int:
        """Order of the method."""
        return self.method.order

    @property
    def num_evaluations(self) -> int:
        """Evaluations of the forces per substep."""
        return self.method.num_evaluations

    def with_tolerance(self, tolerance: float) -> Self:
        """Return the solver with another error tolerance [m] of substeps.

        Raises:
            Unsupported: if the substeps have a fixed size.
        """
        if not self.substep_choice.tolerance:
            raise Unsupported("the method chooses no steps by an error")
        return replace(self, substep_choice=replace(self.substep_choice, tolerance=tolerance))

    def with_refined_substeps(self, refinement_factor: float) -> Self:
        """Return the solver with a multiple of the substeps, rounded up."""
        count = ceil(refinement_factor * self.substep_choice.num_substeps)
        return replace(self, substep_choice=replace(self.substep_choice, num_substeps=count))
