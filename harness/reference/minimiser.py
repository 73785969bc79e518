"""Certified minima that solvers are compared with, by Newton's method to round-off.

At a minimum grad g = 0 and the Hessian H is positive definite. Both are checked with `solvers.problem`,
whatever method found the positions. Newton steps |H^-1 grad g| are repeated while each is shorter than half of the one
before. The point where they end is stored. There the smallest eigenvalue must be positive beyond round-off
(`harness.reference.curvature`) and one more step must be short. The energy is not convex, so there may be
several minima. The basin of a minimum is defined by Newton's method with a line search, which only descends.

Where the curvature along some direction is zero within round-off, and points in that direction have the same energy,
the minima form a continuum: for example a circle, for a chain that may buckle to any side. The distance to one of its
points is meaningless, so such a point is not used as a reference, and the reason is reported.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from harness.base.errors import RunFailed
from harness.reference.curvature import Curvature, across, curvature, definite, free_hessian
from harness.reference.oracle import sizes
from harness.simulation.step import guessed
from solvers.problem import Positions, Solver, StepProblem, StopRule
from solvers.round_off import EPS

TO_THE_END = StopRule(1000)
"""Iterate until round-off prevents any further descent: a tolerance would stop at saddles too."""
NEAR = 1e-9
"""Accuracy of a certified minimum relative to the mesh size; two within a hundred times this distance are one."""
REFACTORISATIONS = 5


class Uncertified(RunFailed):
    """There is no certified minimum to compare with."""


MINIMUM, VALLEY, FLAT, SADDLE, ROUGH = "minimum", "valley", "flat", "saddle", "rough"
"""Kinds of points where Newton's method ends: a certified minimum; one of a continuum of minima; a point where no
curvature is negative and one is zero within round-off; a saddle; a minimum less accurate than NEAR."""
WALK = 1e-3
"""Distance along a continuum at which its points are compared, relative to the mesh size."""
LEVEL = 64.0
"""Factor on eps and the objective's terms within which two values are equal; for sums of up to 1e5 terms."""


@dataclass(frozen=True, slots=True, eq=False)
class Minimum:
    """End point of Newton's method, with its certificate.

    Attributes:
      positions: positions (n, 3) [m], read-only; all other attributes refer to this point.
      g: value g [J].
      error: length [m] of the next Newton step at the vertex where it is largest, infinite where the
        Hessian has no factor.
      smallest_eigenvalue: smallest eigenvalue of the Hessian without the exactly pinned vertices [N/m].
      doubt: bound on its uncertainty [N/m].
      near: NEAR times the size of each vertex's component (n,) [m].
      kind: one of the kinds above.
    """

    positions: Positions
    g: float
    error: float
    smallest_eigenvalue: float
    doubt: float
    near: NDArray[np.float64]
    kind: str

    @property
    def certified(self) -> bool:
        """Whether this is an isolated minimum, accurate to NEAR."""
        return self.kind == MINIMUM

    @property
    def flaw(self) -> str:
        """The reason why the minimum is not certified."""
        curvature = f"the smallest eigenvalue is {self.smallest_eigenvalue:.1e} N/m, give or take {self.doubt:.1e} N/m"
        return {
            VALLEY: f"the minima are a valley, all as low, to whose points no distance means anything: {curvature}",
            FLAT: f"the curvature along some direction is round-off: {curvature}",
            SADDLE: f"it is a saddle: {curvature}",
            ROUGH: f"its next step is still {self.error:.1e} m: {curvature}",
        }[self.kind]

    @property
    def name(self) -> str:
        """6 hex digits that do not change when other minima are found later."""
        return hashlib.sha256(self.positions.tobytes()).hexdigest()[:6]


@dataclass(frozen=True, slots=True, eq=False)
class KnownMinima:
    """The known minima of one problem, lowest first; `reason` states why there is none."""

    minima: tuple[Minimum, ...]
    reason: str = ""

    @property
    def best(self) -> Minimum:
        """The lowest known minimum; raises Uncertified where there is none."""
        if not self.minima:
            raise Uncertified(self.reason)
        return self.minima[0]

    def branch(self, minimum: Minimum) -> int:
        """Return the index of a minimum, identified by its positions."""
        return next(i for i, known in enumerate(self.minima) if _same(known, minimum))

    def joined(self, found: Minimum) -> KnownMinima:
        """Return the known minima with another, if it is new and certified."""
        if not found.certified or any(_same(known, found) for known in self.minima):
            return self
        return KnownMinima(tuple(sorted((*self.minima, found), key=lambda minimum: minimum.g)))


