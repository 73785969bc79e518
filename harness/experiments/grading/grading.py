"""Grade positions of others: steps, motion, physical quantities and fingerprints, and one verdict in words."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from springbench.harness.errors import InputError
from springbench.harness.execution.progress_events import ProgressCallback
from springbench.harness.experiments.grading.fingerprints import FingerprintFinder, ProgramFingerprint
from springbench.harness.experiments.grading.motion_error import ErrorShares, MotionReference
from springbench.harness.experiments.grading.motion_quantities import MotionQuantities, measure_motion
from springbench.harness.experiments.grading.position_files import (
    DEFAULT_ARRAY,
    read_position_file,
    read_rest_positions,
)
from springbench.harness.experiments.grading.spring_terms import build_graded_scene, collect_spring_terms
from springbench.harness.experiments.grading.step_verdicts import StepAssessor, StepVerdict
from springbench.harness.experiments.grading.submission import SubmittedMotion, align_submission
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.scenes.scene_spec import SceneSpec
from springbench.solvers.model.step_problem import Positions, StepProblem

CORRECT, UNCONVERGED, MISTAKEN, UNEXPLAINED = "correct", "not converged", "mistake", "unexplained"
"""Kinds of verdicts."""
LOOSE_RESIDUAL = 1e-2
"""Median residual up to which steps that no known program explains count as not converged, else as unexplained."""


@dataclass(frozen=True, slots=True)
class GradeRequest:
    """Scene and settings that submissions are graded against.

    Attributes:
        spec: the scene.
        size: mesh size.
        required_iterations: iterations of a step that are required; None for convergence.
        first_frame: number of the first stored frame, 0 or 1; None to detect the start.
        rest: file of rest positions in the order of the submission; None for none.
        array: name of the array in .npz files.
        seconds: time limit [s] of the minima, and of the integrated motion.
    """

    spec: SceneSpec
    size: int
    required_iterations: int | None = None
    first_frame: int | None = None
    rest: Path | None = None
    array: str = DEFAULT_ARRAY
    seconds: float = 30.0


@dataclass(frozen=True, slots=True, eq=False)
class PositionGrade:
    """The grade of one submission.

    Attributes:
        submission: the positions.
        steps: verdicts on the steps.
        quantities: energy, momentum, strain and intersections.
        shares: errors against the integrated motion.
        shares_note: why errors are missing; empty if none are.
        fingerprint: the closest programs; None for scenes with other terms.
        fingerprint_note: why there is no fingerprint; empty if there is one.
        kind: kind of the verdict, such as CORRECT.
        verdict: the verdict in words.
    """

    submission: SubmittedMotion
    steps: list[StepVerdict]
    quantities: MotionQuantities
    shares: list[ErrorShares]
    shares_note: str
    fingerprint: ProgramFingerprint | None
    fingerprint_note: str
    kind: str
    verdict: str

    @property
    def median_residual(self) -> float:
        """Median of the steps' residuals."""
        return float(np.median([one.residual for one in self.steps]))

    @property
    def max_residual(self) -> float:
        """Largest residual of a step."""
        return float(np.max([one.residual for one in self.steps]))

    @property
    def max_gap(self) -> float | None:
        """Largest energy gap of the steps whose minimum was computed."""
        return max((one.gap for one in self.steps if one.gap is not None), default=None)

    @property
    def median_gap(self) -> float | None:
        """Median energy gap of the steps whose minimum was computed."""
        gaps = [one.gap for one in self.steps if one.gap is not None]
        return float(np.median(gaps)) if gaps else None

    @property
    def num_minima(self) -> int:
        """Number of steps that minimise their objective."""
        return sum(one.is_minimum for one in self.steps)


