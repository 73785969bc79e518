"""Nonlinear conjugate gradients, preconditioned by Q^-1, without a Hessian matrix or factorisation.

Shen et al. 2024; they precondition by the diagonal of the Hessian, as interior-point elasticity has no Q.

    d = -z + beta d_previous,   z = Q^-1 grad g,   y = g - g_previous,   w = Q^-1 y
    beta = (y z - (w y) (g d)/(d y)) / (d y)              Dai and Kou 2013
    t = -(g d)/(d H d)                                    the minimum of the quadratic model along d

H d is a product, element by element. If d is no descent direction, or the model has negative curvature along it, d is
reset to -z: a local-global iteration. A step without sufficient decrease is halved, and the step size is
collision-free. With active surface contacts, P = S Q S replaces Q (`solvers.methods.base.preconditioners`). Contact of
single vertices is not supported: it activates abruptly and friction sticks within 1e-8 m, so no quadratic model
holds for a step along d. Landing sheets took 340 to 2,600 iterations where L-BFGS took 23 to 135.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from solvers.about import About, Reference
from solvers.contact.touching import without_contact
from solvers.core.descent import Metric, Point, dot, search
from solvers.core.driver import Iterating, Iterative, largest
from solvers.core.fixed_objective import Objective
from solvers.core.objective import StepObjective
from solvers.core.preconditioning import At, Preconditioning, preconditioning
from solvers.problem import Positions, Prepared, StepProblem, System, Unsupported


@dataclass(frozen=True)
class NonlinearCG:
    """Preconditioned nonlinear conjugate gradients for all energies; needs as much memory as local-global.

    Args:
        preconditioner: see `solvers.methods.base.preconditioners`.
    """

    unstated: ClassVar[frozenset[str]] = frozenset({"preconditioner"})

    minimises: ClassVar[bool] = True
    descends: ClassVar[bool] = True
    about: ClassVar[About] = About(
        "accelerated local-global",
        Reference(
            "Shen, Xing and Cai, Runyuan and Bi, Mengxiao and Lv, Tangjie",
            2024,
            "Preconditioned nonlinear conjugate gradient method for real-time interior-point hyperelasticity",
            "10.1145/3641519.3657490",
        ),
    )

    preconditioner: Preconditioning = "factor"

    def prepare(self, system: System) -> Prepared:
        """Prepare the method for a system.

        Raises:
            NotPositiveDefinite: if the system leaves some positions undetermined.
            Unsupported: for contact of single vertices, if Q does not fit in memory, and for block preconditioners with
                energies without elements.
        """
        if without_contact(system) is not system:
            raise Unsupported(
                "pncg: does not support contact of single vertices (Contact), for which no quadratic model is valid "
                "along a direction; use lbfgs or newton, or surface-contact"
            )
        metric, objective = Metric(system), Objective(system)
        at = preconditioning(self.preconditioner, metric, objective, "pncg")
        return PreparedPncg(metric, objective, at, metric.choice + objective.interpreted, metric.facts)


@dataclass(frozen=True, eq=False)
class PreparedPncg(Iterative):
    """Nonlinear conjugate gradients, prepared for a system."""

    metric: Metric
    objective: Objective
    at: At
    choice: str
    facts: dict[str, float]

    def begin(self, problem: StepProblem, guess: Positions) -> Iterating:
        """Start a solve from an initial guess (n, 3) [m]."""
        return _Iterating(self.metric, self.at, StepObjective(self.objective, problem), guess)

    def scale(self, problem: StepProblem) -> float:
        """Return the residual [J^(1/2)] scale, below a small part of which round-off is checked."""
        return largest(problem) * self.metric.trace**0.5

    def phases(self, problem: StepProblem) -> dict[str, Callable[[], object]]:
        """Return the gradient, a Hessian product and the preconditioner as callables, at the initial guess."""
        step = StepObjective(self.objective, problem)
        p = step.placed(problem.first_guess)
        (hessian, solve), gradient = self.at(step, p), step.gradient(p)
        return {
            "gradient": lambda: step.gradient(p),
            "product": lambda: hessian.multiply(gradient),
            "solve": lambda: solve(gradient),
        }


class _Iterating(Iterating):
    """State of a solve: the current point, and the direction that led to it."""

    def __init__(self, metric: Metric, preconditioned: At, step: StepObjective, guess: Positions) -> None:
        self._metric, self._preconditioned, self._step = metric, preconditioned, step
        p = step.placed(guess)
        self._came, self._beta = np.zeros_like(p), 0.0
        self._arrive(Point(p, step.gradient(p)))

    def _arrive(self, at: Point) -> None:
        self._at, self.positions = at, at.positions
        self._hessian, self._solve = self._preconditioned(self._step, at.positions)
        self._z = self._solve(at.gradient)

    def advance(self) -> bool:
        """Do one iteration; return False if round-off prevents any further change."""
        at, z = self._at, self._z
        if not dot(at.gradient, z) > self._metric.round_off(at.positions):
            return False
        direction = self._beta * self._came - z
        found = self._along(direction) if self._beta else None
        if found is None:
            direction = -z
            found = self._along(direction) or search(self._step, at, direction)
        if found is None:
            return False
        self._arrive(found)
        y = found.gradient - at.gradient
        change = dot(direction, y)
        beta = dot(y, self._z) - dot(self._z - z, y) * dot(found.gradient, direction) / change if change > 0.0 else 0.0
        self._came, self._beta = direction, beta / change if np.isfinite(beta) and change > 0.0 else 0.0
        return True

    def _along(self, direction: Positions) -> Point | None:
        """Return a lower point by the quadratic model; None without descent or with negative curvature."""
        slope, curvature = dot(self._at.gradient, direction), dot(direction, self._hessian.multiply(direction))
        if not (slope < 0.0 < curvature):
            return None
        return search(self._step, self._at, direction, first=-slope / curvature)

    def residual(self) -> float:
        """Return the residual [J^(1/2)] of the iterate that `residual_of` names."""
        gradient = self._at.gradient
        if self._solve == self._metric.solve:
            return self._metric.norm(self._z.copy(), gradient)
        return self._metric.residual(gradient)
