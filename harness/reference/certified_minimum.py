"""Certified minima that solvers are compared with, by Newton's method to round-off.

At a minimum grad g = 0 and the Hessian H is positive definite. Both are checked with
`springbench.solvers.model.step_problem`, whatever method found the positions. Newton steps |H^-1 grad g| are repeated
while each is shorter than half of the one before. The point where they end is stored. There the smallest eigenvalue
must be positive beyond round-off (`springbench.harness.reference.hessian_curvature`) and one more step must be short.
The energy is not convex, so there may be several minima. The basin of a minimum is defined by Newton's method with a
line search, which only descends.

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
from springbench.harness.errors import RunFailed
from springbench.harness.reference.hessian_curvature import (
    HessianCurvature,
    build_free_hessian,
    compute_curvature,
    factorise_definite,
    step_across,
)
from springbench.harness.reference.reference_evaluator import measure_component_sizes
from springbench.harness.simulation.time_loop import apply_initial_guess
from springbench.solvers.model.rounding_bound import EPS
from springbench.solvers.model.step_problem import Positions, Solver, StepProblem, StopRule

UNLIMITED_STOP_RULE = StopRule(1000)
"""Iterate until round-off prevents any further descent: a tolerance would stop at saddles too."""
CERTIFIED_RTOL = 1e-9
"""Accuracy of a certified minimum relative to the mesh size; two minima count as one within a hundred times it."""
MAX_REFACTORISATIONS = 5


class UncertifiedError(RunFailed):
    """There is no certified minimum to compare with."""


MINIMUM, VALLEY, FLAT, SADDLE, INACCURATE = "minimum", "valley", "flat", "saddle", "rough"
"""Kinds of points where Newton's method ends: a certified minimum; one of a continuum of minima; a point where no
curvature is negative and one is zero within round-off; a saddle; a minimum less accurate than CERTIFIED_RTOL."""
WALK_FRACTION = 1e-3
"""Distance along a continuum at which its points are compared, relative to the mesh size."""
LEVEL_ROUNDOFF = 64.0
"""Factor on eps and the objective's terms within which two values are equal; for sums of up to 1e5 terms."""


@dataclass(frozen=True, slots=True, eq=False)
class MinimumCertificate:
    """End point of Newton's method, with its certificate.

    Attributes:
        positions: positions (n, 3) [m], read-only; all other attributes refer to this point.
        objective: value g [J].
        newton_step_length: length [m] of the next Newton step at the vertex where it is largest, infinite where the
            Hessian has no factor.
        min_eigenvalue: smallest eigenvalue of the Hessian without the exactly pinned vertices [N/m].
        eigenvalue_uncertainty: bound on its uncertainty [N/m].
        position_tolerance: CERTIFIED_RTOL times the size of each vertex's component (n,) [m].
        kind: one of the kinds above.
    """

    positions: Positions
    objective: float
    newton_step_length: float
    min_eigenvalue: float
    eigenvalue_uncertainty: float
    position_tolerance: NDArray[np.float64]
    kind: str

    @property
    def is_certified(self) -> bool:
        """Whether this is an isolated minimum, accurate to CERTIFIED_RTOL."""
        return self.kind == MINIMUM

    @property
    def flaw_description(self) -> str:
        """The reason why the minimum is not certified."""
        curvature = (
            f"the smallest eigenvalue is {self.min_eigenvalue:.1e} N/m, give or "
            f"take {self.eigenvalue_uncertainty:.1e} N/m"
        )
        return {
            VALLEY: f"the minima are a valley, all as low, to whose points no distance means anything: {curvature}",
            FLAT: f"the curvature along some direction is round-off: {curvature}",
            SADDLE: f"it is a saddle: {curvature}",
            INACCURATE: f"its next step is still {self.newton_step_length:.1e} m: {curvature}",
        }[self.kind]

    @property
    def minimum_id(self) -> str:
        """6 hex digits that do not change when other minima are found later."""
        return hashlib.sha256(self.positions.tobytes()).hexdigest()[:6]


@dataclass(frozen=True, slots=True, eq=False)
class KnownMinima:
    """The known minima of one problem, lowest first; `reason` states why there is none."""

    minima: tuple[MinimumCertificate, ...]
    reason: str = ""

    @property
    def lowest_minimum(self) -> MinimumCertificate:
        """The lowest known minimum; raises UncertifiedError where there is none."""
        if not self.minima:
            raise UncertifiedError(self.reason)
        return self.minima[0]

    def find_index(self, minimum: MinimumCertificate) -> int:
        """Return the index of a minimum, identified by its positions."""
        return next(i for i, known in enumerate(self.minima) if _is_same_minimum(known, minimum))

    def add_minimum(self, found: MinimumCertificate) -> KnownMinima:
        """Return the known minima with another, if it is new and certified."""
        if not found.is_certified or any(_is_same_minimum(known, found) for known in self.minima):
            return self
        return KnownMinima(tuple(sorted((*self.minima, found), key=lambda minimum: minimum.objective)))


