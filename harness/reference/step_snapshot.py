"""Snapshots of single steps of a reference run, as common problems for all solvers.

The reference run takes converged steps by Newton's method, with all pins exact, also those that the scene declares as
penalties. Accuracy is measured on three snapshots:

    early     a tenth of the run, and the second step at least, before which BDF2 has no history
    middle    half of the run
    peak      the step with the largest decrease g(current positions) - g(minimum), which is about the kinetic energy
              in free motion, and more where the motion is stopped by springs or contact
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from springbench.harness.errors import RunFailed
from springbench.harness.scenes.scene_builder import Scene, build_scene
from springbench.harness.scenes.scene_spec import SceneSpec
from springbench.harness.simulation.time_loop import (
    MotionState,
    SimulationStep,
    apply_initial_guess,
    prepare,
    simulate_scene,
)
from springbench.solvers.model.integrators import Motion
from springbench.solvers.model.rounding_bound import is_gradient_roundoff
from springbench.solvers.model.step_problem import DirichletPins, Positions, Solver, StepProblem, StepStart, StopRule

SNAPSHOT_NAMES = ("early", "middle", "peak")
REFERENCE_STOP_RULE = StopRule(500, 1e-12)
"""Stop rule of the reference run: Newton's method reaches the last digits in one more iteration."""

_MAX_ROUNDOFF_RATIO = 4.0 * REFERENCE_STOP_RULE.roundoff_floor
"""Largest ratio of the gradient to its rounding bound at which a step that reaches the iteration limit has converged.

Measured, not derived: near contacts iterates stagnate at ratios up to 16, twice the floor. The bound of a barrier is
its Hessian times the rounding of the positions, which is of first order; a bound of higher orders is not known."""

Arrays = Mapping[str, NDArray[Any]]


@dataclass(frozen=True, slots=True, eq=False)
class StepSnapshot:
    """One step of a reference run.

    Attributes:
        frame: step number, from 1.
        problem: step problem with exact pins, whose initial guess is the current positions.
        end_motion: motion at the step's end.
        digest: 12 hex digits of a hash of the problem's arrays, of the gradient at the current positions, which
            represents the energies, and of the origin of the snapshot.
        acceleration: acceleration at the step's end (n, 3) [m/s^2], None where the integrator provides none.
    """

    frame: int
    problem: StepProblem
    end_motion: Motion
    digest: str
    acceleration: Positions | None = None

    @property
    def state(self) -> MotionState:
        """The state from which the reference run continues."""
        begun = self.problem.step_start
        return MotionState(self.end_motion, Motion(begun.positions, begun.velocity), self.frame, self.acceleration)

    def build_problem(self, initial_guess: str) -> StepProblem:
        """Return the problem with an initial guess by name (`springbench.harness.simulation.time_loop`)."""
        return apply_initial_guess(self.problem, initial_guess)


def build_exact_scene(
    spec: SceneSpec, size: int, integrator: str = "implicit-euler", *, show_warnings: bool = True
) -> Scene:
    """Build the scene with all of its pins exact.

    Args:
        spec: specification of the scene.
        size: size of the scene.
        integrator: name of the integrator.
        show_warnings: whether warnings of the scene are shown.

    Raises:
        InputError: the scene cannot be built.
    """
    scene = build_scene(spec, size, integrator, log_warnings=show_warnings)
    vertices = scene.system.pins.vertices
    return replace(scene, system=replace(scene.system, pins=DirichletPins(vertices, np.full(len(vertices), np.inf))))


def run_reference(
    scene: Scene, solver: Solver, num_steps: int, frames: Collection[int] = (), initial_state: MotionState | None = None
) -> tuple[dict[int, SimulationStep], NDArray[np.float64]]:
    """Take converged steps up to a number of steps.

    Args:
        scene: scene with exact pins.
        solver: solver of the steps.
        num_steps: number of the last step.
        frames: steps to return; the snapshot steps if empty.
        initial_state: state from which to continue; the start of the scene if omitted.

    Returns:
        The steps by frame, and for all steps (num_steps,) the decrease of the objective [J] from the current
        positions to the solution, nan before the initial state.

    Raises:
        RunFailed: a step does not converge.
    """
    stored: dict[int, SimulationStep] = {}
    objective_decrease, keep = np.full(num_steps, np.nan), set(frames)
    run = simulate_scene(
        scene,
        prepare(scene, solver),
        REFERENCE_STOP_RULE,
        initial_guess="previous",
        frames=num_steps,
        initial_state=initial_state,
    )
    for step in run:
        if not np.isfinite(step.positions).all() or (
            step.solution.termination_reason == "max-iter"
            and not is_gradient_roundoff(step.problem, step.solution.positions, _MAX_ROUNDOFF_RATIO)
        ):
            raise RunFailed(f"step {step.index} of the reference run does not converge")
        stated = step.problem
        objective_decrease[step.index - 1] = stated.value(stated.current_positions) - stated.value(
            step.solution.positions
        )
        if not frames:
            keep = set(select_snapshot_frames(objective_decrease[: step.index], num_steps).values())
        stored[step.index] = step
        stored = {frame: one for frame, one in stored.items() if frame in keep}
    return stored, objective_decrease


