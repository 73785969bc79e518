"""Friction and contact of Newton's methods between their steps, where a quadratic model is inaccurate.

A half-space acts from its surface on, and a sticking vertex begins to slip after 1e-8 m. There are two remedies:

Friction is relaxed at each trial point, by nonlinear Gauss-Seidel sweeps over the vertices with friction. This is the
smoother of the truncated nonsmooth Newton method (Gräser and Sander 2019). The local problems are solved exactly,
since h (`contact.half_space.half_space_potential`) permits a closed form:

    u <- argmin F h(|u|) + Q_ii/2 |u - v|^2,   v = u - r/Q_ii tangentially,   r <- r + Q (u - previous u)

r is the gradient without friction's own part. Q majorises all else, so that no sweep increases the objective.

A step that ends in half-spaces which were inactive at its start may increase the objective. It is not shortened to end
before them, one after the other. Instead a few more steps with them active follow, until one ends below the start of
the first (watchdog technique, Chamberlain, Powell, Lemarechal and Pedersen 1982; as an active set method, Hintermüller,
Ito and Kunisch 2003).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import kernel
from solvers.contact.energy import Contact
from solvers.core.descent import DECREASE, Metric, Point, dot, search
from solvers.core.objective import StepObjective
from solvers.problem import Positions

_SWEEPS = 4
_AHEAD = 4
"""Number of additional steps in the watchdog technique."""

Newton = Callable[[Point], Positions | None]
"""Function that returns the Newton direction at a point; None if the Hessian would have to be modified."""


class Matrix(NamedTuple):
    """Q over the free vertices.

    Attributes:
        number: index of each vertex among the free ones, or -1, (n,).
        starts, columns, entries: rows by free index, columns by vertex.
        diagonal: diagonal of Q.
    """

    number: NDArray[np.int64]
    starts: NDArray[np.int64]
    columns: NDArray[np.int64]
    entries: NDArray[np.float64]
    diagonal: NDArray[np.float64]


class Settling:
    """Friction relaxation and watchdog search of Newton's methods, for one system."""

    def __init__(self, metric: Metric) -> None:
        Q, free = metric.inner, metric.system.free
        number = np.full(metric.system.vertices, -1)
        number[free] = np.arange(len(free))
        self._matrix = Matrix(number, Q.indptr.astype(np.int64), free[Q.indices], Q.data, metric.diagonal)

    def settled(self, step: StepObjective, p: Positions) -> Positions:
        """Return p (n, 3) with friction relaxed; p itself without friction."""
        out = p
        for one in _contacts(step):
            planes = one.planes
            if planes.grip.any():
                out = p.copy() if out is p else out
                settle(planes, one.slip, self._matrix, out, step.gradient(out), _SWEEPS)
        return out

    def start(self, step: StepObjective, at: Point) -> Point:
        """Relax friction at the initial point, if that decreases the objective."""
        p = self.settled(step, at.positions)
        return at if p is at.positions or step.rise(at.positions, p)[0] >= 0.0 else Point(p, step.gradient(p))

    def search(self, step: StepObjective, at: Point, direction: Positions, newton: Newton) -> Point | None:
        """Return a lower point along a direction, or after the watchdog steps; None if there is none.

        Args:
            step: objective of the step.
            at: current point.
            direction: Newton direction at the point (n, 3) [m].
            newton: returns the direction at later points.
        """
        return self._ahead(step, at, direction, newton) or self._along(step, at, direction)

    def _along(self, step: StepObjective, at: Point, direction: Positions) -> Point | None:
        return search(step, at, direction, settled=lambda p: self.settled(step, p))

    def _ahead(self, step: StepObjective, origin: Point, direction: Positions, newton: Newton) -> Point | None:
        """Take full Newton steps while each activates further half-spaces; return a point lower than the origin."""
        at, enough = origin, DECREASE * dot(origin.gradient, direction)
        for _ in range(_AHEAD):
            p = self.settled(step, step.placed(at.positions + direction))
            if step.rise(origin.positions, p)[0] <= enough:
                return Point(p, step.gradient(p))
            if not (_pressed(step, p) & ~_pressed(step, at.positions)).any():
                found = None if at is origin else self._along(step, at, direction)
                return found if found and step.rise(origin.positions, found.positions)[0] <= enough else None
            at = Point(p, step.gradient(p))
            following = newton(at)
            if following is None:
                return None
            direction = following
        return None


def _contacts(step: StepObjective) -> list[Contact]:
    return [energy for energy in step.problem.energies if isinstance(energy, Contact) and not energy.idle()]


def _pressed(step: StepObjective, p: Positions) -> NDArray[np.bool_]:
    """Return a mask of the half-spaces that are active at p."""
    return np.concatenate([one.gap(p) < 0.0 for one in _contacts(step)])


@kernel
def settle(planes, slip, matrix, p, gradient, sweeps):
    """Relax friction by Gauss-Seidel sweeps over the vertices of half-spaces with friction limit F > 0.

    Args:
        planes: contact planes.
        slip: of friction [m].
        matrix: Q over the free vertices.
        p: positions (n, 3) [m], moved tangentially to the normals.
        gradient: gradient at p (n, 3) [N] including friction's own part; updated.
        sweeps: number of sweeps.
    """
    vertices, normal, _, anchor, _, grip = planes
    number, starts, columns, entries, diagonal = matrix
    for _ in range(sweeps):
        for e in range(len(grip)):
            i = vertices[e]
            f = number[i]
            if grip[e] <= 0.0 or f < 0:
                continue
            n0, n1, n2, q = normal[e, 0], normal[e, 1], normal[e, 2], diagonal[f]
            u0, u1, u2 = p[i, 0] - anchor[e, 0], p[i, 1] - anchor[e, 1], p[i, 2] - anchor[e, 2]
            along = n0 * u0 + n1 * u1 + n2 * u2
            u0, u1, u2 = u0 - along * n0, u1 - along * n1, u2 - along * n2
            g0, g1, g2 = gradient[i, 0], gradient[i, 1], gradient[i, 2]
            along = n0 * g0 + n1 * g1 + n2 * g2
            g0, g1, g2 = g0 - along * n0, g1 - along * n1, g2 - along * n2
            weight = grip[e] / max(slip, np.sqrt(u0 * u0 + u1 * u1 + u2 * u2))
            v0, v1, v2 = u0 - (g0 - weight * u0) / q, u1 - (g1 - weight * u1) / q, u2 - (g2 - weight * u2) / q
            length = np.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
            kept = q / (q + grip[e] / slip) if length <= slip + grip[e] / q else 1.0 - grip[e] / (q * length)
            d0, d1, d2 = kept * v0 - u0, kept * v1 - u1, kept * v2 - u2
            after = grip[e] / max(slip, kept * length)
            p[i, 0], p[i, 1], p[i, 2] = p[i, 0] + d0, p[i, 1] + d1, p[i, 2] + d2
            gradient[i, 0] += after * kept * v0 - weight * u0
            gradient[i, 1] += after * kept * v1 - weight * u1
            gradient[i, 2] += after * kept * v2 - weight * u2
            for k in range(starts[f], starts[f + 1]):
                j, w = columns[k], entries[k]
                gradient[j, 0] += w * d0
                gradient[j, 1] += w * d1
                gradient[j, 2] += w * d2
