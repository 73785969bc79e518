"""Escape from saddle points.

There the gradient (nearly) vanishes and the Hessian H is not positive definite:

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
from springbench.solvers.iteration.descent_method import DescentPoint, backtracking_line_search, inner_product
from springbench.solvers.model.step_problem import Positions
from springbench.solvers.objective.step_objective import Hessian, StepObjective

_POWER_ITERATIONS = 60
"""Number of power iterations for a direction of negative curvature. Each amplifies that direction relative to the
others."""

_PROBE_ITERATIONS = 2
"""Number of power iterations to detect negative curvature before a saddle point is reached. If E only removes the
negative transverse parts of springs, stable modes have no component in it, so one or two iterations suffice."""

_CURVATURE_ROUNDOFF = 16.0 * np.finfo(np.float64).eps
"""Ratio to the curvature of Q below which curvature is round-off, as at a vertex without transverse stiffness."""


def is_positive_definite(step: StepObjective, p: Positions) -> bool:
    """Return whether the exact Hessian is positive definite in floating point.

    Args:
        step: objective, whose Hessian is factorised.
        p: positions (n, 3) [m].
    """
    return step.hessian(p).factorise()


def escape_saddle(
    step: StepObjective, at: DescentPoint, hessian: Hessian, diagonal: NDArray[np.float64]
) -> DescentPoint | None:
    """Return a point lower than a saddle point; None if the curvature is round-off.

    H x = s (H + E) x has a negative s for a direction x of negative curvature, and all s are at most 1. So the power
    iteration with 1 - (H + E)^-1 H converges to it.

    Args:
        step: the objective.
        at: the saddle point.
        hessian: the Hessian there, factorised as H + E.
        diagonal: diagonal of Q (3f,) [N/m].
    """
    found = _find_negative_curvature(at, hessian, diagonal, _POWER_ITERATIONS)
    if found is None:
        return None
    x, curvature = found
    fall = step.inertial_prediction()
    rise, noise = step.objective_change(at.positions, fall)
    if -rise > noise and step.max_step_size(at.positions, fall - at.positions) == 1.0:
        return DescentPoint(fall, step.gradient(fall), is_past_saddle=True)
    reach = float(np.ptp(at.positions, axis=0).max(initial=0.0)) or 1.0
    found = backtracking_line_search(step, at, x, initial_step=reach, directional_curvature=curvature)
    return found and found._replace(is_past_saddle=True)


def probe_negative_curvature(
    step: StepObjective, at: DescentPoint, hessian: Hessian, diagonal: NDArray[np.float64]
) -> DescentPoint | None:
    """Return a lower point next to one that approaches a saddle point, or None.

    It is None if a few power iterations find no negative curvature.

    Args:
        step: the objective.
        at: point from which the line search starts.
        hessian: the Hessian H of a point near `at`, factorised as H + E.
        diagonal: diagonal of Q (3f,) [N/m].
    """
    found = _find_negative_curvature(at, hessian, diagonal, _PROBE_ITERATIONS)
    if found is None:
        return None
    x, curvature = found
    scale = float(np.abs(at.positions - step.problem.current_positions).max(initial=0.0)) or 1.0
    return backtracking_line_search(step, at, x, initial_step=scale, directional_curvature=curvature)


@lru_cache(maxsize=1)
def _random_directions(count: int) -> Positions:
    """Return pseudorandom directions (count, 3), identical in each call and without symmetry."""
    x = np.random.default_rng(0).normal(size=(count, 3))
    x.flags.writeable = False
    return x


def _find_negative_curvature(
    at: DescentPoint, hessian: Hessian, diagonal: NDArray[np.float64], powers: int
) -> tuple[Positions, float] | None:
    """Return a non-ascending direction of negative curvature, scaled to maximum 1, and its curvature [N/m]."""
    free = hessian.free_vertices
    x = np.zeros_like(at.positions)
    x[free] = _random_directions(len(free))
    for _ in range(powers):
        x -= hessian.solve(hessian.matvec(x))
        x /= np.abs(x).max(initial=0.0) or 1.0
    curvature = inner_product(x, hessian.matvec(x))
    if not curvature < -_CURVATURE_ROUNDOFF * float(diagonal @ x[free].ravel() ** 2):
        return None
    return (-x if inner_product(at.gradient, x) > 0.0 else x), curvature
