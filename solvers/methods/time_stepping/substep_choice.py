"""Substeps of a method that divides the step: a fixed number or an error tolerance."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import ceil
from typing import ClassVar, Self

from springbench.solvers.methods.time_stepping.explicit_tableaus import ExplicitTableau, SplittingMethod
from springbench.solvers.model.step_problem import ResidualIterate, Unsupported

STABILITY_SAFETY = 0.95
"""Fraction of the stability limit: at the limit a vibration neither grows nor decays, and springs are nonlinear."""

_MAX_SPRING_EVALUATIONS = 1e9
"""Maximum number of spring evaluations in a step, some seconds: compiled code cannot be interrupted meanwhile."""


def require_few_evaluations(
    solver: str,
    num_substeps: float,
    num_evaluations: int,
    num_springs: int,
    max_evaluations: float = _MAX_SPRING_EVALUATIONS,
) -> None:
    """Check that a step of fixed substeps is not too long to compute.

    Args:
        solver: name of the solver, for the message.
        num_substeps: number of substeps in a step.
        num_evaluations: evaluations of the forces per substep.
        num_springs: number of springs.
        max_evaluations: evaluations of springs that are allowed in a step.

    Raises:
        Unsupported: the step needs too many evaluations of springs.
    """
    if num_substeps * num_evaluations * max(1, num_springs) > max_evaluations:
        raise Unsupported(
            f"{solver}: is stable with {num_substeps:.3g} substeps a step, each with {num_evaluations} evaluations of "
            f"{num_springs} springs, beyond the {max_evaluations:.0e} evaluations of springs allowed in a "
            "step; take a shorter time step"
        )


def format_step_failure(tried: float, h: float, reached: float, frame: float, tolerance: float) -> str:
    """Format the error message of a frame that was not finished.

    Args:
        tried: number of steps.
        h: size of the last step [s].
        reached: time reached in the frame [s].
        frame: length of the frame [s].
        tolerance: error tolerance [m].
    """
    return (
        f"the error of {tolerance:.3g} m was not reached within {tried:.0f} steps, the last of {h:.3g} s: after "
        f"{reached:.6g} of {frame:.6g} s of the frame the forces are too sudden, or round-off is larger; use a "
        "larger error"
    )


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
            raise Unsupported("the solver has a fixed number of substeps; expected one with `error_tolerance`")
        return replace(self, substep_choice=replace(self.substep_choice, tolerance=tolerance))

    def with_refined_substeps(self, refinement_factor: float) -> Self:
        """Return the solver with a multiple of the substeps, rounded up."""
        count = ceil(refinement_factor * self.substep_choice.num_substeps)
        return replace(self, substep_choice=replace(self.substep_choice, num_substeps=count))