def find_minima(problem: StepProblem, solver: Solver) -> KnownMinima:
    """Find the minima that Newton's method reaches from current positions and inertial target.

    Args:
        problem: step problem, whose initial guess is not used.
        solver: Newton's method.

    Returns:
        The certified minima, lowest first, or the reason why there is none.
    """
    guesses = (apply_initial_guess(problem, name).initial_guess for name in ("previous", "inertial"))
    return collect_minima(refine_minimum(problem, guess, solver) for guess in guesses)


def collect_minima(found: Iterable[MinimumCertificate]) -> KnownMinima:
    """Collect the certified minima; where there is none, the reason."""
    known, reason = KnownMinima(()), ""
    for one in found:
        known = known.add_minimum(one)
        reason = (
            reason if one.is_certified else f"no certified minimum: Newton's method ends where {one.flaw_description}"
        )
    return known if known.minima else KnownMinima((), reason)


def refine_minimum(problem: StepProblem, p: Positions, solver: Solver) -> MinimumCertificate:
    """Find and certify the minimum of the basin of p.

    Args:
        problem: step problem.
        p: positions (n, 3) [m].
        solver: Newton's method.
    """
    solution = solver.prepare(problem.system).solve(replace(problem, initial_guess=p), UNLIMITED_STOP_RULE)
    return certify_minimum(problem, solution.positions)


def certify_minimum(problem: StepProblem, p: Positions) -> MinimumCertificate:
    """Refine positions near a minimum by Newton steps, and certify the minimum.

    The steps continue to round-off. The certificate contains the curvature, the objective and the length of one more
    step at the final point.

    Args:
        problem: step problem, whose exact pins are placed at their targets.
        p: positions near a minimum (n, 3) [m], which remain unchanged.
    """
    p = _place_pins(problem, p)
    near = CERTIFIED_RTOL * measure_component_sizes(problem.system, p)
    found = compute_curvature(problem, p)
    if found.is_convex:
        _refine_by_newton(problem, p, near)
        found = compute_curvature(problem, p)
    step = _newton_step(problem, p)
    p.flags.writeable = False
    length = np.inf if step is None else float(np.linalg.norm(step, axis=1).max(initial=0.0))
    known = step is not None and bool((np.linalg.norm(step, axis=1) <= near[problem.system.free_vertices]).all())
    kind = MINIMUM if found.is_convex and known else SADDLE if found.is_saddle else INACCURATE
    if found.is_degenerate:
        kind = VALLEY if _is_continuum(problem, p, found, near) else FLAT
    return MinimumCertificate(
        p, problem.value(p), length, found.min_eigenvalue, found.eigenvalue_uncertainty, near, kind
    )


def _refine_by_newton(problem: StepProblem, p: Positions, near: NDArray[np.float64]) -> None:
    """Apply Newton steps to p in place while each halves the previous length."""
    free = problem.system.free_vertices
    for _ in range(MAX_REFACTORISATIONS):
        solve = factorise_definite(build_free_hessian(problem, p))
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


def _newton_step(problem: StepProblem, p: Positions) -> Positions | None:
    """Compute Newton's step (f, 3) [m] at p; None where the Hessian has no factor."""
    free = problem.system.free_vertices
    solve = factorise_definite(build_free_hessian(problem, p)) if len(free) else np.copy
    return solve(problem.gradient(p)[free].ravel()).reshape(-1, 3) if solve else None


def _is_continuum(problem: StepProblem, p: Positions, found: HessianCurvature, near: NDArray[np.float64]) -> bool:
    """Return whether the minima form a continuum.

    The objective is compared on both sides of p along the degenerate direction.
    """
    lowest, noise = problem.value(p), LEVEL_ROUNDOFF * EPS * problem.value_scale(p)
    for offset in (WALK_FRACTION, -WALK_FRACTION):
        q = p + offset / CERTIFIED_RTOL * float(near.max()) * found.direction / np.abs(found.direction).max()
        for _ in range(MAX_REFACTORISATIONS):
            here = compute_curvature(problem, q)
            if here.is_saddle or not np.isfinite(here.min_eigenvalue):
                return False
            q = step_across(problem, q, here, max_fraction=WALK_FRACTION)
        if not abs(problem.value(q) - lowest) <= noise:
            return False
    return True


def _place_pins(problem: StepProblem, p: Positions) -> Positions:
    """Return a copy of p with the exactly pinned vertices at their targets."""
    pins, placed = problem.system.pins, p.copy()
    placed[pins.vertices[pins.exact_mask]] = problem.pin_targets[pins.exact_mask]
    return placed


def _is_same_minimum(one: MinimumCertificate, other: MinimumCertificate) -> bool:
    apart = np.linalg.norm(one.positions - other.positions, axis=1)
    return bool((apart <= 100.0 * one.position_tolerance).all())