def find_minima(problem: StepProblem, solver: Solver) -> KnownMinima:
    """Find the minima that Newton's method reaches from current positions and inertial target."""
    guesses = (guessed(problem, name).first_guess for name in ("current", "inertial"))
    return reference(polish(problem, guess, solver) for guess in guesses)


def reference(found: Iterable[Minimum]) -> KnownMinima:
    """Collect the certified minima; where there is none, the reason."""
    known, reason = KnownMinima(()), ""
    for one in found:
        known = known.joined(one)
        reason = reason if one.certified else f"no certified minimum: Newton's method ends where {one.flaw}"
    return known if known.minima else KnownMinima((), reason)


def polish(problem: StepProblem, p: Positions, solver: Solver) -> Minimum:
    """Find and certify the minimum of the basin of p.

    Args:
      problem: step problem.
      p: positions (n, 3) [m].
      solver: Newton's method.
    """
    solution = solver.prepare(problem.system).solve(replace(problem, first_guess=p), TO_THE_END)
    return certify(problem, solution.positions)


def certify(problem: StepProblem, p: Positions) -> Minimum:
    """Refine p (n, 3) [m], near a minimum, by Newton steps, and certify it.

    The steps continue to round-off. The certificate contains the curvature, the objective and the length of one more
    step at the final point.
    """
    p = _pinned(problem, p)
    near = NEAR * sizes(problem.system, p)
    found = curvature(problem, p)
    if found.convex:
        _descend(problem, p, near)
        found = curvature(problem, p)
    step = _step(problem, p)
    p.flags.writeable = False
    length = np.inf if step is None else float(np.linalg.norm(step, axis=1).max(initial=0.0))
    known = step is not None and bool((np.linalg.norm(step, axis=1) <= near[problem.system.free]).all())
    kind = MINIMUM if found.convex and known else SADDLE if found.falls else ROUGH
    if found.flat:
        kind = VALLEY if _level(problem, p, found, near) else FLAT
    return Minimum(p, problem.value(p), length, found.smallest, found.doubt, near, kind)


def _descend(problem: StepProblem, p: Positions, near: NDArray[np.float64]) -> None:
    """Apply Newton steps to p in place while each halves the previous length."""
    free = problem.system.free
    for _ in range(REFACTORISATIONS):
        solve = definite(free_hessian(problem, p))
        if solve is None:
            return
        begun, error = p.copy(), np.inf
        while True:
            step = solve(problem.gradient(p)[free].ravel()).reshape(-1, 3)
            length = float(np.linalg.norm(step, axis=1).max(initial=0.0))
            if not length < 0.5 * error:  # round-off, or too far away for this Hessian
                break
            error = length
            p[free] -= step
        if (np.linalg.norm(p - begun, axis=1) <= near).all():
            return


def _step(problem: StepProblem, p: Positions) -> Positions | None:
    """Compute Newton's step (f, 3) [m] at p; None where the Hessian has no factor."""
    free = problem.system.free
    solve = definite(free_hessian(problem, p)) if len(free) else np.copy
    return solve(problem.gradient(p)[free].ravel()).reshape(-1, 3) if solve else None


def _level(problem: StepProblem, p: Positions, found: Curvature, near: NDArray[np.float64]) -> bool:
    """Return whether the minima form a continuum.

    The objective is compared on both sides of p along the degenerate direction.
    """
    lowest, noise = problem.value(p), LEVEL * EPS * problem.magnitude(p)
    for way in (WALK, -WALK):
        q = p + way / NEAR * float(near.max()) * found.direction / np.abs(found.direction).max()
        for _ in range(REFACTORISATIONS):
            here = curvature(problem, q)
            if here.falls or not np.isfinite(here.smallest):
                return False
            q = across(problem, q, here, most=WALK)
        if not abs(problem.value(q) - lowest) <= noise:
            return False
    return True


def _pinned(problem: StepProblem, p: Positions) -> Positions:
    """Return a copy of p with the exactly pinned vertices at their targets."""
    pins, placed = problem.system.pins, p.copy()
    placed[pins.vertices[pins.exact]] = problem.pin_targets[pins.exact]
    return placed


def _same(one: Minimum, other: Minimum) -> bool:
    apart = np.linalg.norm(one.positions - other.positions, axis=1)
    return bool((apart <= 100.0 * one.near).all())
