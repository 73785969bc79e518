"""Error of a motion against the integrated one, split into the share of the time step and that of the solver.

    total     = |p - q| / |q - p^0|       q: integrated equations of motion
    time step = |p~ - q| / |q - p^0|      p~: implicit Euler at the same time step, each step solved to round-off
    solver    = |p - p~| / |q - p^0|

Norms are Frobenius norms over the free vertices. All pins are exact in q and p~. total <= time step + solver.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from springbench.harness.errors import RunFailed
from springbench.harness.experiments.grading.submission import SubmittedMotion
from springbench.harness.reference.certified_minimum import UNLIMITED_STOP_RULE
from springbench.harness.reference.reference_store import ReferenceStore
from springbench.harness.reference.reference_trajectory import UnpredictableMotion
from springbench.harness.reference.self_converged_trajectory import has_contact
from springbench.harness.reference.step_snapshot import build_exact_scene
from springbench.harness.scenes.scene_spec import SceneSpec
from springbench.harness.simulation.time_loop import prepare, simulate_scene
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.step_problem import Positions, Unsupported

SMALLEST_ERROR = 1e-3
"""Smallest relative error that is measured; a motion that is less predictable is measured for a shorter time."""


class ErrorShares(NamedTuple):
    """Errors after a step, relative to the displacement.

    Attributes:
      step: number of the step.
      time: [s].
      total: error of the submission.
      time_step_share: error of implicit Euler itself.
      solver_share: distance from implicit Euler solved to round-off.
    """

    step: int
    time: float
    total: float
    time_step_share: float
    solver_share: float


class MotionReference:
    """The integrated motion and converged implicit Euler of one scene, computed once for all submissions."""

    def __init__(self, spec: SceneSpec, size: int, seconds: float) -> None:
        """Set the scene, and the time limit [s] of each computation."""
        self._spec, self._size, self._seconds = spec, size, seconds
        self._scene = build_exact_scene(spec, size, show_warnings=False)
        self._converged: dict[int, Positions] = {}
        self._known: dict[int, tuple[tuple[int, ...], Any, str]] = {}

    def measure_shares(self, submission: SubmittedMotion) -> tuple[list[ErrorShares], str]:
        """Measure the errors at some steps, and return a sentence on what could not be measured."""
        if has_contact(self._scene.system):
            return [], "no integrated motion to compare with: the scene has contact"
        steps, trajectory, note = self._load_trajectory(submission.num_steps)
        if trajectory is None:
            return [], note
        self._extend_converged(max(steps))
        shares, free = list[ErrorShares](), trajectory.free_vertices
        for k, step in enumerate(steps):
            if step not in self._converged:
                note = note or f"implicit Euler could not be solved to round-off in {self._seconds:g} s"
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
                    )
                )
        return shares, note

    def _load_trajectory(self, num_steps: int) -> tuple[Sequence[int], Any, str]:
        """Integrate up to a step, or to the last one that can be predicted, and return the steps measured."""
        if num_steps in self._known:
            return self._known[num_steps]
        last, note, found = num_steps, "", None
        until = time.monotonic() + self._seconds
        steps: tuple[int, ...] = ()
        while last >= 1 and found is None:
            steps = tuple(sorted({max(1, round(last * part)) for part in (0.25, 0.5, 0.75, 1.0)}))
            times = [self._scene.compute_time(step) for step in steps]
            try:
                with TemporaryDirectory() as folder:
                    found = ReferenceStore(Path(folder)).load_trajectory(
                        self._spec, self._size, times, error=SMALLEST_ERROR, report_progress=_make_deadline(until)
                    )
            except UnpredictableMotion as error:
                note, last = f"errors are measured up to a shorter time, because {error}", last // 2
            except (RunFailed, Unsupported) as error:
                note, last = f"no integrated motion to compare with: {error}", 0
        self._known[num_steps] = steps, found, note
        return self._known[num_steps]

    def _extend_converged(self, num_steps: int) -> None:
        """Simulate with steps solved to round-off up to a step, within the time limit."""
        if num_steps in self._converged:
            return
        until, solver = time.monotonic() + self._seconds, NewtonSolver()
        self._converged.clear()
        for step in simulate_scene(
            self._scene, prepare(self._scene, solver), UNLIMITED_STOP_RULE, initial_guess="previous", frames=num_steps
        ):
            self._converged[step.index] = step.positions
            if time.monotonic() > until:
                break


def _make_deadline(until: float) -> Any:
    """Return a progress callback that ends an integration at a time of the monotonic clock [s]."""

    def check(motion: int, reached: float) -> None:
        if time.monotonic() > until:
            raise RunFailed(f"the integration takes too long; it came to {reached:.3g} s (--budget allows more)")

    return check
