"""Newton-CG: inexact Newton method with preconditioned conjugate gradients (Dembo and Steihaug 1983).

    H d = -g to |H d + g| <= eta |g|,   |r|^2 = r' Q^-1 r,   eta = .9 (|g| / |g previous|)^2  Eisenstat and Walker 1996

For springs Q majorises H, so the eigenvalues of Q^-1 H are at most 1. Conjugate gradients stop at a direction of
negative curvature with their current iterate; at the first direction, that is -Q^-1 g, a local-global iteration.

`solvers.methods.base.preconditioners` documents the other preconditioners, and the matrix that replaces Q with active
contacts. An iteration converges friction, and may consist of several steps, as in Newton's method.
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
"""Upper and lower bound of eta."""

_TOUCHED = 1e-4
"""Upper bound of eta with active contacts: sticking friction acts within 1e-8 m, and a direction with a small error on
that scale leads to where another quadratic model holds."""

_MOST = 1000
"""Maximum number of conjugate gradient iterations: the stiffest springs need it for a few digits."""


@dataclass(frozen=True)
class NewtonCG(Precise):
    """Newton's method without a factorisation of the Hessian; needs as much memory as local-global.

    Args:
        preconditioner: of conjugate gradients (`solvers.methods.base.preconditioners`); a device supports schwarz only.
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
        """Prepare the method for a system.

        Raises:
            NotPositiveDefinite: if the system leaves some positions undetermined.
            Unsupported: if Q does not fit in memory, and for block preconditioners with energies without elements.
        """
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
    """The iteration for one system; `compiled` is the fused CG kernel, None if unavailable."""

    def __init__(self, metric: Metric, objective: Objective, by: Preconditioning = "factor") -> None:
        self._metric, self._at = metric, preconditioning(by, metric, objective, "newton-cg")
        factor = _known(metric) if by == "factor" else None
        self.compiled = _Compiled(objective, factor) if factor else None
        self._settling = settling_for(metric)

    def points(self, step: StepObjective, start: Point) -> Iterator[Point]:
        """Yield the points after `start`."""
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
            # Safeguard of Eisenstat and Walker: eta decreases no faster than its own square.
            following = 0.9 * dot(found.gradient, descent) / before
            eta = min(loose, max(_TIGHT, following, 0.9 * eta**2 if 0.9 * eta**2 > 0.1 else 0.0))
            point = found
            yield point

    def _along(self, step: StepObjective, at: Point, direction: Positions, eta: float) -> Point | None:
        """Return a lower point along a direction, or None."""
        if self._settling is None or not step.touched:
            return search(step, at, direction)

        def following(point: Point) -> Positions:
            hessian, solve = self._at(step, point.positions)
            return self._direction(step, hessian, solve, point, solve(point.gradient), eta)

        return self._settling.search(step, at, direction, following)

    def certifies(self, step: StepObjective, at: Point) -> bool:
        """Return True: without a factor, definiteness is unknown."""
        return True

    def phases(self, step: StepObjective, at: Point) -> dict[str, Callable[[], object]]:
        """Return the gradient, a product with the Hessian and the preconditioner as callables."""
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
        """Solve H d = -g approximately; `descent` is the preconditioned gradient."""
        if self.compiled and not step.own:
            return self.compiled.direction(hessian, solve, at, descent, eta)
        product = dot(at.gradient, descent)
        newton = _Newton(hessian, solve, at.gradient, descent, eta**2 * product)
        count, ended = newton.iterate(product, _MOST)
        return newton.p if ended == CURVED and count == 0 else newton.d


class _Newton(Iteration):
    """Conjugate gradients for H d = -g.

    Args:
        hessian: H.
        solve: the preconditioner.
        gradient: g (n, 3).
        descent: the preconditioned gradient.
        limit: tolerance of r'z [J].
    """

    def __init__(
        self, hessian: Hessian, solve: Preconditioner, gradient: Positions, descent: Positions, limit: float
    ) -> None:
        self._hessian, self._solve, self._limit = hessian, solve, limit
        self.d, self.p, self._r, self._z = np.zeros_like(descent), np.zeros_like(descent), -gradient, -descent

    def turn(self, product: float, before: float) -> float:
        """Update the search direction p; return p'Ap."""
        self.p *= product / before
        self.p += self._z
        self._product = self._hessian.multiply(self.p)
        return dot(self.p, self._product)

    def go(self, product: float, curvature: float) -> float:
        """Update the iterate, r and z; return r'z."""
        length = product / curvature
        self.d += length * self.p
        self._r -= length * self._product
        self._z = self._solve(self._r)
        return dot(self._r, self._z)

    def convex(self, curvature: float) -> bool:
        """Return whether the curvature along p is positive."""
        return not curvature <= 0.0

    def near(self, product: float) -> bool:
        """Return whether r'z has reached the tolerance."""
        return product <= self._limit


def _known(metric: Metric) -> Supernodal | None:
    """Return a factor of the metric that kernels support, however small; None if Q has none."""
    if isinstance(metric.factor, Inverse):
        return Supernodal(metric.inner)
    return metric.factor if isinstance(metric.factor, Supernodal) else None


class _Compiled:
    """Conjugate gradients in one kernel, for springs, quadratic forms and elements."""

    def __init__(self, objective: Objective, factor: Supernodal) -> None:
        system = objective.system
        self._threads, self._held = factor.threads, system.pins.vertices[system.pins.exact]
        self._factor = conjugate.among(factor, system.free)
        self._scratch = np.zeros((4, system.vertices, 3))

    def direction(
        self, hessian: Hessian, solve: Preconditioner, at: Point, descent: Positions, eta: float
    ) -> Positions:
        """Solve H d = -g approximately; `descent` is the preconditioned gradient."""
        d = np.empty_like(descent)
        shrunk = solve.shrunk if isinstance(solve, Scaled) else None
        solving = self._factor, self._threads(), self._held, shrunk
        newton = conjugate.Newton(hessian.compiled, *solving, d, *self._scratch)
        conjugate.direction(newton, at.gradient, descent, eta, _MOST)
        return d
