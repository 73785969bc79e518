"""Frozen step problems: single steps of a reference run, so that every solver answers the same question.

The reference run takes converged steps (Newton's method), with pins exact whatever the scene says of them. Three of its
moments are graded:

    early     a tenth of the run, and the second step at least, before which BDF2 has no history
    middle    half of it
    violent   the step that has farthest to go: the largest g(current positions) - g(minimum), which is about the
              kinetic energy while things fly, and more where they are caught
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
"""The reference run's steps: Newton's method takes the last digits in one iteration more."""

Arrays = Mapping[str, NDArray[Any]]


@dataclass(frozen=True, slots=True, eq=False)
class Frozen:
    """One step of a reference run.

    frame: the step, from 1; problem: exact pins, its first guess the current positions; after: the motion at the
    step's end; digest: 12 hex digits of the problem's arrays, of the gradient at the current positions, which stands
    for the energies, and of where it is from; acceleration: at the step's end, None where the integrator tells none.
    """

    frame: int
    problem: StepProblem
    after: Motion
    digest: str
    acceleration: Positions | None = None

    @property
    def state(self) -> State:
        """From which the reference run goes on."""
        begun = self.problem.start
        return State(self.after, Motion(begun.positions, begun.velocity), self.frame, self.acceleration)

    def stated(self, first_guess: str) -> StepProblem:
        """The problem with a first guess by name (`harness.simulation.step.FIRST_GUESSES`)."""
        return guessed(self.problem, first_guess)


def bind(spec: SceneSpec, size: int, integrator: str = "implicit-euler", *, warns: bool = True) -> Scene:
    """The scene with all of its pins exact; warns: see `build`. Raises InputError."""
    scene = build(spec, size, integrator, warns=warns)
    vertices = scene.system.pins.vertices
    return replace(scene, system=replace(scene.system, pins=Pins(vertices, np.full(len(vertices), np.inf))))


def reference_run(
    scene: Scene, solver: Solver, length: int, wanted: Collection[int] = (), state: State | None = None
) -> tuple[dict[int, Step], NDArray[np.float64]]:
    """Converged steps up to `length`, from a state (the start if it is left out).

    Returns the frames wanted, or the moments where none are, and the violence (length,) [J] of all steps, which is
    what the objective falls by from the current positions, nan before the state. Raises RunFailed where a step does
    not converge.
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
    """The frames of MOMENTS in a run of `length` steps, of whose first the violence (frames,) [J] is known."""
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
    """A step as a frozen problem, and as the arrays to be saved; origin: what it was taken from, in words."""
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
    """The frozen problem in saved arrays, bound to a scene; None where today's scene states another problem."""
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
    """Whether two arrays are the same but for the order of sums, which differs between processors."""
    if found.shape != wanted.shape:
        return False
    return bool(np.abs(found - wanted).max(initial=0.0) <= 1e-9 * np.abs(wanted).max(initial=0.0))
