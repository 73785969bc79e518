"""Regularised Hessians, which have a Cholesky factor even if the exact Hessian is indefinite.

`shift-schedule` is the exact Hessian, or else the first positive definite one in a schedule of increasingly convex
ones. With active collisions the schedule is finer, and each iterate starts one level below that of the previous
iterate. The other strategies project the eigenvalues of elements (`springbench.solvers.objective.psd_projection`),
whether the Hessian is indefinite or not:

    clamp          all, lambda -> max(lambda, 0)                                     Teran et al. 2005
    absolute       all, lambda -> |lambda|                                           Chen, Liu, Levin et al. 2024
    trust-region   clamp if |rho - 1| < 0.01, else absolute, which is used first     Chen, Liu, Jacobson et al. 2024
                   rho = (g(p) - g(p + s))/-(s grad g + s H s/2) of the previous step s, H exact
    progressive    clamp, only elements at vertices with |grad g| >= tau             Fernandez-Fernandez et al. 2025

The threshold tau of `progressive` starts at infinity. It is halved if there is no factor, the first time from the
largest |grad g|, and doubled after each step. If there is still no factor (a vertex without a constraint or a spring),
multiples of a diagonal are added.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.iteration.descent_method import DescentPoint, inner_product
from springbench.solvers.objective.psd_projection import PsdProjection
from springbench.solvers.objective.step_objective import Hessian, StepObjective

DIAGONAL_SHIFTS = tuple(10.0**k for k in range(-4, 9, 2))
SHIFT_SCHEDULE = ((1.0, 0.0), (0.9, 0.0), (0.5, 0.0), (0.0, 0.0), *((0.0, by) for by in DIAGONAL_SHIFTS))
"""Pairs of the negative fraction (of the springs' transverse part) and the multiple of a diagonal; the first that has a
factor is used."""

_CONTACT_SCHEDULE = (*((keep, 0.0) for keep in (1.0, 0.75, 0.5, 0.25)), *SHIFT_SCHEDULE[3:])
"""The schedule with active collisions."""

IndefiniteStrategy = Literal["shift-schedule", "clamp", "absolute", "trust-region", "progressive"]

_TRUST_TOLERANCE = 0.01
"""Largest deviation from 1 of the ratio of actual to predicted decrease for which eigenvalues are clamped, as in the
paper."""

_MAX_HALVINGS = 60
"""Maximum number of halvings of the threshold; then all elements are projected."""


def factorise_shifted(
    hessian: Hessian,
    diagonal: NDArray[np.float64],
    shift: NDArray[np.float64] | float = 0.0,
    schedule: Sequence[tuple[float, float]] = SHIFT_SCHEDULE,
    first_level: int = 0,
) -> int | None:
    """Factorise the first positive definite Hessian of a schedule and return its level, or None.

    Args:
        hessian: the Hessian at a point.
        diagonal: diagonal whose multiples are added (3 f,) [N/m].
        shift: added to the diagonal at all levels [N/m].
        schedule: pairs of the negative fraction and the multiple of `diagonal`.
        first_level: first level to try.

    Returns:
        The level; 0 is the exact Hessian; None if no level has a factor.
    """
    for level in range(first_level, len(schedule)):
        keep, by = schedule[level]
        if hessian.factorise(keep, shift + by * diagonal if by > 0.0 else shift):
            return level
    return None


def explain_missing_factor(hessian: Hessian, diagonal_name: str) -> str:
    """Explain why no Hessian of SHIFT_SCHEDULE has a factor.

    Args:
        hessian: the Hessian at a point.
        diagonal_name: name of the diagonal whose multiples were added.
    """
    if not hessian.is_finite():
        return "the Hessian has entries that are not finite"
    return f"the Hessian is indefinite even with {SHIFT_SCHEDULE[-1][1]:g} times {diagonal_name}"


class RegularisationRule(Protocol):
    """The regularisation in one solve."""

    def factorise_hessian(self, hessian: Hessian, at: DescentPoint, diagonal: NDArray[np.float64]) -> int | None:
        """Factorise a Hessian, modified if it is not positive definite.

        Args:
            hessian: exact Hessian at the point.
            at: point, whose gradient may select the elements that are projected.
            diagonal: diagonal whose multiples are added (3f,) [N/m], as in `factorise_shifted`.

        Returns:
            The level: 0 for the exact Hessian, more for others, None for no factor.
        """
        ...

    def record_step(self, step: StepObjective, hessian: Hessian, at: DescentPoint, to: DescentPoint) -> None:
        """Record a step from a point with the given Hessian to another point.

        Args:
            step: objective of the step problem.
            hessian: exact Hessian at the first point.
            at: first point.
            to: point at which the line search ended.
        """
        ...


class ShiftScheduleRule:
    """The smallest change of a schedule.

    It is the only rule that supports energies without an element-wise form.
    """

    def __init__(self, first_level: int = 0) -> None:
        """Create the rule.

        Args:
            first_level: first level of the schedule to try; 1 if the exact Hessian is known to have no factor.
        """
        self._first_level = first_level

    def factorise_hessian(self, hessian: Hessian, at: DescentPoint, diagonal: NDArray[np.float64]) -> int | None:
        """Factorise at the first level of the schedule that has a factor.

        Args:
            hessian: exact Hessian at the point.
            at: not used.
            diagonal: diagonal whose multiples are added (3f,) [N/m].

        Returns:
            The level in SHIFT_SCHEDULE; None if no level has a factor.
        """
        return factorise_shifted(hessian, diagonal, first_level=self._first_level)

    def record_step(self, step: StepObjective, hessian: Hessian, at: DescentPoint, to: DescentPoint) -> None:
        """Record nothing.

        Args:
            step, hessian, at, to: not used.
        """


class ContactScheduleRule(ShiftScheduleRule):
    """A finer schedule for active collisions, which starts near the previous iterate's level.

    A compressed stack is indefinite for many iterations and becomes convex gradually; each of them would otherwise
    factorise the exact Hessian without success.
    """

    def __init__(self) -> None:
        self._current_level = 0

    def factorise_hessian(self, hessian: Hessian, at: DescentPoint, diagonal: NDArray[np.float64]) -> int | None:
        """Factorise, starting one level below the previous one.

        Args:
            hessian: exact Hessian at the point.
            at: not used.
            diagonal: diagonal whose multiples are added (3f,) [N/m].

        Returns:
            The level in the schedule with active collisions; None if no level has a factor.
        """
        level = factorise_shifted(
            hessian, diagonal, schedule=_CONTACT_SCHEDULE, first_level=max(0, self._current_level - 1)
        )
        self._current_level = self._current_level if level is None else level
        return level


class ClampRule(ShiftScheduleRule):
    """Eigenvalues of all elements clamped, or replaced by their absolute values.

    Attributes:
        use_absolute: whether absolute values are used.
        num_examined, num_projected: numbers of elements examined and of elements projected in the solve so far.
    """

    def __init__(self, *, use_absolute: bool = False) -> None:
        self.use_absolute = use_absolute
        self.num_examined = self.num_projected = 0

    def factorise_hessian(self, hessian: Hessian, at: DescentPoint, diagonal: NDArray[np.float64]) -> int | None:
        """Factorise the projected Hessian, with a shift if necessary.

        Args:
            hessian: exact Hessian at the point; all elements are projected.
            at: not used.
            diagonal: diagonal whose multiples are added (3f,) [N/m].

        Returns:
            0 if no element changed and nothing was added, more for other factors, None for no factor.
        """
        return self._factorise_projected(hessian, None, (0.0, *DIAGONAL_SHIFTS), diagonal)

    def _factorise_projected(
        self,
        hessian: Hessian,
        vertex_mask: NDArray[np.bool_] | None,
        shifts: tuple[float, ...],
        diagonal: NDArray[np.float64],
    ) -> int | None:
        """Return the level; it is 0 if no element changed and nothing was added."""
        found = hessian.project_to_psd(PsdProjection(use_absolute=self.use_absolute, vertex_mask=vertex_mask))
        self.num_examined, self.num_projected = (
            self.num_examined + found.num_examined,
            self.num_projected + found.num_projected,
        )
        first = int(found.num_projected > 0)
        added = (k for k, by in enumerate(shifts) if hessian.factorise_projected(found, by * diagonal))
        return next((first + k for k in added), None)


class TrustRegionRule(ClampRule):
    """Absolute eigenvalues if the quadratic model of the previous step was inaccurate, else clamped ones."""

    def __init__(self) -> None:
        super().__init__(use_absolute=True)

    def record_step(self, step: StepObjective, hessian: Hessian, at: DescentPoint, to: DescentPoint) -> None:
        """Compare the decrease in the step with the quadratic model.

        Args:
            step: objective of the step problem.
            hessian: exact Hessian at the first point, without projection.
            at: first point.
            to: point at which the line search ended.
        """
        s = to.positions - at.positions
        model = inner_product(at.gradient, s) + 0.5 * inner_product(s, hessian.matvec(s))
        rise, _ = step.objective_change(at.positions, to.positions)
        self.use_absolute = not abs(rise - model) < _TRUST_TOLERANCE * abs(model)


class ProgressiveRule(ClampRule):
    """Eigenvalues clamped for as few elements as a factor needs, those with the largest gradient."""

    def __init__(self) -> None:
        super().__init__()
        self._threshold = np.inf

    def factorise_hessian(self, hessian: Hessian, at: DescentPoint, diagonal: NDArray[np.float64]) -> int | None:
        """Factorise with the current threshold, halving it until there is a factor.

        Args:
            hessian: exact Hessian at the point.
            at: point, whose gradient [N] is compared with the threshold.
            diagonal: diagonal whose multiples are added (3f,) [N/m] if no threshold suffices.

        Returns:
            0 if no element changed and nothing was added, more for other factors, None for no factor.
        """
        force = np.abs(at.gradient).max(axis=1, initial=0.0)
        for _ in range(_MAX_HALVINGS):
            level = self._factorise_projected(hessian, force >= self._threshold, (0.0,), diagonal)
            if level is not None:
                return level
            self._threshold = 0.5 * min(self._threshold, float(force.max(initial=0.0)))
        return self._factorise_projected(hessian, None, DIAGONAL_SHIFTS, diagonal)

    def record_step(self, step: StepObjective, hessian: Hessian, at: DescentPoint, to: DescentPoint) -> None:
        """Double the threshold.

        Args:
            step, hessian, at, to: not used.
        """
        self._threshold *= 2.0


REGULARISATION_RULES: dict[IndefiniteStrategy, Callable[[], RegularisationRule]] = {
    "shift-schedule": ShiftScheduleRule,
    "clamp": ClampRule,
    "absolute": lambda: ClampRule(use_absolute=True),
    "trust-region": TrustRegionRule,
    "progressive": ProgressiveRule,
}
"""A factory of the rule for a solve, by the name of the strategy."""
