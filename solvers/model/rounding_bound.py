"""A running bound of the rounding error of a gradient at each vertex.

    delta_i = eps * (sum of the absolute values of all terms that are added up at vertex i)

    inertia  h (|p| + |target|)        force  |f|        pins  w (|p| + |pin|)
    springs  k (max(1, r/l - 1) (|p_i| + |p_j|) + l + r)   at both ends

The term of a spring includes the rounding of the positions, which its Hessian multiplies (1 along the spring,
|1 - r/l| across), and that of its own length. Other energies provide their absolute terms in the same form
(`RoundingBoundEnergy`). For an energy that does not, the rounding of the positions is multiplied by its Hessian, and
the gradient itself is assumed to be rounded once (Higham 2002, Accuracy and Stability of Numerical Algorithms, section
3.3: running error analysis).

The bound at a vertex includes only terms at that vertex. A stiff or a distant component does not change the bound at
the other vertices, and an inactive strain limit adds nothing, however stiff it is.
"""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.model.step_problem import Energy, Positions, StepProblem, StopRule

EPS = float(np.finfo(np.float64).eps)

ROUNDOFF_FACTOR = StopRule().roundoff_floor
"""Multiple of the bound up to which a gradient counts as round-off.

It is 8. Solvers that iterate without a limit end at 0.1 to 0.9 of the bound at the worst vertex of most hard scenes,
and at 2 in the worst scene; iterates that have not converged are at a hundred or more."""

FloatArray = NDArray[np.float64]


@runtime_checkable
class RoundingBoundEnergy(Energy, Protocol):
    """An energy that provides the absolute terms of its gradient."""

    def add_absolute_terms(self, p: Positions, out: FloatArray) -> None:
        """Add the absolute terms of the gradient to `out`.

        Multiplied by eps they bound its rounding error at each vertex, including that of the positions.

        Args:
            p: positions (n, 3) [m].
            out: sum of absolute terms (n,) [N], updated.
        """
        ...


def gradient_roundoff(problem: StepProblem, p: Positions) -> FloatArray:
    """Return the bound delta of the rounding error of `problem.gradient(p)` at each vertex.

    Args:
        problem: the step.
        p: positions (n, 3) [m].

    Returns:
        Bound (n,) [N], zero at exactly pinned vertices and infinite where a term overflows.
    """
    s, size = problem.system, stable_row_norms(p)
    with np.errstate(over="ignore", invalid="ignore"):
        out = s.inertia_diagonal * (size + stable_row_norms(problem.inertial_target)) + stable_row_norms(
            problem.external_force
        )
        for energy in problem.energies:
            (energy if isinstance(energy, RoundingBoundEnergy) else _HessianRoundingBound(energy)).add_absolute_terms(
                p, out
            )
        soft, vertices, weight = s.penalty_pins
        out[vertices] += weight * (size[vertices] + stable_row_norms(problem.pin_targets[soft]))
        out *= EPS
    out[np.isnan(out)] = np.inf
    out[s.pins.vertices[s.pins.exact_mask]] = 0.0
    return out


def is_gradient_roundoff(problem: StepProblem, p: Positions, factor: float = ROUNDOFF_FACTOR) -> bool:
    """Return whether the gradient at p is round-off at every free vertex.

    It is if it is at most `factor` times the bound, and the bound is finite. A sum over vertices would let the
    round-off of one part hide the gradient of another. Vertices with a penalty pin are included, because
    others depend on them.

    Args:
        problem: the step.
        p: positions (n, 3) [m].
        factor: multiple of the bound up to which a gradient counts as round-off.
    """
    bound, size = gradient_roundoff(problem, p), stable_row_norms(problem.gradient(p))
    return bool(((size <= factor * bound) & np.isfinite(bound))[problem.system.free_vertices].all())


def clip_to_roundoff(gradient: Positions, bound: FloatArray) -> Positions:
    """Return the part of a gradient that is no longer than a bound.

    The remainder exceeds round-off. An infinite bound explains no part of the gradient.

    Args:
        gradient: gradient (n, 3) [N].
        bound: largest norm of each row (n,) [N].

    Returns:
        Gradient (n, 3) [N] whose rows are shortened to the bound; zero where the bound is not finite.
    """
    size = stable_row_norms(gradient)
    share = np.divide(np.minimum(size, bound), size, out=np.zeros_like(size), where=(size > 0.0) & np.isfinite(bound))
    return share[:, None] * gradient


def stable_row_norms(x: Positions) -> FloatArray:
    """Return the norm of each row (n, 3), shape (n,), also for rows whose squares overflow."""
    return np.hypot(np.hypot(x[:, 0], x[:, 1]), x[:, 2])


class _HessianRoundingBound:
    """The rounding bound of an energy without absolute terms, estimated with its Hessian."""

    def __init__(self, energy: Energy) -> None:
        self._energy = energy

    def add_absolute_terms(self, p: Positions, out: FloatArray) -> None:
        own = np.zeros_like(p)
        self._energy.add_gradient(p, own)
        out += (abs(self._energy.hessian(p)) @ np.repeat(stable_row_norms(p), 3)).reshape(-1, 3).sum(
            axis=1
        ) + stable_row_norms(own)