def select_snapshot_frames(objective_decrease: NDArray[np.float64], num_steps: int) -> dict[str, int]:
    """Select the frames of SNAPSHOT_NAMES in a run.

    Args:
        objective_decrease: decrease of the objective [J] of the first steps (frames,).
        num_steps: number of steps of the run.
    """
    first = min(2, num_steps)
    return {
        "early": max(first, -(-num_steps // 10)),
        "middle": max(first, (num_steps + 1) // 2),
        "peak": first + int(np.argmax(objective_decrease[first - 1 :])) if len(objective_decrease) >= first else 1,
    }


_PROBLEM_FIELDS = ("inertial_target", "external_force", "pin_targets", "current_positions")
_OPTIONAL_FIELDS = (
    "lag_override",
    "predicted_acceleration",
    "warm_start",
    "normal_force_positions",
    "pattern_positions",
)
_START_FIELDS = tuple(field.name for field in fields(StepStart) if field.name not in _OPTIONAL_FIELDS)
SNAPSHOT_ARRAYS = (
    *_PROBLEM_FIELDS,
    *(f"start_{name}" for name in _START_FIELDS),
    *("mass", "pinned_vertices", "gradient", "time_step", "inertia_factor", "frame"),
    *("end_positions", "end_velocity", "digest"),
)
"""Names of the arrays that every stored snapshot has."""


def save_snapshot(step: SimulationStep, origin: str) -> tuple[StepSnapshot, Arrays]:
    """Convert a step to a snapshot and to the arrays that are saved.

    Args:
        step: step of the reference run.
        origin: description of the source of the step.
    """
    problem, now = step.problem, step.state.motion
    system, start = problem.system, problem.step_start
    stored: dict[str, Any] = {name: getattr(problem, name) for name in _PROBLEM_FIELDS}
    stored |= {f"start_{name}": getattr(start, name) for name in (*_START_FIELDS, *_OPTIONAL_FIELDS)}
    stored |= {
        "mass": system.mass,
        "pinned_vertices": system.pins.vertices,
        "gradient": problem.gradient(problem.current_positions),
        "time_step": system.time_step,
        "inertia_factor": system.inertia_factor,
        "frame": step.index,
    }
    content = hashlib.sha256(origin.encode())
    for k, array in enumerate(stored.values()):  # numbers, not names, which would change the digest of equal states
        if array is not None:
            array = np.asarray(array)
            content.update(f"{k} {array.dtype} {array.shape} ".encode() + array.tobytes())
    digest, acceleration = content.hexdigest()[:12], step.state.acceleration
    stored |= {"end_positions": now.positions, "end_velocity": now.velocity, "end_acceleration": acceleration}
    arrays = {name: np.asarray(array) for name, array in stored.items() if array is not None}
    return StepSnapshot(step.index, problem, now, digest, acceleration), arrays | {"digest": np.asarray(digest)}


def restore_snapshot(arrays: Arrays, scene: Scene) -> StepSnapshot | None:
    """Restore a saved snapshot for a scene; None where the problem has changed.

    Args:
        arrays: arrays of `save_snapshot` by name.
        scene: scene with exact pins, whose system the step problem gets.

    Returns:
        The snapshot; None if an array of the start of the step is missing, or if time step, masses, pins or the
        gradient at the current positions differ from the stored ones.
    """
    if any(f"start_{name}" not in arrays for name in _START_FIELDS):
        return None
    system = replace(scene.system, inertia_factor=float(arrays["inertia_factor"]))
    begun: dict[str, Any] = {
        name: arrays[f"start_{name}"] for name in (*_START_FIELDS, *_OPTIONAL_FIELDS) if f"start_{name}" in arrays
    }
    begun |= {name: float(value) for name, value in begun.items() if not value.ndim}
    given = {name: arrays[name] for name in _PROBLEM_FIELDS}
    problem = StepProblem(system, **given, initial_guess=given["current_positions"], step_start=StepStart(**begun))
    same = (
        system.time_step == arrays["time_step"]
        and np.array_equal(system.mass, arrays["mass"])
        and np.array_equal(system.pins.vertices, arrays["pinned_vertices"])
        and is_equal_to_roundoff(problem.gradient(problem.current_positions), arrays["gradient"])
    )
    after = Motion(arrays["end_positions"], arrays["end_velocity"])
    digest = str(arrays["digest"]), arrays.get("end_acceleration")
    return StepSnapshot(int(arrays["frame"]), problem, after, *digest) if same else None


def is_equal_to_roundoff(found: NDArray[np.float64], expected: NDArray[np.float64]) -> bool:
    """Return whether two arrays are equal up to processor-dependent summation order.

    Args:
        found: array that is checked; an array of another shape is unequal.
        expected: array whose largest absolute value scales the tolerance of 1e-9.
    """
    if found.shape != expected.shape:
        return False
    return bool(np.abs(found - expected).max(initial=0.0) <= 1e-9 * np.abs(expected).max(initial=0.0))