@dataclass(eq=False)
class SceneGrader:
    """Grades submissions of one scene; references are computed once.

    Attributes:
        request: scene and settings that submissions are graded against.
        scene: the scene, built.
    """

    request: GradeRequest
    scene: Scene = field(init=False)

    def __post_init__(self) -> None:
        """Build the scene; raises InputError."""
        request = self.request
        self.scene = build_graded_scene(request.spec, request.size)
        self._assessor = StepAssessor(self.scene)
        self._reference = MotionReference(request.spec, request.size, request.seconds)
        n = len(self.scene.mesh.rest_positions)
        self._rest = read_rest_positions(request.rest, n) if request.rest else None
        self._finder, self._finder_note = None, ""
        try:
            terms = collect_spring_terms(self.scene)
            self._finder = FingerprintFinder(self.scene, terms, request.required_iterations)
        except InputError as error:
            self._finder_note = f"mistakes cannot be found: {error.mistakes[0].problem.partition('; leave out')[0]}"

    def grade_file(self, path: Path, report_progress: ProgressCallback = lambda line: None) -> PositionGrade:
        """Read and grade a submission.

        Args:
            path: file of positions, or folder of mesh files.
            report_progress: called with a line about what is computed.

        Raises:
            InputError: the positions cannot be read, or are not those of the scene.
        """
        read = read_position_file(path, len(self.scene.mesh.rest_positions), self.request.array)
        submission = align_submission(self.scene, read, self.request.first_frame, self._rest)
        return self.grade_submission(submission, report_progress)

    def grade_submission(
        self, submission: SubmittedMotion, report_progress: ProgressCallback = lambda line: None
    ) -> PositionGrade:
        """Grade a submission.

        Args:
            submission: positions in the scene's order of vertices, with at least one step.
            report_progress: called with a line about what is computed.

        Raises:
            InputError: the submission has no steps.
        """
        if not submission.num_steps:
            raise InputError(f"{submission.source}: has only the start; expected the positions after some steps")
        begun = time.monotonic()
        report_progress("comparing the steps with those of known programs")
        fingerprint = self.find_fingerprint(submission)
        left = max(1.0, self.request.seconds - (time.monotonic() - begun))
        steps = self._assessor.assess_steps(submission, left, report_progress)
        report_progress(f"integrating the motion, at most {self.request.seconds:g} s")
        shares, note = self._reference.measure_shares(submission)
        kind, verdict = self._decide(fingerprint, steps)
        quantities = measure_motion(self.scene, submission)
        return PositionGrade(submission, steps, quantities, shares, note, fingerprint, self._finder_note, kind, verdict)

    def find_fingerprint(self, submission: SubmittedMotion) -> ProgramFingerprint | None:
        """Find the closest programs.

        The result is None for scenes with other terms than springs, masses, forces and pins.
        """
        return self._finder.find_fingerprint(submission, self._find_minimum) if self._finder else None

    def _find_minimum(self, problem: StepProblem, p: Positions) -> Positions | None:
        found = self._assessor.find_minimum(problem, p)
        return found.positions if found else None

    def _decide(self, fingerprint: ProgramFingerprint | None, steps: list[StepVerdict]) -> tuple[str, str]:
        """Return the kind of the verdict and its sentence."""
        residual = float(np.median([one.residual for one in steps]))
        minima = sum(one.is_minimum for one in steps)
        reached = f"{minima} of {len(steps)} steps minimise their objective, the median residual is {residual:.1e}"
        if fingerprint and (mistake := fingerprint.mistake):
            equivalents = f"; so would: {', '.join(fingerprint.alike)}" if fingerprint.alike else ""
            words = f"{mistake.name}. The program {mistake.description}; this explains {format_fit(mistake.fit)} of the"
            return MISTAKEN, f"{words} deviation{equivalents}. See: {mistake.remedy}."
        converged = all(one.is_minimum for one in steps)
        if fingerprint and not fingerprint.is_correct:
            words = f"no correct program and no known mistake predicts the steps; {reached}"
            if residual <= LOOSE_RESIDUAL:
                return UNCONVERGED, f"a solver that stops early; {reached}."
            best = fingerprint.closest[0]
            near = f"closest is `{best.name}`, which explains {format_fit(best.fit)} of the deviation"
            return UNEXPLAINED, f"{words}; {near}."
        required = self.request.required_iterations
        if fingerprint and (required or converged):
            return CORRECT, f"the steps are those of {fingerprint.correct_program}; {reached}."
        if converged:
            return CORRECT, f"{reached}."
        words = f"the steps are those of {fingerprint.correct_program}; " if fingerprint else ""
        if residual <= LOOSE_RESIDUAL:
            return UNCONVERGED, f"{words}{reached}."
        return (UNCONVERGED if fingerprint else UNEXPLAINED), f"{words}{reached}."


def format_fit(fit: float) -> str:
    """Format a fraction in percent, with up to four decimals and at most 99.9999 %."""
    return f"{min(100.0 * fit, 99.9999):.4f}".rstrip("0").rstrip(".") + " %"
