"""Inexact Newton's method: conjugate gradients, preconditioned by Q^-1, on the exact Hessian (Dembo and Steihaug 1983).

    H d = -g to |H d + g| <= eta |g|,   |r|^2 = r' Q^-1 r,   eta = .9 (|g| / |g before|)^2    Eisenstat and Walker 1996

For springs Q majorises H, so that the eigenvalues of Q^-1 H are at most 1. Conjugate gradients end where they meet
negative curvature, with what they have: from the first direction of all that is -Q^-1 g, a local-global iteration.

Contact is far stiffer than Q, on a few vertices. There P = S Q S takes the place of Q, with S_i = (I + W_i/Q_ii)^(1/2)
of the blocks W_i that it adds to H: on these vertices P is Q + W but for what couples them, and it is Q on all others.
An iteration settles friction, and may be several steps, as that of Newton's method.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from solvers.about import About, Reference
from solvers.core.descent import Metric, Point, PreparedDescent, dot, search
from solvers.core.fixed_objective import Objective
from solvers.core.objective import Hessian, StepObjective
from solvers.energies.elements import add_blocks
from solvers.kernels import conjugate
from solvers.linear.inverse import Inverse
from solvers.linear.krylov import CURVED, Iteration
from solvers.linear.supernodal import Supernodal
from solvers.methods.newton import settling_for
from solvers.problem import Positions, System

_LOOSE, _TIGHT = 0.5, 1e-10
"""The bounds of eta."""

_TOUCHED = 1e-4
"""The upper one where something is touched: what sticks does so within a hundred-millionth of a metre, and a direction
that misses that by little leads where another quadratic model holds."""

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
        """Raises NotPositiveDefinite where nothing determines some positions, Unsupported where Q fits nowhere."""
        metric = Metric(system)
        objective = Objective(system)
        choice = metric.choice + objective.interpreted
        return PreparedDescent(objective, metric, TruncatedNewton(metric, objective), choice, metric.facts)


Preconditioner = Callable[[Positions], Positions]
"""Gradients [N] to displacements [m], both (n, 3)."""


class Scaled:
    """(S Q S)^-1 with S_i = (I + W_i/Q_ii)^(1/2) for some vertices, I for all others.

    shrunk: these vertices (c,), and S_i^-1 (c, 3, 3)."""

    def __init__(self, metric: Metric, vertices: NDArray[np.int64], blocks: NDArray[np.float64]) -> None:
        """blocks: W (c, 3, 3) [N/m] of vertices (c,), positive semidefinite."""
        self._metric, system = metric, metric.system
        resists = np.full(system.vertices, np.inf)
        resists[system.free] = metric.diagonal
        size, axes = np.linalg.eigh(blocks)
        shrunk = (1.0 + np.maximum(0.0, size) / resists[vertices, None]) ** -0.5
        self.shrunk = vertices, (axes * shrunk[:, None, :]) @ axes.transpose(0, 2, 1)

    def __call__(self, b: Positions) -> Positions:
        """(S Q S)^-1 b, (n, 3)."""
        scaled = b.copy()
        self._shrink(scaled)
        x = self._metric.solve(scaled)
        self._shrink(x)
        return x

    def _shrink(self, x: Positions) -> None:
        vertices, root = self.shrunk
        x[vertices] = np.einsum("vij,vj->vi", root, x[vertices])


def preconditioned(metric: Metric, step: StepObjective, p: Positions) -> tuple[Hessian, Preconditioner]:
    """The Hessian at p (n, 3), and what preconditions it there: Q^-1, or (S Q S)^-1 where something is touched."""
    hessian = step.hessian(p)
    beyond = step.touched or any(len(blocks.vertices) for blocks in hessian.pairs)
    return hessian, Scaled(metric, *_beyond(step, hessian, len(p))) if beyond else metric.solve


def _beyond(step: StepObjective, hessian: Hessian, n: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """What elements that are in no Q add to the blocks of n vertices: which (c,), and the blocks (c, 3, 3) [N/m]."""
    blocks, acted = np.zeros((n, 3, 3)), np.zeros(n, np.bool_)
    for one, curvature in zip(step.stated, hessian.curvature, strict=True):
        if not one.projective:
            k = one.elements.vertices.shape[1]
            places = np.full((len(curvature), k * k), -1)
            places[:, :: k + 1] = one.elements.vertices
            add_blocks(one.elements, places, curvature, blocks)
            acted[one.elements.vertices] = True
    for pairs in hessian.pairs:
        k = pairs.vertices.shape[1]
        places = np.full((len(pairs.vertices), k * k), -1)
        places[:, :: k + 1] = pairs.vertices
        pairs.add(places, blocks)
        acted[pairs.vertices] = True
    acted &= blocks.any(axis=(1, 2))
    return np.flatnonzero(acted), blocks[acted]


class TruncatedNewton:
    """The iteration for one system. compiled: its conjugate gradients in one kernel, None where that cannot be."""

    def __init__(self, metric: Metric, objective: Objective) -> None:
        self._metric = metric
        self.compiled = _Compiled(objective, factor) if (factor := _known(metric)) else None
        self._settling = settling_for(metric)

    def points(self, step: StepObjective, start: Point) -> Iterator[Point]:
        """The points after `start`."""
        loose = _TOUCHED if step.touched else _LOOSE
        point, eta = self._settling.start(step, start) if self._settling and step.touched else start, loose
        hessian, solve = preconditioned(self._metric, step, point.positions)
        descent = solve(point.gradient)
        while not point.stalled:
            found = None
            if dot(point.gradient, descent) > self._metric.round_off(point.positions):
                direction = self._direction(step, hessian, solve, point, descent, eta)
                found = self._along(step, point, direction, eta) or search(step, point, -descent)
            if found is None:
                yield point._replace(stalled=True)
                return
            hessian, solve = preconditioned(self._metric, step, found.positions)
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
            hessian, solve = preconditioned(self._metric, step, point.positions)
            return self._direction(step, hessian, solve, point, solve(point.gradient), eta)

        return self._settling.search(step, at, direction, following)

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
