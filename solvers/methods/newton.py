"""Newton's method with the exact Hessian and a direct factorisation (Nocedal and Wright 2006, section 3.4).

    p <- p - t (H + E)^-1 grad g(p)

The Hessian of compressed springs may be indefinite. It is left exact wherever it has a Cholesky factor, which keeps the
convergence quadratic; where it has none, more and more is taken from the springs' negative lateral parts, and in the
end a multiple of the diagonal of Q is added. Other rules change elements by their eigenvalues (`indefinite`, see
`solvers.core.definite`); clamping all of them (Teran et al. 2005) converges linearly. Where the slope is slight, none
of these is followed: there the exact Hessian tells a minimum from a saddle. A point where the gradient vanishes but the
exact Hessian has no factor is left (`solvers.core.saddles`).

Where something is touched, an iteration settles friction, and may be several steps (`solvers.contact.settling`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from solvers.about import About, Reference
from solvers.contact.touching import is_contact
from solvers.core.bounds import is_bounded
from solvers.core.definite import LEVELS, RULES, Close, Graded, Indefinite, Rule
from solvers.core.descent import Metric, Point, PreparedDescent, dot, search
from solvers.core.fixed_objective import Objective
from solvers.core.objective import StepObjective
from solvers.core.saddles import certified, leave
from solvers.problem import Positions, System, Unsupported

if TYPE_CHECKING:
    from solvers.contact.settling import Settling

_SLIGHT = 1e-12
"""Of the steepest slope of a solve, what tells of a saddle where the exact Hessian has no factor."""


@dataclass(frozen=True)
class Newton:
    """Newton's method. Where it ends by a close tolerance, or stalls, no curvature is negative but by round-off.

    indefinite: what is done about Hessians that are (`solvers.core.definite`).
    """

    minimises: ClassVar[bool] = True
    descends: ClassVar[bool] = True
    about: ClassVar[About] = About(
        "Newton",
        Reference("Nocedal, Jorge and Wright, Stephen J.", 2006, "Numerical Optimization", "10.1007/978-0-387-40065-5"),
        first=True,
        to_error=True,
    )

    indefinite: Indefinite = "graded"

    def prepare(self, system: System) -> PreparedDescent:
        """Raises NotPositiveDefinite where nothing determines some positions, Unsupported where Q fits nowhere, and for
        energies without elements that `indefinite` could change."""
        metric, objective = Metric(system), Objective(system)
        whole = {type(system.energies[k]).__name__ for k in objective.own if not is_bounded(system.energies[k])}
        if whole and self.indefinite != "graded":
            raise Unsupported(
                f"newton, indefinite: {self.indefinite}: changes second derivatives element by element, and there are "
                f"none of {', '.join(sorted(whole))}; take indefinite: graded"
            )
        factor = objective.matrix.factor
        facts = metric.facts | {"nnz_hessian_factor": float(factor.nonzeros)}
        choice = f"a factor of the Hessian with {factor.nonzeros:,} entries; residuals by {metric.choice}"
        choice += objective.interpreted
        return PreparedDescent(objective, metric, NewtonMethod(metric, self.indefinite), choice, facts)


class NewtonMethod:
    """The iteration of Newton's method for one system."""

    def __init__(self, metric: Metric, indefinite: Indefinite = "graded") -> None:
        self._metric, self._rule = metric, RULES[indefinite]
        self._diagonal: NDArray[np.float64] = np.repeat(metric.diagonal, 3)
        self._settling = settling_for(metric)

    def points(self, step: StepObjective, start: Point) -> Iterator[Point]:
        """The points after `start`."""
        point, steepest, rule = start, 0.0, self._rule()
        if step.bounded and type(rule) is Graded:
            rule = Close()
        if self._settling and step.touched:
            point = self._settling.start(step, point)
        while not point.stalled:
            point, steepest = self._next(step, point, steepest, rule)
            yield point

    def certifies(self, step: StepObjective, at: Point) -> bool:
        """See Method."""
        return certified(step, at.positions)

    def phases(self, step: StepObjective, at: Point) -> dict[str, Callable[[], object]]:
        """The gradient, the Hessian with its factorisation, and a solve with it."""
        hessian, (keep, by) = step.hessian(at.positions), LEVELS[-1]  # any other may have no factor to solve with
        hessian.factorise(keep, by * self._diagonal)
        return {
            "gradient": lambda: step.gradient(at.positions),
            "factor": lambda: hessian.factorise(keep, by * self._diagonal),
            "solve": lambda: hessian.solve(at.gradient),
        }

    def _next(self, step: StepObjective, at: Point, steepest: float, rule: Rule) -> tuple[Point, float]:
        """The point after `at`, and the steepest slope so far [J]."""
        hessian = step.hessian(at.positions)
        level = rule.factorised(hessian, at, self._diagonal)
        if level is None:
            return at._replace(stalled=True), steepest
        direction = -hessian.solve(at.gradient)
        fall = -dot(at.gradient, direction)
        steepest = max(fall, steepest)
        known = fall > self._metric.round_off(at.positions)
        slight = fall <= _SLIGHT * steepest
        if level > 0 and (slight or not known) and type(rule) is not Graded:
            return self._next(step, at, steepest, Graded())
        found = None
        if known and not (slight and level > 0):
            found = self._descent(step, at, direction, level == 0)
        if found is None and level > 0:
            found = leave(step, at, hessian, self._diagonal) or (search(step, at, direction) if known else None)
        if found is not None:
            rule.took(step, hessian, at, found)
        return found or at._replace(stalled=True), steepest

    def _descent(self, step: StepObjective, at: Point, direction: Positions, exact: bool) -> Point | None:
        """A lower point by a direction, None for none; exact: whether nothing was added to the Hessian."""
        if self._settling is None or not exact or not step.touched:
            return search(step, at, direction)
        return self._settling.search(step, at, direction, lambda point: self._exact(step, point))

    @staticmethod
    def _exact(step: StepObjective, at: Point) -> Positions | None:
        """The direction from a point by the exact Hessian, None where it is not positive definite."""
        hessian = step.hessian(at.positions)
        return -hessian.solve(at.gradient) if hessian.factorise() else None


def settling_for(metric: Metric) -> Settling | None:
    """What Newton's methods do about contact between their steps; None for a system without,
    and where a step may not pass through something else."""
    energies = metric.system.energies
    if not any(is_contact(energy) for energy in energies) or any(is_bounded(energy) for energy in energies):
        return None  # its sweeps know of no bounds
    from solvers.contact.settling import Settling  # for those who need it

    return Settling(metric)
