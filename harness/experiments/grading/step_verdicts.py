"""Verdicts on single steps of a submission, each from the two positions before it.

    residual = |Q^-1 grad g(p)|_Q / |Q^-1 grad g(p^t)|_Q                 0 at a minimum, 1 at the step's start
    gap      = (g(p) - g(p*)) / (g(p^t) - g(p*))                         p*: certified minimum in the basin of p
    distance = max_i |p_i - p*_i| / size

g is the objective of implicit Euler whose p^t and p^(t-dt) are those of the submission, so that errors of earlier steps
do not count. The digits that a file stores limit all of them: `residual_floor` is the residual of a minimum with
positions rounded as those of the file, `gap_floor` its gap. Pins by penalty are placed where the minimum has them if
the difference is round-off of the file.

A small residual does not make a minimum: at a saddle it is zero, and where springs have collapsed to a point it is
round-off of any size. A minimum has a small gap as well. Where a file stores too few digits for a residual to show
anything, gaps are computed first; a step without a gap then does not count as a minimum.

Friction uses the normal forces at p itself, to which lagged friction converges. The iteration of
`springbench.solvers.contact.lagged_friction` leaves a residual of FRICTION_RTOL times that of friction.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from springbench.harness.execution.progress_display import append_remaining
from springbench.harness.execution.progress_events import ProgressCallback
from springbench.harness.experiments.grading.spring_terms import build_step_problem
from springbench.harness.experiments.grading.submission import SubmittedMotion
from springbench.harness.reference.certified_minimum import MinimumCertificate, refine_minimum
from springbench.harness.reference.reference_evaluator import ReferenceEvaluator
from springbench.harness.scenes.scene_builder import Scene
from springbench.solvers.contact.lagged_friction import FRICTION_RTOL, has_friction
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.step_problem import Positions, StepProblem, Unsupported

CONVERGED_RESIDUAL = 1e-6
"""Residual up to which a step is a minimum."""
CONVERGED_GAP = 1e-6
"""Energy gap up to which a step is a minimum: about the square of the residual, times the condition of the Hessian."""
FLOOR_FACTOR = 4.0
"""Factor on the residual that rounded positions have, up to which a step is a minimum; its square for the gap."""
LARGEST_FLOOR = 0.1
"""Residual of rounded positions above which a residual shows nothing."""


@dataclass(frozen=True, slots=True)
class StepVerdict:
    """Verdict on one step.

    Attributes:
        step: number of the step, from 1.
        residual: relative to the residual at the step's start.
        residual_floor: residual that the stored digits, and the iteration of friction, allow.
        gap: energy gap relative to that of the step's start; None where no minimum was computed.
        gap_floor: energy gap that the stored digits, and the iteration of friction, allow.
        distance: distance to the minimum relative to the mesh; None likewise.
        flaw: why the minimum is not certified; empty if it is.
    """

    step: int
    residual: float
    residual_floor: float
    gap: float | None = None
    distance: float | None = None
    flaw: str = ""
    gap_floor: float = 0.0

    @property
    def is_stationary(self) -> bool:
        """Whether the residual is as small as the stored digits show."""
        return self.residual <= max(CONVERGED_RESIDUAL, FLOOR_FACTOR * self.residual_floor)

    @property
    def is_doubtful(self) -> bool:
        """Whether the step is stationary only because of too few digits, without a known gap."""
        shown = self.residual <= max(CONVERGED_RESIDUAL, FLOOR_FACTOR * min(self.residual_floor, LARGEST_FLOOR))
        return self.gap is None and self.is_stationary and not shown

    @property
    def is_minimum(self) -> bool:
        """Whether the step minimises its objective as far as the stored digits show."""
        if self.gap is None:
            return self.is_stationary and not self.is_doubtful
        return self.is_stationary and self.gap <= max(CONVERGED_GAP, FLOOR_FACTOR**2 * self.gap_floor)


class StepAssessor:
    """Assesses the steps of submissions of one scene."""

    def __init__(self, scene: Scene) -> None:
        """Assemble Q, which is factorised when it is first needed."""
        self._scene, self._evaluator = scene, ReferenceEvaluator(scene.system)
        self._size = scene.mesh.bounding_box_diagonal or 1.0
        self._solver = NewtonSolver()

    def build_problem(self, submission: SubmittedMotion, step: int) -> StepProblem:
        """Build the problem of a step from the two positions before it.

        Args:
            submission: positions; those after the step provide the normal forces of friction.
            step: number of the step, from 1.
        """
        problem = build_step_problem(
            self._scene, submission.position_after(step - 1), submission.position_after(step - 2), step - 1
        )
        begun = replace(problem.step_start, normal_force_positions=submission.position_after(step))
        return replace(problem, step_start=begun)

    def assess_steps(
        self, submission: SubmittedMotion, seconds: float, report_progress: ProgressCallback = lambda line: None
    ) -> list[StepVerdict]:
        """Assess all steps, with certified minima of as many as the time allows.

        Args:
            submission: the positions.
            seconds: time limit of the minima [s].
            report_progress: called with a line for each minimum.
        """
        n = submission.num_steps
        verdicts = {step: self._assess_residual(submission, step) for step in range(1, n + 1)}
        began = time.monotonic()
        for done, step in enumerate(sorted(spread_order(n), key=lambda step: not verdicts[step].is_doubtful)):
            elapsed = time.monotonic() - began
            if elapsed > seconds:
                break
            left = min(seconds - elapsed, elapsed / done * (n - done)) if done else None
            report_progress(append_remaining(f"minimum {done + 1} of {n}", left))
            verdicts[step] = self._assess_minimum(submission, verdicts[step])
        return list(verdicts.values())

    def find_minimum(self, problem: StepProblem, p: Positions) -> MinimumCertificate | None:
        """Find the minimum whose basin contains p.

        Args:
            problem: step problem.
            p: positions (n, 3) [m].

        Returns:
            The minimum, certified or not; None where Newton's method does not support the scene.
        """
        try:
            return refine_minimum(problem, p, self._solver)
        except Unsupported:
            return None

    def _assess_residual(self, submission: SubmittedMotion, step: int) -> StepVerdict:
        problem, p = self.build_problem(submission, step), submission.position_after(step)
        with np.errstate(all="ignore"):
            start = self._measure_start(problem)
            residual = self._evaluator.compute_residual(problem, p) / start
            floor = self._measure_floor(problem, p, submission.bound_error(step)) / start
        return StepVerdict(step, float(residual), float(floor))

    def _measure_start(self, problem: StepProblem) -> float:
        """Measure the residual at the step's start, or its round-off if larger.

        The round-off is unbounded where springs have collapsed, so that at the rest shape is taken if it is smaller.
        """
        places = problem.current_positions, self._scene.mesh.rest_positions
        bound = min(self._evaluator.bound_roundoff(problem, p) for p in places)
        residual = self._evaluator.compute_residual(problem, problem.current_positions)
        return max(residual, bound if np.isfinite(bound) else 0.0, np.finfo(float).tiny)

    def _measure_floor(self, problem: StepProblem, p: Positions, error: float) -> float:
        """Measure the change of the residual by rounding errors [m] of the three positions."""
        moved = _draw_rounding(p, error)
        change = problem.gradient(p + moved[0]) - problem.gradient(p)
        change += problem.system.inertia_diagonal[:, None] * _PREVIOUS_ERRORS * moved[1]
        return self._evaluator.compute_energy_norm(change) + self._measure_friction(problem, p)

    def _measure_friction(self, problem: StepProblem, p: Positions) -> float:
        """Measure the residual [J^(1/2)] that the iteration of friction leaves at p (n, 3) [m]."""
        return sum(
            self._evaluator.compute_energy_norm(FRICTION_RTOL * gradient)
            for energy in problem.energies
            if has_friction(energy) and (gradient := energy.friction_gradient(p)) is not None
        )

    def _measure_gap_floor(self, problem: StepProblem, p: Positions, error: float) -> float:
        """Measure the gap [J] of a minimum p (n, 3) [m] that rounding and friction cause.

        Only free vertices have rounding errors [m].
        """
        first, second = _draw_rounding(p, error)
        moved = first + _PREVIOUS_ERRORS * second
        moved[problem.system.pins.vertices] = 0.0
        by_digits = problem.value(p + moved) - problem.value(p)
        by_friction = self._measure_friction(problem, p) ** 2
        return sum(max(0.0, one) for one in (by_digits, by_friction) if np.isfinite(one))

    def _assess_minimum(self, submission: SubmittedMotion, verdict: StepVerdict) -> StepVerdict:
        problem, p = self.build_problem(submission, verdict.step), submission.position_after(verdict.step)
        with np.errstate(all="ignore"):
            found = self.find_minimum(problem, p)
            if found is None:
                return verdict
            p = _snap_pins(problem, p, found.positions, 4.0 * submission.bound_error(verdict.step))
            lowest, begun = found.objective, problem.value(problem.current_positions)
            noise = 64.0 * np.finfo(float).eps * problem.value_scale(p)
            above = problem.value(p) - lowest
            scale = max(begun - lowest, noise)
            gap = 0.0 if abs(above) <= noise else above / scale
            floor = self._measure_gap_floor(problem, found.positions, submission.bound_error(verdict.step)) / scale
            distance = float(np.linalg.norm(p - found.positions, axis=1).max(initial=0.0)) / self._size
        flaw = "" if found.is_certified else found.flaw_description
        return replace(verdict, gap=float(gap), distance=distance, flaw=flaw, gap_floor=float(floor))


_PREVIOUS_ERRORS = 2.24
"""Rounding errors of p^(t-dt) and 2 p^t together, relative to that of one position: sqrt(1 + 4)."""


def _draw_rounding(p: Positions, error: float) -> Positions:
    """Draw rounding errors (2, n, 3) [m] for positions (n, 3), the same in each call.

    They are at most `error` [m].
    """
    return np.random.default_rng(0).uniform(-1.0, 1.0, (2, *p.shape)) * error


def _snap_pins(problem: StepProblem, p: Positions, there: Positions, tolerance: float) -> Positions:
    """Return p with pinned vertices placed as in `there`, where a tolerance [m] permits."""
    pinned, out = problem.system.pins.vertices, p.copy()
    near = (np.abs(p[pinned] - there[pinned]) <= tolerance).all(axis=1)
    out[pinned[near]] = there[pinned[near]]
    return out


def spread_order(count: int) -> Iterable[int]:
    """Yield 1, count, then the middles of ever smaller intervals, each number once."""
    if count < 1:
        return
    seen = {1, count}
    yield from sorted(seen)
    parts = 2
    while len(seen) < count:
        for k in range(1, parts):
            step = 1 + round(k * (count - 1) / parts)
            if step not in seen:
                seen.add(step)
                yield step
        parts *= 2
