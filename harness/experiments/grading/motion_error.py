"""Error of a motion against the integrated one, by shares of time step and solver.

    total     = |p - q| / |q - p^0|       q: integrated equations of motion
    time step = |p~ - q| / |q - p^0|      p~: implicit Euler at the same time step, each step solved to round-off
    solver    = |p - p~| / |q - p^0|

Norms are Frobenius norms over the free vertices. All pins are exact in q and p~. total <= time step + solver.

Contact has no equations of motion that can be integrated. There q is the motion of converged steps, which are halved
until it no longer changes (`springbench.harness.reference.self_converged_trajectory`), and steps of p~ are solved to
1e-6. The error of q is stated with each error. Where it is larger than LARGEST_REFERENCE_ERROR, nothing is measured.
"""

from __future__ import annotations

import time
from pathlib import Path
from tempfile import TemporaryDirectory
from time import thread_time
from typing import Any, NamedTuple

import numpy as np
from springbench.harness.errors import RunFailed
from springbench.harness.experiments.grading.submission import SubmittedMotion
from springbench.harness.reference.certified_minimum import UNLIMITED_STOP_RULE
from springbench.harness.reference.reference_store import ReferenceStore
from springbench.harness.reference.reference_trajectory import ReferenceTrajectory, UnpredictableMotion
from springbench.harness.reference.self_converged_trajectory import (
    SHORTEST_REFINEMENT,
    SOLVED_STOP_RULE,
    TRIAL_SHARE,
    SelfConvergedTrajectory,
    compute_self_converged,
    has_contact,
)
from springbench.harness.reference.step_snapshot import build_exact_scene
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.scenes.scene_spec import SceneSpec
from springbench.harness.simulation.time_loop import prepare, simulate_scene
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.step_problem import Positions, Unsupported

SMALLEST_ERROR = 1e-3
"""Smallest relative error that is measured; a motion that is less predictable is measured for a shorter time."""
LARGEST_REFERENCE_ERROR = 0.1
"""Largest relative error of a reference with contact at a time at which errors are measured."""


class ErrorShares(NamedTuple):
    """Errors after a step, relative to the displacement.

    Attributes:
        step: number of the step.
        time: [s].
        total: error of the submission.
        time_step_share: error of implicit Euler itself.
        solver_share: distance from implicit Euler solved to round-off.
        reference_error: bound on the error of the reference itself.
        reference_kind: integrated, or self-converged where there is contact.
    """

    step: int
    time: float
    total: float
    time_step_share: float
    solver_share: float
    reference_error: float
    reference_kind: str


