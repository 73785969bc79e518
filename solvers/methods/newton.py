"""Newton's method with the exact Hessian and a direct factorisation (Nocedal and Wright 2006, section 3.4).

    p <- p - t (H + E)^-1 grad g(p)

The Hessian of compressed springs may be indefinite. It remains exact wherever it has a Cholesky factor, which preserves
quadratic convergence. Where it has none, an increasing part of the springs' negative lateral stiffness is removed, and
finally a multiple of the diagonal of Q is added. Other rules modify the eigenvalues of elements (`indefinite`, see
`solvers.core.definite`); clamping all of them (Teran et al. 2005) converges linearly. Where the
slope is small, none of these rules applies: the exact Hessian distinguishes a minimum from a saddle. From a stationary
point whose exact Hessian has no factor, the method escapes (`solvers.core.saddles`).

With active contacts, an iteration converges friction and may consist of several steps
(`solvers.contact.settling`).
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
"""Fraction of the steepest slope of a solve below which an exact Hessian without a factor indicates a saddle."""


@dataclass(frozen=True)
class Newton:
    """Newton's method; at convergence or stagnation, negative curvature is at the level of round-off.

    Args:
        indefinite: modification of indefinite Hessians (`hessian_regularisation`).
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
        """Prepare the method for a system.

        Raises:
            NotPositiveDefinite: if the system leaves some positions undetermined.
            Unsupported: if Q does not fit in memory, and for energies without an element-wise form that
                `indefinite` requires.
        """
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
        """Yield the points after `start`."""
        point, steepest, rule = start, 0.0, self._rule()
        if step.bounded and type(rule) is Graded:
            rule = Close()
        if self._settling and step.touched:
            point = self._settling.start(step, point)
        while not point.stalled:
            point, steepest = self._next(step, point, steepest, rule)
            yield point

    def certifies(self, step: StepObjective, at: Point) -> bool:
        """Return whether the stationary point `at` is a minimum, as far as the method can determine."""
        return certified(step, at.positions)

    def phases(self, step: StepObjective, at: Point) -> dict[str, Callable[[], object]]:
        """Return the gradient, the Hessian with its factorisation, and a solve as callables."""
        hessian, (keep, by) = step.hessian(at.positions), LEVELS[-1]  # any other may have no factor to solve with
        hessian.factorise(keep, by * self._diagonal)
        return {
            "gradient": lambda: step.gradient(at.positions),
            "factor": lambda: hessian.factorise(keep, by * self._diagonal),
            "solve": lambda: hessian.solve(at.gradient),
        }

    def _next(self, step: StepObjective, at: Point, steepest: float, rule: Rule) -> tuple[Point, float]:
        """Return the next point, and the steepest slope so far [J]."""
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
        """Return a lower point along a direction, or None; `exact` means an unmodified Hessian."""
        if self._settling is None or not exact or not step.touched:
            return search(step, at, direction)
        return self._settling.search(step, at, direction, lambda point: self._exact(step, point))

    @staticmethod
    def _exact(step: StepObjective, at: Point) -> Positions | None:
        """Return the direction of the exact Hessian, None if it is not positive definite."""
        hessian = step.hessian(at.positions)
        return -hessian.solve(at.gradient) if hessian.factorise() else None


def settling_for(metric: Metric) -> Settling | None:
    """Return the friction search of Newton's methods; None without contact, and with surface contact."""
    energies = metric.system.energies
    if not any(is_contact(energy) for energy in energies) or any(is_bounded(energy) for energy in energies):
        return None  # its sweeps know of no bounds
    from solvers.contact.settling import Settling  # for those who need it

    return Settling(metric)
