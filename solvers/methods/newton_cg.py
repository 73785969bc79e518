"""Inexact Newton's method: conjugate gradients, preconditioned by Q^-1, on the exact Hessian (Dembo and Steihaug 1983).

    H d = -g to |H d + g| <= eta |g|,   |r|^2 = r' Q^-1 r,   eta = .9 (|g| / |g before|)^2    Eisenstat and Walker 1996

For springs Q majorises H, so that the eigenvalues of Q^-1 H are at most 1. Conjugate gradients end where they meet
negative curvature, with what they have: from the first direction of all that is -Q^-1 g, a local-global iteration.

What else may precondition it, and what takes the place of Q where something is touched, `solvers.core.preconditioning`
tells. An iteration settles friction, and may be several steps, as that of Newton's method.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from solvers.about import About, Reference
from solvers.core.descent import Metric, Point, PreparedDescent, dot, search
from solvers.core.fixed_objective import Objective
from solvers.core.objective import Hessian, StepObjective
from solvers.core.preconditioning import Preconditioner, Preconditioning, Scaled, preconditioning
from solvers.device import Precise
from solvers.kernels import conjugate
from solvers.linear.inverse import Inverse
from solvers.linear.krylov import CURVED, Iteration
from solvers.linear.supernodal import Supernodal
from solvers.methods.newton import settling_for
from solvers.problem import Positions, Prepared, System

_LOOSE, _TIGHT = 0.5, 1e-10
"""The bounds of eta."""

_TOUCHED = 1e-4
"""The upper one where something is touched: what sticks does so within a hundred-millionth of a metre, and a direction
that misses that by little leads where another quadratic model holds."""

_MOST = 1000
"""Iterations of conjugate gradients: as many as the stiffest springs need for a few digits."""


@dataclass(frozen=True)
class NewtonCG(Precise):
    """Newton's method without a factor of the Hessian: it needs the memory of local-global.

    preconditioner: of conjugate gradients; `solvers.core.preconditioning` tells them. A device knows schwarz.
    """

    unstated: ClassVar[frozenset[str]] = Precise.unstated | {"preconditioner"}

    minimises: ClassVar[bool] = True
    descends: ClassVar[bool] = True
    about: ClassVar[About] = About(
        "Newton",
        Reference(
            "Dembo, Ron S. and Steihaug, Trond",
            1983,
            "Truncated-Newton algorithms for large-scale unconstrained optimization",
            "10.1007/BF02592055",
        ),
    )

    preconditioner: Preconditioning = "factor"

    def prepare(self, system: System) -> Prepared:
        """Raises NotPositiveDefinite where nothing determines some positions, Unsupported where Q fits nowhere, and for
        blocks of energies without elements."""
        if self.device == "cuda":
            from solvers.cuda.device import ready  # for those who ask for it

            ready("newton-cg")
            from solvers.cuda.newton_cg import prepare

            return prepare(system, self.preconditioner, self.real, (_LOOSE, _TIGHT), _MOST)
        metric = Metric(system)
        objective = Objective(system)
        method = TruncatedNewton(metric, objective, self.preconditioner)
        return PreparedDescent(objective, metric, method, metric.choice + objective.interpreted, metric.facts)


class TruncatedNewton:
    """The iteration for one system. compiled: its conjugate gradients in one kernel, None where that cannot be."""

    def __init__(self, metric: Metric, objective: Objective, by: Preconditioning = "factor") -> None:
        self._metric, self._at = metric, preconditioning(by, metric, objective, "newton-cg")
        factor = _known(metric) if by == "factor" else None
        self.compiled = _Compiled(objective, factor) if factor else None
        self._settling = settling_for(metric)

    def points(self, step: StepObjective, start: Point) -> Iterator[Point]:
        """The points after `start`."""
        loose = _TOUCHED if step.touched else _LOOSE
        point, eta = self._settling.start(step, start) if self._settling and step.touched else start, loose
        hessian, solve = self._at(step, point.positions)
        descent = solve(point.gradient)
        while not point.stalled:
            found = None
            if dot(point.gradient, descent) > self._metric.round_off(point.positions):
                direction = self._direction(step, hessian, solve, point, descent, eta)
                found = self._along(step, point, direction, eta) or search(step, point, -descent)
            if found is None:
                yield point._replace(stalled=True)
                return
            hessian, solve = self._at(step, found.positions)
            before, descent = dot(point.gradient, descent), solve(found.gradient)
            # The safeguard of Eisenstat and Walker: eta falls no faster than its own square.
            following = 0.9 * dot(found.gradient, descent) / before
            eta = min(loose, max(_TIGHT, following, 0.9 * eta**2 if 0.9 * eta**2 > 0.1 else 0.0))
            point = found
            yield point

    def _along(self, step: StepObjective, at: Point, direction: Positions, eta: float) -> Point | None:
        """A lower point by a direction, None for none."""
        if self._settling is None or not step.touched:
            return search(step, at, direction)

        def following(point: Point) -> Positions:
            hessian, solve = self._at(step, point.positions)
            return self._direction(step, hessian, solve, point, solve(point.gradient), eta)

        return self._settling.search(step, at, direction, following)

    def certifies(self, step: StepObjective, at: Point) -> bool:
        """It has no factor to tell by."""
        return True

    def phases(self, step: StepObjective, at: Point) -> dict[str, Callable[[], object]]:
        """The gradient, a product with the Hessian, and what preconditions it."""
        hessian, solve = self._at(step, at.positions)
        return {
            "gradient": lambda: step.gradient(at.positions),
            "product": lambda: hessian.multiply(at.gradient),
            "solve": lambda: solve(at.gradient),
        }

    def _direction(
        self,
        step: StepObjective,
        hessian: Hessian,
        solve: Preconditioner,
        at: Point,
        descent: Positions,
        eta: float,
    ) -> Positions:
        """What conjugate gradients make of -H^-1 g; descent: what `solve`, the preconditioner, makes of g."""
        if self.compiled and not step.own:
            return self.compiled.direction(hessian, solve, at, descent, eta)
        product = dot(at.gradient, descent)
        newton = _Newton(hessian, solve, at.gradient, descent, eta**2 * product)
        count, ended = newton.iterate(product, _MOST)
        return newton.p if ended == CURVED and count == 0 else newton.d


class _Newton(Iteration):
    """H d = -g to a limit of r'z [J]; descent: what `solve`, the preconditioner, makes of the gradient g."""

    def __init__(
        self, hessian: Hessian, solve: Preconditioner, gradient: Positions, descent: Positions, limit: float
    ) -> None:
        self._hessian, self._solve, self._limit = hessian, solve, limit
        self.d, self.p, self._r, self._z = np.zeros_like(descent), np.zeros_like(descent), -gradient, -descent

    def turn(self, product: float, before: float) -> float:
        """See Iteration."""
        self.p *= product / before
        self.p += self._z
        self._product = self._hessian.multiply(self.p)
        return dot(self.p, self._product)

    def go(self, product: float, curvature: float) -> float:
        """See Iteration."""
        length = product / curvature
        self.d += length * self.p
        self._r -= length * self._product
        self._z = self._solve(self._r)
        return dot(self._r, self._z)

    def convex(self, curvature: float) -> bool:
        """See Iteration."""
        return not curvature <= 0.0

    def near(self, product: float) -> bool:
        """See Iteration."""
        return product <= self._limit


def _known(metric: Metric) -> Supernodal | None:
    """A factor of the metric that kernels know, small as it may be; None where Q has none."""
    if isinstance(metric.factor, Inverse):
        return Supernodal(metric.inner)
    return metric.factor if isinstance(metric.factor, Supernodal) else None


class _Compiled:
    """The same conjugate gradients in one kernel, for springs, forms and elements."""

    def __init__(self, objective: Objective, factor: Supernodal) -> None:
        system = objective.system
        self._threads, self._held = factor.threads, system.pins.vertices[system.pins.exact]
        self._factor = conjugate.among(factor, system.free)
        self._scratch = np.zeros((4, system.vertices, 3))

    def direction(
        self, hessian: Hessian, solve: Preconditioner, at: Point, descent: Positions, eta: float
    ) -> Positions:
        """See `TruncatedNewton._direction`."""
        d = np.empty_like(descent)
        shrunk = solve.shrunk if isinstance(solve, Scaled) else None
        solving = self._factor, self._threads(), self._held, shrunk
        newton = conjugate.Newton(hessian.compiled, *solving, d, *self._scratch)
        conjugate.direction(newton, at.gradient, descent, eta, _MOST)
        return d
