"""Escape from saddle points, where the gradient (nearly) vanishes and the Hessian H is not positive definite.

    x' H x < 0:   g decreases along x and along -x, by x' H x / 2 at second order

Symmetric initial states lead to saddle points. The residual does not distinguish them from minima; a factorisation of H
does. The next point is the inertial prediction, if it is lower (a stiff system is slow to leave the saddle), or lies
along a direction of negative curvature (More and Sorensen 1979). Such a direction is computed by power iterations with
(H + E)^-1 E, where E makes H + E positive definite. It is deterministic for a given point.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from solvers.core.descent import Point, dot, search
from solvers.core.objective import Hessian, StepObjective
from solvers.problem import Positions

_POWERS = 60
"""Number of power iterations for a direction of negative curvature. Each increases its dominance, however slowly."""

_FEW = 2
"""Number of power iterations to detect negative curvature before a saddle point is reached. If E only removes the
negative transverse parts of springs, stable modes have no component in it, so one or two iterations suffice."""

_NO_DIGITS = 16.0 * np.finfo(np.float64).eps
"""Ratio to the curvature of Q below which curvature is round-off, as at a vertex without transverse stiffness."""


def certified(step: StepObjective, p: Positions) -> bool:
    """Return whether the exact Hessian at p (n, 3) is positive definite in floating point."""
    return step.hessian(p).factorise()


def leave(step: StepObjective, at: Point, hessian: Hessian, diagonal: NDArray[np.float64]) -> Point | None:
    """Return a point lower than a saddle point, or None if negative curvature is only round-off.

    H x = s (H + E) x has a negative s for a direction x of negative curvature, and all s are at most 1. So the power
    iteration with 1 - (H + E)^-1 H converges to it.

    Args:
        step: the objective.
        at: the saddle point.
        hessian: the Hessian there, factorised as H + E.
        diagonal: diagonal of Q (3f,) [N/m].
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
    """Return a lower point next to one that approaches a saddle point, or None.

    It is None if a few power iterations find no negative curvature. The arguments are those of `leave`; the
    Hessian is that of a point near `at`.
    """
    found = _curved(at, hessian, diagonal, _FEW)
    if found is None:
        return None
    x, curvature = found
    way = float(np.abs(at.positions - step.problem.current).max(initial=0.0)) or 1.0
    return search(step, at, x, first=way, curvature=curvature)


@lru_cache(maxsize=1)
def _random(count: int) -> Positions:
    """Return pseudorandom directions (count, 3), identical in each call and without symmetry."""
    x = np.random.default_rng(0).normal(size=(count, 3))
    x.flags.writeable = False
    return x


def _curved(at: Point, hessian: Hessian, diagonal: NDArray[np.float64], powers: int) -> tuple[Positions, float] | None:
    """Return a non-ascending direction of negative curvature, scaled to maximum 1, and its curvature [N/m]."""
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
