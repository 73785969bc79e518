"""What Newton's methods do about contact between their steps: it is no quadratic model's business.

A half-space acts from its surface on, and what sticks slips after a hundred-millionth of a metre. Two remedies:

Friction is settled at each trial point, by nonlinear Gauss-Seidel sweeps over the vertices that it holds (the smoother
of the truncated nonsmooth Newton method, Gräser and Sander 2019), as exactly as h can be minimised (`contact.energy`):

    u <- argmin F h(|u|) + Q_ii/2 |u - v|^2,   v = u - r/Q_ii across the normal,   r <- r + Q (u - u before)

r is the gradient less friction's own. Q majorises all else, so that no sweep raises the objective.

A step that ends in half-spaces which it did not know of may rise. It is not shortened before them, one after the other,
but stands for a few more steps that do know them, until they end below where the first began (the watchdog technique,
Chamberlain, Powell, Lemarechal and Pedersen 1982; as an active set, Hintermüller, Ito and Kunisch 2003).
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
"""Steps that a step may stand for, beside itself."""

Newton = Callable[[Point], Positions | None]
"""The direction from a point, None where there is none without a change of the Hessian."""


class Matrix(NamedTuple):
    """Q over the free vertices. number (n,): of each vertex among them, or -1; starts, columns, entries: its rows by
    those numbers, its columns by vertices; diagonal: of Q."""

    number: NDArray[np.int64]
    starts: NDArray[np.int64]
    columns: NDArray[np.int64]
    entries: NDArray[np.float64]
    diagonal: NDArray[np.float64]


class Settling:
    """Newton's methods with contact, for one system."""

    def __init__(self, metric: Metric) -> None:
        Q, free = metric.inner, metric.system.free
        number = np.full(metric.system.vertices, -1)
        number[free] = np.arange(len(free))
        self._matrix = Matrix(number, Q.indptr.astype(np.int64), free[Q.indices], Q.data, metric.diagonal)

    def settled(self, step: StepObjective, p: Positions) -> Positions:
        """p (n, 3) with what grips where friction has it; p itself where nothing grips."""
        out = p
        for one in _contacts(step):
            planes = one.planes
            if planes.grip.any():
                out = p.copy() if out is p else out
                settle(planes, one.slip, self._matrix, out, step.gradient(out), _SWEEPS)
        return out

    def start(self, step: StepObjective, at: Point) -> Point:
        """A point, settled."""
        p = self.settled(step, at.positions)
        return at if p is at.positions or step.rise(at.positions, p)[0] >= 0.0 else Point(p, step.gradient(p))

    def search(self, step: StepObjective, at: Point, direction: Positions, newton: Newton) -> Point | None:
        """A lower point by a direction, and by what it leads to; None for none."""
        return self._ahead(step, at, direction, newton) or self._along(step, at, direction)

    def _along(self, step: StepObjective, at: Point, direction: Positions) -> Point | None:
        return search(step, at, direction, settled=lambda p: self.settled(step, p))

    def _ahead(self, step: StepObjective, origin: Point, direction: Positions, newton: Newton) -> Point | None:
        """Where full steps lead, each the one of Newton's method where the one before ended, as long as each presses on
        what the one before did not; None where it is not lower than the origin."""
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
    """Which half-spaces press at p."""
    return np.concatenate([one.gap(p) < 0.0 for one in _contacts(step)])


@kernel
def settle(planes, slip, matrix, p, gradient, sweeps):
    """Sweeps over the vertices of half-spaces (`contact.energy`) with grip F > 0, moved in p (n, 3) across their
    normals. slip [m]; matrix: Q; gradient (n, 3): at p, friction's own part included; overwritten."""
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
