"""How much of a gradient may be round-off, vertex by vertex: a running bound.

    delta_i = eps * (the absolute values of all that is added up at vertex i)

    inertia  h (|p| + |target|)        force  |f|        pins  w (|p| + |pin|)
    springs  k (max(1, r/l - 1) (|p_i| + |p_j|) + l + r)   at both ends

A spring's share has the rounding of the positions themselves, which its Hessian multiplies (1 along the spring,
|1 - r/l| across), and that of its own length. Other energies state their absolute terms in the same way (`Rounded`);
for one that does not, the rounding of the positions is multiplied by its Hessian, and its gradient is off by its own
last digit (Higham 2002, Accuracy and Stability of Numerical Algorithms, section 3.3: running error analysis).

What is added up elsewhere has no part in it: a stiff or a far-away component leaves the bound at all others as it was,
and a limit that is not reached, however stiff, adds nothing.
"""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from solvers.problem import Energy, Positions, StepProblem, StopRule

EPS = float(np.finfo(np.float64).eps)

FACTOR = StopRule().floor
"""Of the bound, up to which a gradient is round-off: 8. Where solvers are left to go on for ever, it ends at .1 to .9
of the bound at the worst vertex of most hard scenes, at 2 in the worst; what has not converged is at a hundred or
more."""

Terms = NDArray[np.float64]


@runtime_checkable
class Rounded(Energy, Protocol):
    """An energy that knows the absolute terms of its gradient."""

    def add_absolute_terms(self, p: Positions, out: Terms) -> None:
        """Add the absolute terms [N] of the gradient at p (n, 3) [m] to `out` (n,): eps times them bounds its rounding
        error at each vertex, that of the positions included."""
        ...


def gradient_round_off(problem: StepProblem, p: Positions) -> Terms:
    """The bound delta (n,) [N] on the round-off in `problem.gradient(p)` at each vertex, p (n, 3) [m]; zero at exactly
    pinned vertices. Infinite where a term overflows."""
    s, size = problem.system, lengths(p)
    with np.errstate(over="ignore", invalid="ignore"):
        out = s.inertia * (size + lengths(problem.target)) + lengths(problem.force)
        for energy in problem.energies:
            (energy if isinstance(energy, Rounded) else _Unstated(energy)).add_absolute_terms(p, out)
        soft, vertices, weight = s.penalty
        out[vertices] += weight * (size[vertices] + lengths(problem.pin_targets[soft]))
        out *= EPS
    out[np.isnan(out)] = np.inf
    out[s.pins.vertices[s.pins.exact]] = 0.0
    return out


def at_rest(problem: StepProblem, p: Positions, factor: float = FACTOR) -> bool:
    """Whether the gradient at p (n, 3) [m] is round-off at every free vertex: at most `factor` times the bound, where
    that is finite. A sum over vertices would let one part's round-off hide another's gradient, and a vertex that a
    penalty holds is one that others hang on."""
    bound, size = gradient_round_off(problem, p), lengths(problem.gradient(p))
    return bool(((size <= factor * bound) & np.isfinite(bound))[problem.system.free].all())


def within(gradient: Positions, bound: Terms) -> Positions:
    """The part of a gradient (n, 3) [N] that is no longer than the bound (n,) [N]; the rest of it is beyond doubt.

    A bound that is infinite explains nothing.
    """
    size = lengths(gradient)
    share = np.divide(np.minimum(size, bound), size, out=np.zeros_like(size), where=(size > 0.0) & np.isfinite(bound))
    return share[:, None] * gradient


def lengths(x: Positions) -> Terms:
    """|x| of each row (n, 3), (n,), of rows whose squares may overflow."""
    return np.hypot(np.hypot(x[:, 0], x[:, 1]), x[:, 2])


class _Unstated:
    """An energy that does not state its terms: its Hessian tells what the rounding of the positions does."""

    def __init__(self, energy: Energy) -> None:
        self._energy = energy

    def add_absolute_terms(self, p: Positions, out: Terms) -> None:
        own = np.zeros_like(p)
        self._energy.add_gradient(p, own)
        out += (abs(self._energy.hessian(p)) @ np.repeat(lengths(p), 3)).reshape(-1, 3).sum(axis=1) + lengths(own)