class MotionReference:
    """The integrated motion and converged implicit Euler of one scene, computed once for all submissions."""

    def __init__(self, spec: SceneSpec, size: int, seconds: float) -> None:
        """Build the scene with exact pins; nothing is simulated yet.

        Args:
            spec: scene of the submissions.
            size: mesh size.
            seconds: time limit [s] of each computation.
        """
        self._spec, self._size, self._seconds = spec, size, seconds
        self._scene = build_exact_scene(spec, size, show_warnings=False)
        self._has_contact = has_contact(self._scene.system)
        self._converged: dict[int, Positions] = {}
        self._known: dict[int, tuple[tuple[int, ...], ReferenceTrajectory | None, str]] = {}

    def measure_shares(self, submission: SubmittedMotion) -> tuple[list[ErrorShares], str]:
        """Measure the errors at some steps; a sentence states what could not be measured."""
        if submission.num_steps not in self._known:
            load = self._converge_trajectory if self._has_contact else self._integrate_trajectory
            self._known[submission.num_steps] = load(submission.num_steps)
        steps, trajectory, note = self._known[submission.num_steps]
        if trajectory is None:
            return [], note
        self._extend_converged(max(steps))
        shares, free = list[ErrorShares](), trajectory.free_vertices
        for k, step in enumerate(steps):
            if step not in self._converged:
                note = note or f"implicit Euler could not be solved in {self._seconds:g} s (--budget allows more)"
                break
            p, exact = submission.position_after(step), self._converged[step]
            away = float(np.linalg.norm((p - exact)[free])) / float(trajectory.displacement[k])
            with np.errstate(all="ignore"):
                shares.append(
                    ErrorShares(
                        step,
                        self._scene.compute_time(step),
                        trajectory.measure_error(k, p),
                        trajectory.measure_error(k, exact),
                        away,
                        trajectory.get_error_bound(k),
                        trajectory.reference_kind,
                    )
                )
        return shares, note

    def _integrate_trajectory(self, num_steps: int) -> tuple[tuple[int, ...], ReferenceTrajectory | None, str]:
        """Integrate up to a step, or to the last one that can be predicted.

        Returns the measured steps, the trajectory, and a note.
        """
        last, note, found = num_steps, "", None
        until = time.monotonic() + self._seconds
        steps: tuple[int, ...] = ()
        while last >= 1 and found is None:
            steps, times = self._choose_steps(last)
            try:
                with TemporaryDirectory() as folder:
                    found = ReferenceStore(Path(folder)).load_trajectory(
                        self._spec, self._size, times, error=SMALLEST_ERROR, report_progress=_make_deadline(until)
                    )
            except UnpredictableMotion as error:
                note, last = f"errors are measured up to a shorter time, because {error}", last // 2
            except (RunFailed, Unsupported) as error:
                note, last = f"no integrated motion to compare with: {error}", 0
        return steps, found, note

    def _converge_trajectory(self, num_steps: int) -> tuple[tuple[int, ...], ReferenceTrajectory | None, str]:
        """Halve the steps of a motion with contact until it is known.

        It is computed up to a step, or to the last one at which it is known. The result is of the form of
        `_integrate_trajectory`.
        """
        last, left, reason = num_steps, self._seconds, "--budget allows no time for it"
        while last >= 1 and left >= SHORTEST_REFINEMENT:
            steps, times = self._choose_steps(last)
            began = thread_time()
            try:
                found = compute_self_converged(
                    self._build_refined, times[0] / steps[0], times, SMALLEST_ERROR, TRIAL_SHARE * left
                )
            except (RunFailed, Unsupported) as error:
                reason = str(error)
            else:
                known = found.count_known_times(LARGEST_REFERENCE_ERROR)
                if known < len(steps):
                    reason = _describe_uncertainty(found, known)
                if known:
                    words = f"errors are measured up to {times[known - 1]:.3g} s, because {reason}"
                    return steps[:known], found, words if steps[known - 1] < num_steps else ""
            left, last = left - (thread_time() - began), last // 4
        return (), None, f"no motion with contact to compare with: {reason}"

    def _build_refined(self, time_step: float, integrator: str) -> Scene:
        """Build the scene with another time step [s] and integrator."""
        spec = self._spec.with_time_step(time_step)
        return build_exact_scene(spec, self._size, integrator, show_warnings=False)

    def _choose_steps(self, last: int) -> tuple[tuple[int, ...], list[float]]:
        """Choose the steps at which errors are measured; return them and their times [s]."""
        steps = tuple(sorted({max(1, round(last * part)) for part in (0.25, 0.5, 0.75, 1.0)}))
        return steps, [self._scene.compute_time(step) for step in steps]

    def _extend_converged(self, num_steps: int) -> None:
        """Simulate with solved steps up to a step, within the time limit."""
        if num_steps in self._converged:
            return
        until, prepared = time.monotonic() + self._seconds, prepare(self._scene, NewtonSolver())
        rule = SOLVED_STOP_RULE if self._has_contact else UNLIMITED_STOP_RULE
        self._converged.clear()
        for step in simulate_scene(self._scene, prepared, rule, initial_guess="previous", frames=num_steps):
            self._converged[step.index] = step.positions
            if time.monotonic() > until:
                break


def _describe_uncertainty(trajectory: SelfConvergedTrajectory, k: int) -> str:
    """Describe why a motion with contact is not known at times[k]."""
    why = (
        "implicit Euler and BDF2 have other limits" if trajectory.has_disagreement else "--budget allows shorter steps"
    )
    return (
        f"after {trajectory.times[k]:.3g} s steps of {trajectory.step:.2g} s resolve the motion with contact to "
        f"{100.0 * float(trajectory.disagreement[k]):.2g} % of the displacement only ({why})"
    )


def _make_deadline(until: float) -> Any:
    """Return a progress callback that ends an integration at a monotonic time [s]."""

    def check(motion: int, reached: float) -> None:
        if time.monotonic() > until:
            raise RunFailed(f"the integration takes too long; it reached {reached:.3g} s (--budget allows more)")

    return check
