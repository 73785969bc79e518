"""Inexact Newton's method: conjugate gradients, preconditioned by Q^-1, on the exact Hessian (Dembo and Steihaug 1983).

    H d = -g to |H d + g| <= eta |g|,   |r|^2 = r' Q^-1 r,   eta = .9 (|g| / |g before|)^2    Eisenstat and Walker 1996

For springs Q majorises H, so that the eigenvalues of Q^-1 H are at most 1. Conjugate gradients end where they meet
negative curvature, with what they have: from the first direction of all that is -Q^-1 g, a local-global iteration.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from solvers.about import About, Reference
from solvers.contact.touching import without_contact
from solvers.core.descent import Metric, Point, PreparedDescent, dot, search
from solvers.core.objective import Hessian, Objective, StepObjective
from solvers.kernels import conjugate
from solvers.linear.inverse import Inverse
from solvers.linear.supernodal import Supernodal
from solvers.problem import Positions, System, Unsupported

_LOOSE, _TIGHT = 0.5, 1e-10
"""The bounds of eta."""

_MOST = 1000
"""Iterations of conjugate gradients: as many as the stiffest springs need for a few digits."""


@dataclass(frozen=True)
class NewtonCG:
    """Newton's method without a factor of the Hessian: it needs the memory of local-global."""

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

    def prepare(self, system: System) -> PreparedDescent:
        """Raises NotPositiveDefinite where nothing determines some positions, Unsupported for contact, and where Q fits
        nowhere."""
        if without_contact(system) is not system:
            raise Unsupported("newton-cg: Q preconditions no Contact, which is far stiffer; take newton or lbfgs")
        metric = Metric(system)
        objective = Objective(system)
        return PreparedDescent(objective, metric, Method(metric, objective), metric.choice, metric.facts)


class Method:
    """The iteration for one system. compiled: its conjugate gradients in one kernel, None where that cannot be."""

    def __init__(self, metric: Metric, objective: Objective) -> None:
        self._metric = metric
        self.compiled = _Compiled(objective, factor) if (factor := _known(metric)) else None

    def points(self, step: StepObjective, start: Point) -> Iterator[Point]:
        """The points after `start`."""
        point, eta = start, _LOOSE
        descent = self._metric.solve(point.gradient)
        while not point.stalled:
            found = None
            if dot(point.gradient, descent) > self._metric.round_off(point.positions):
                direction = self._direction(step, point, descent, eta)
                found = search(step, point, direction) or search(step, point, -descent)
            if found is None:
                yield point._replace(stalled=True)
                return
            before, descent = dot(point.gradient, descent), self._metric.solve(found.gradient)
            # The safeguard of Eisenstat and Walker: eta falls no faster than its own square.
            following = 0.9 * dot(found.gradient, descent) / before
            eta = min(_LOOSE, max(_TIGHT, following, 0.9 * eta**2 if 0.9 * eta**2 > 0.1 else 0.0))
            point = found
            yield point

    def certifies(self, step: StepObjective, at: Point) -> bool:
        """It has no factor to tell by."""
        return True

    def phases(self, step: StepObjective, at: Point) -> dict[str, Callable[[], object]]:
        """The gradient, a product with the Hessian, and a solve with Q."""
        hessian = step.hessian(at.positions)
        return {
            "gradient": lambda: step.gradient(at.positions),
            "product": lambda: hessian.multiply(at.gradient),
            "solve": lambda: self._metric.solve(at.gradient),
        }

    def _direction(self, step: StepObjective, at: Point, descent: Positions, eta: float) -> Positions:
        """What conjugate gradients make of -H^-1 g; descent: Q^-1 g."""
        hessian = step.hessian(at.positions)
        if self.compiled and not step.own:
            return self.compiled.direction(hessian, at, descent, eta)
        d, r, s = np.zeros_like(descent), at.gradient.copy(), -descent
        norm = dot(at.gradient, descent)
        limit = eta**2 * norm
        for k in range(_MOST):
            product = hessian.multiply(s)
            curvature = dot(s, product)
            if curvature <= 0.0:
                return s if k == 0 else d
            length = norm / curvature
            d += length * s
            r += length * product
            z = self._metric.solve(r)
            norm, before = dot(r, z), norm
            if norm <= limit:
                break
            s *= norm / before
            s -= z
        return d


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
        self._factor = conjugate.Factor.of(factor, system.free)
        self._scratch = np.zeros((4, system.vertices, 3))

    def direction(self, hessian: Hessian, at: Point, descent: Positions, eta: float) -> Positions:
        """See `Method._direction`."""
        d = np.empty_like(descent)
        fixed = *hessian.compiled, self._factor, self._threads(), self._held
        conjugate.direction(*fixed, at.gradient, descent, eta, _MOST, self._scratch, d)
        return d
