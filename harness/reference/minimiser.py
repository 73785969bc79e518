"""The minimum that solvers are graded against: Newton's method to round-off, and a certificate.

At a minimum grad g = 0 and the Hessian H is positive definite. Both are checked by the oracle, `solvers.problem`,
whoever found the positions: steps |H^-1 grad g| go on for as long as each is shorter than half of the one before, and
at the point where they end, which is the one that is stored, the smallest eigenvalue is positive beyond round-off
(`harness.reference.curvature`) and one more step is short. The energy is not convex: there may be several minima. A
basin is what Newton's method with a line search, which only descends, makes it.

Where the curvature cannot be told from zero along some direction, and points that way are as low, the minima are a
valley: a circle, for a chain that may buckle to any side. No distance to one of its points means anything, so that it
is no reference and says why.
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
"""Until round-off lets nothing descend any more: a tolerance would stop at saddles too."""
NEAR = 1e-9
"""Of the shape's size: a certified minimum is known to this, and two that lie within a hundred times of it are one."""
REFACTORISATIONS = 5


class Uncertified(RunFailed):
    """There is no certified minimum to grade against."""


MINIMUM, VALLEY, FLAT, SADDLE, ROUGH = "minimum", "valley", "flat", "saddle", "rough"
"""Kinds of points where Newton's method ends: a certified minimum; one of a continuum of minima; where no curvature is
negative and one cannot be told from zero; a saddle; a minimum that is not known to `NEAR`."""
WALK = 1e-3
"""Of the shape's size: how far along a valley its points are compared."""
LEVEL = 64.0
"""Times eps and the objective's terms: what two values may differ by and be one; sums of up to 1e5 terms."""


@dataclass(frozen=True, slots=True, eq=False)
class Minimum:
    """Where Newton's method ended. positions (n, 3) [m], read-only; all else is of this very point: g [J]; error: the
    length of Newton's next step, at the vertex where it is largest [m], infinite where the Hessian has no factor;
    smallest_eigenvalue: of the Hessian without the exactly pinned vertices [N/m], and its doubt [N/m]; near (n,) [m]:
    what `NEAR` is at each vertex, of the size of its component; kind: see above."""

    positions: Positions
    g: float
    error: float
    smallest_eigenvalue: float
    doubt: float
    near: NDArray[np.float64]
    kind: str

    @property
    def certified(self) -> bool:
        """Whether this is a minimum, known to `NEAR`, and no other is next to it."""
        return self.kind == MINIMUM

    @property
    def flaw(self) -> str:
        """What is wrong with a minimum that is not certified."""
        curvature = f"the smallest eigenvalue is {self.smallest_eigenvalue:.1e} N/m, give or take {self.doubt:.1e} N/m"
        return {
            VALLEY: f"the minima are a valley, all as low, to whose points no distance means anything: {curvature}",
            FLAT: f"the curvature along some direction is round-off: {curvature}",
            SADDLE: f"it is a saddle: {curvature}",
            ROUGH: f"its next step is still {self.error:.1e} m: {curvature}",
        }[self.kind]

    @property
    def name(self) -> str:
        """6 hex digits that stay, whatever minima are found later."""
        return hashlib.sha256(self.positions.tobytes()).hexdigest()[:6]


@dataclass(frozen=True, slots=True, eq=False)
class KnownMinima:
    """The minima known of one problem, the lowest first: an index is a branch. reason: why there is none."""

    minima: tuple[Minimum, ...]
    reason: str = ""

    @property
    def best(self) -> Minimum:
        """The lowest minimum known; raises Uncertified where there is none."""
        if not self.minima:
            raise Uncertified(self.reason)
        return self.minima[0]

    def branch(self, minimum: Minimum) -> int:
        """The index of a minimum, by where it lies."""
        return next(i for i, known in enumerate(self.minima) if _same(known, minimum))

    def joined(self, found: Minimum) -> KnownMinima:
        """With one more minimum; the same reference where it is known already, or is not certified."""
        if not found.certified or any(_same(known, found) for known in self.minima):
            return self
        return KnownMinima(tuple(sorted((*self.minima, found), key=lambda minimum: minimum.g)))


def find_minima(problem: StepProblem, solver: Solver) -> KnownMinima:
    """The minima to which Newton's method leads from the current positions and from the inertial target."""
    guesses = (guessed(problem, name).first_guess for name in ("current", "inertial"))
    return reference(polish(problem, guess, solver) for guess in guesses)


def reference(found: Iterable[Minimum]) -> KnownMinima:
    """The certified ones among what was found; where there is none, the reason."""
    known, reason = KnownMinima(()), ""
    for one in found:
        known = known.joined(one)
        reason = reason if one.certified else f"no certified minimum: Newton's method ends where {one.flaw}"
    return known if known.minima else KnownMinima((), reason)


def polish(problem: StepProblem, p: Positions, solver: Solver) -> Minimum:
    """Newton's method from p (n, 3) [m] down to the minimum of its basin, which is certified."""
    solution = solver.prepare(problem.system).solve(replace(problem, first_guess=p), TO_THE_END)
    return certify(problem, solution.positions)


def certify(problem: StepProblem, p: Positions) -> Minimum:
    """Newton steps from p (n, 3) [m], close to a minimum, to where round-off ends them. Then, there: the curvature, the
    value, and the length of one more step."""
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
    """Newton steps on p itself, for as long as each is shorter than half of the one before."""
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
    """Newton's step (f, 3) [m] at p; None where the Hessian has no factor."""
    free = problem.system.free
    solve = definite(free_hessian(problem, p)) if len(free) else np.copy
    return solve(problem.gradient(p)[free].ravel()).reshape(-1, 3) if solve else None


def _level(problem: StepProblem, p: Positions, found: Curvature, near: NDArray[np.float64]) -> bool:
    """Whether points are as low as p where the flat direction leads, both ways: the minima are a continuum."""
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
    """A copy of p with the exactly pinned vertices on their targets."""
    pins, placed = problem.system.pins, p.copy()
    placed[pins.vertices[pins.exact]] = problem.pin_targets[pins.exact]
    return placed


def _same(one: Minimum, other: Minimum) -> bool:
    apart = np.linalg.norm(one.positions - other.positions, axis=1)
    return bool((apart <= 100.0 * one.near).all())
