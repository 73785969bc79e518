"""Saddles: points where the gradient vanishes, or nearly, and the Hessian H is not positive definite.

    x' H x < 0:   g falls along x and along -x, by x' H x / 2 at second order

Symmetric starts lead to them, and a residual does not tell them from minima: a factor of H does. Such a point is left
for free fall, where that is lower (what is stiff turns over slowly), or along a direction of negative curvature (More
and Sorensen 1979), found by power iterations on (H + E)^-1 E, with an E that makes H positive definite. The same point
always gives the same direction.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from solvers.core.descent import Point, dot, search
from solvers.core.objective import Hessian, StepObjective
from solvers.problem import Positions

_POWERS = 60
"""Power iterations for a direction of negative curvature. Each widens its lead, however narrow, over the rest."""

_FEW = 2
"""The same, to find out on the way whether there is any: an E that leaves springs' negative lateral parts out has no
share in what is stable, so that a power or two are left with what is not."""

_NO_DIGITS = 16.0 * np.finfo(np.float64).eps
"""Curvature this small beside that of Q is round-off: that of a vertex which nothing holds sideways."""


def certified(step: StepObjective, p: Positions) -> bool:
    """Whether the exact Hessian at p (n, 3) is positive definite in floating point."""
    return step.hessian(p).factorise()


def leave(step: StepObjective, at: Point, hessian: Hessian, diagonal: NDArray[np.float64]) -> Point | None:
    """A lower point than a saddle, None where no curvature is negative but by round-off.

    hessian: factorised as H + E; diagonal (3f,): that of Q [N/m]. H x = s (H + E) x has an s below zero for such a
    direction x, and all s are at most 1: the power iteration on 1 - (H + E)^-1 H tends to it.
    """
    found = _curved(at, hessian, diagonal, _POWERS)
    if found is None:
        return None
    x, curvature = found
    fall = step.fall()
    rise, noise = step.rise(at.positions, fall)
    if -rise > noise and step.reach(at.positions, fall - at.positions) == 1.0:
        return Point(fall, step.gradient(fall), left=True)
    reach = float(np.ptp(at.positions, axis=0).max(initial=0.0)) or 1.0
    found = search(step, at, x, first=reach, curvature=curvature)
    return found and found._replace(left=True)


def aside(step: StepObjective, at: Point, hessian: Hessian, diagonal: NDArray[np.float64]) -> Point | None:
    """A lower point beside one on the way to a saddle, None where so few powers find no negative curvature.

    hessian: at a point near `at`, as in `leave`; so is diagonal.
    """
    found = _curved(at, hessian, diagonal, _FEW)
    if found is None:
        return None
    x, curvature = found
    way = float(np.abs(at.positions - step.problem.current).max(initial=0.0)) or 1.0
    return search(step, at, x, first=way, curvature=curvature)


@lru_cache(maxsize=1)
def _random(count: int) -> Positions:
    """The same directions (count, 3) each time, without any order or symmetry."""
    x = np.random.default_rng(0).normal(size=(count, 3))
    x.flags.writeable = False
    return x


def _curved(at: Point, hessian: Hessian, diagonal: NDArray[np.float64], powers: int) -> tuple[Positions, float] | None:
    """A direction of negative curvature that does not rise, its largest entry 1, and that curvature [N/m]."""
    free = hessian.free
    x = np.zeros_like(at.positions)
    x[free] = _random(len(free))
    for _ in range(powers):
        x -= hessian.solve(hessian.multiply(x))
        x /= np.abs(x).max(initial=0.0) or 1.0
    curvature = dot(x, hessian.multiply(x))
    if not curvature < -_NO_DIGITS * float(diagonal @ x[free].ravel() ** 2):
        return None
    return (-x if dot(at.gradient, x) > 0.0 else x), curvature
