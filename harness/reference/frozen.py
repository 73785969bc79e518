"""Snapshots of single steps of a reference run, so that all solvers solve the same problem.

The reference run takes converged steps (Newton's method), with all pins exact whatever the scene states. Accuracy is
measured on three snapshots:

    early     a tenth of the run, and the second step at least, before which BDF2 has no history
    middle    half of the run
    violent   the step with the largest decrease g(current positions) - g(minimum), which is about the kinetic energy
              in free motion, and more where the motion is stopped by springs or contact
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from harness.base.errors import RunFailed
from harness.scenes.bind import Scene, build
from harness.scenes.spec import SceneSpec
from harness.simulation.step import State, Step, guessed, prepare, simulate
from solvers.integrators import Motion
from solvers.problem import Pins, Positions, Solver, Start, StepProblem, StopRule

MOMENTS = ("early", "middle", "violent")
CONVERGED = StopRule(500, 1e-12)
"""Stop rule of the reference run: Newton's method reaches the last digits in one more iteration."""

Arrays = Mapping[str, NDArray[Any]]


@dataclass(frozen=True, slots=True, eq=False)
class Frozen:
    """One step of a reference run.

    Attributes:
      frame: step number, from 1.
      problem: step problem with exact pins, whose initial guess is the current positions.
      after: motion at the step's end.
      digest: 12 hex digits of a hash of the problem's arrays, of the gradient at the current positions, which
        represents the energies, and of the origin of the snapshot.
      acceleration: acceleration at the step's end (n, 3) [m/s^2], None where the integrator provides none.
    """

    frame: int
    problem: StepProblem
    after: Motion
    digest: str
    acceleration: Positions | None = None

    @property
    def state(self) -> State:
        """The state from which the reference run continues."""
        begun = self.problem.start
        return State(self.after, Motion(begun.positions, begun.velocity), self.frame, self.acceleration)

    def stated(self, first_guess: str) -> StepProblem:
        """Return the problem with an initial guess by name (`harness.simulation.step`)."""
        return guessed(self.problem, first_guess)


def bind(spec: SceneSpec, size: int, integrator: str = "implicit-euler", *, warns: bool = True) -> Scene:
    """Build the scene with all of its pins exact.

    Args:
      spec: specification of the scene.
      size: size of the scene.
      integrator: name of the integrator.
      warns: whether warnings of the scene are shown.

    Raises:
      InputError: the scene cannot be built.
    """
    scene = build(spec, size, integrator, warns=warns)
    vertices = scene.system.pins.vertices
    return replace(scene, system=replace(scene.system, pins=Pins(vertices, np.full(len(vertices), np.inf))))


def reference_run(
    scene: Scene, solver: Solver, length: int, wanted: Collection[int] = (), state: State | None = None
) -> tuple[dict[int, Step], NDArray[np.float64]]:
    """Take converged steps up to a number of steps.

    Args:
      scene: scene with exact pins.
      solver: solver of the steps.
      length: number of the last step.
      wanted: steps to return; the snapshot steps if empty.
      state: state from which to continue; the start of the scene if omitted.

    Returns: the steps by frame, and for all steps (length,) the decrease of the objective [J] from the current
      positions to the solution, nan before the initial state.

    Raises:
      RunFailed: a step does not converge.
    """
    kept: dict[int, Step] = {}
    violence, keep = np.full(length, np.nan), set(wanted)
    run = simulate(scene, prepare(scene, solver), CONVERGED, first_guess="current", frames=length, state=state)
    for step in run:
        if step.solution.stopped == "iterations" or not np.isfinite(step.positions).all():
            raise RunFailed(f"step {step.index} of the reference run does not converge")
        stated = step.problem
        violence[step.index - 1] = stated.value(stated.current) - stated.value(step.solution.positions)
        if not wanted:
            keep = set(moment_frames(violence[: step.index], length).values())
        kept[step.index] = step
        kept = {frame: one for frame, one in kept.items() if frame in keep}
    return kept, violence


def moment_frames(violence: NDArray[np.float64], length: int) -> dict[str, int]:
    """Select the frames of MOMENTS in a run.

    Args:
      violence: decrease of the objective [J] of the first steps (frames,).
      length: number of steps of the run.
    """
    first = min(2, length)
    return {
        "early": max(first, -(-length // 10)),
        "middle": max(first, (length + 1) // 2),
        "violent": first + int(np.argmax(violence[first - 1 :])) if len(violence) >= first else 1,
    }


_ARRAYS = ("target", "force", "pin_targets", "current")
_MAYBE = ("lagged", "acceleration", "kept", "pressed")
_START = tuple(field.name for field in fields(Start) if field.name not in _MAYBE)


def freeze(step: Step, origin: str) -> tuple[Frozen, Arrays]:
    """Convert a step to a snapshot and to the arrays that are saved.

    Args:
      step: step of the reference run.
      origin: description of the source of the step.
    """
    problem, now = step.problem, step.state.now
    system, start = problem.system, problem.start
    arrays: dict[str, Any] = {name: getattr(problem, name) for name in _ARRAYS}
    arrays |= {f"start_{name}": getattr(start, name) for name in _START}
    arrays |= {f"start_{name}": known for name in _MAYBE if (known := getattr(start, name)) is not None}
    arrays |= {"mass": system.mass, "pins": system.pins.vertices, "gradient": problem.gradient(problem.current)}
    arrays |= {"time_step": system.time_step, "factor": system.factor, "frame": step.index}
    arrays = {name: np.asarray(value) for name, value in arrays.items()}
    content = hashlib.sha256(origin.encode())
    for name, array in arrays.items():
        content.update(f"{name} {array.dtype} {array.shape} ".encode() + array.tobytes())
    digest = content.hexdigest()[:12]
    ends = {"after_positions": now.positions, "after_velocity": now.velocity, "digest": np.asarray(digest)}
    if (acceleration := step.state.acceleration) is not None:
        ends["after_acceleration"] = acceleration
    return Frozen(step.index, problem, now, digest, acceleration), arrays | ends


def thaw(arrays: Arrays, scene: Scene) -> Frozen | None:
    """Restore a saved snapshot for a scene; None where the problem has changed."""
    if any(f"start_{name}" not in arrays for name in _START):
        return None
    system = replace(scene.system, factor=float(arrays["factor"]))
    begun: dict[str, Any] = {name: arrays[f"start_{name}"] for name in (*_START, *_MAYBE) if f"start_{name}" in arrays}
    begun |= {name: float(value) for name, value in begun.items() if not value.ndim}
    given = {name: arrays[name] for name in _ARRAYS}
    problem = StepProblem(system, **given, first_guess=given["current"], start=Start(**begun))
    same = (
        system.time_step == arrays["time_step"]
        and np.array_equal(system.mass, arrays["mass"])
        and np.array_equal(system.pins.vertices, arrays["pins"])
        and agree(problem.gradient(problem.current), arrays["gradient"])
    )
    after = Motion(arrays["after_positions"], arrays["after_velocity"])
    told = str(arrays["digest"]), arrays.get("after_acceleration")
    return Frozen(int(arrays["frame"]), problem, after, *told) if same else None


def agree(found: NDArray[np.float64], wanted: NDArray[np.float64]) -> bool:
    """Return whether two arrays are equal up to processor-dependent summation order."""
    if found.shape != wanted.shape:
        return False
    return bool(np.abs(found - wanted).max(initial=0.0) <= 1e-9 * np.abs(wanted).max(initial=0.0))
