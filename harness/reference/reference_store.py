"""Store of references on disk, indexed by a digest of the scene and the request.

    run-SCENE-SIZE-INTEGRATOR.npz             decrease of the objective in each step of a reference run
    snapshot-SCENE-SIZE-INTEGRATOR-FRAME.npz  a step snapshot
    minima-SNAPSHOT.npz                       its known minima
    trajectory-SCENE-SIZE-TIMES.npz           positions and velocities at some times; SCENE without its step size
    growth-SCENE-SIZE-HORIZON.npz             growth of a perturbation of the start up to an end time
    converged-SCENE-SIZE-TIMES.npz            positions and velocities of a scene with contact, self-converged

Files have a temporary name until they are complete, and contain arrays only, named as the fields that they store.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from time import thread_time
from typing import Any

import numpy as np
from springbench.harness.atomic_files import atomic_write
from springbench.harness.reference.certified_minimum import (
    MINIMUM,
    KnownMinima,
    MinimumCertificate,
    find_minima,
    refine_minimum,
)
from springbench.harness.reference.equations_of_motion import OdeField, build_ode_scene
from springbench.harness.reference.perturbation_growth import PerturbationGrowth, estimate_growth
from springbench.harness.reference.reference_trajectory import ProgressFunction, ReferenceTrajectory, integrate_motion
from springbench.harness.reference.self_converged_trajectory import (
    CONTACT_MARGIN,
    MAX_SECONDS,
    SHORTEST_REFINEMENT,
    TRIAL_SHARE,
    NotConverged,
    SelfConvergedTrajectory,
    compute_self_converged,
    has_contact,
)
from springbench.harness.reference.step_snapshot import (
    SNAPSHOT_ARRAYS,
    Arrays,
    StepSnapshot,
    build_exact_scene,
    is_equal_to_roundoff,
    restore_snapshot,
    run_reference,
    save_snapshot,
    select_snapshot_frames,
)
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.scenes.scene_spec import IntegratorName, SceneSpec
from springbench.harness.simulation.time_loop import SimulationStep
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.step_problem import Positions, Solver

_CERTIFICATE_FIELDS = tuple(f.name for f in fields(MinimumCertificate) if f.name != "kind")
"""Stored fields of a minimum: the complete certificate of the stored point."""
_TRAJECTORY_FIELDS = tuple(f.name for f in fields(ReferenceTrajectory) if f.name != "growth")
"""Stored fields of a trajectory; the growth of perturbations has its own file."""
_SELF_CONVERGED_FIELDS = tuple(f.name for f in fields(SelfConvergedTrajectory))
_NUM_FINGERPRINT_STEPS = 100
"""Number of steps of a motion with contact, of which the first is its fingerprint."""
_NUM_HORIZONS = 8
"""Number of times, evenly spaced, among which the longest at which an error can be measured is found."""
_GROWTH_FIELDS = tuple(f.name for f in fields(PerturbationGrowth))


@dataclass(frozen=True, slots=True)
class ReferenceStore:
    """Store of all references in one folder, shared by all users of the same scenes.

    Attributes:
        folder: folder of the files.
        solver: solver of reference runs, Newton's method.
    """

    folder: Path
    solver: Solver = field(default_factory=NewtonSolver)

    def load_snapshots(
        self, spec: SceneSpec, size: int, integrator: IntegratorName = "implicit-euler"
    ) -> dict[str, StepSnapshot]:
        """Load or compute the snapshots SNAPSHOT_NAMES of the scene's `frames` steps.

        Args:
            spec: specification of the scene.
            size: size of the scene.
            integrator: name of the integrator.

        Raises:
            InputError: the scene cannot be built.
            RunFailed: a step of the reference run does not converge.
        """
        request = _ReferenceRequest(spec, size, integrator)
        path = self.folder / f"run-{request.name}.npz"
        objective_decrease = _read_arrays(path, ["objective_decrease"]).get("objective_decrease", np.empty(0))
        moments = select_snapshot_frames(objective_decrease, spec.frames)
        known = self._load_known_snapshots(request, moments.values()) if len(objective_decrease) == spec.frames else {}
        if not set(moments.values()) <= set(known):
            steps, objective_decrease = run_reference(request.scene, self.solver, spec.frames)
            _write_arrays(path, {"objective_decrease": objective_decrease})
            known, moments = self._save_steps(request, steps), select_snapshot_frames(objective_decrease, spec.frames)
        return {moment: known[frame] for moment, frame in moments.items()}

    def load_frames(
        self, spec: SceneSpec, size: int, frames: Collection[int], integrator: IntegratorName = "implicit-euler"
    ) -> dict[int, StepSnapshot]:
        """Load or compute the snapshots of given frames.

        A run continues from the last stored snapshot before the first missing one.

        Args:
            spec: specification of the scene.
            size: size of the scene.
            frames: frames, counted from 1.
            integrator: name of the integrator.

        Raises:
            InputError: the scene cannot be built.
            RunFailed: a step of the reference run does not converge.
        """
        request = _ReferenceRequest(spec, size, integrator)
        known = self._load_known_snapshots(request, frames)
        if missing := set(frames) - set(known):
            there = range(min(missing) - 1, 0, -1)
            before = next(
                (one for frame in there for one in self._load_known_snapshots(request, [frame]).values()), None
            )
            state = before.state if before else None
            steps, _ = run_reference(request.scene, self.solver, max(missing), missing, state)
            known |= self._save_steps(request, steps)
        return {frame: known[frame] for frame in frames}

    def find_minima(self, snapshot: StepSnapshot) -> KnownMinima:
        """Load the known minima of a problem, or find them.

        `lowest_minimum` of the result raises UncertifiedError if there is none.

        Args:
            snapshot: snapshot whose step problem is minimised.
        """
        path = self.folder / f"minima-{snapshot.digest}.npz"
        if stored := _read_arrays(path, _CERTIFICATE_FIELDS):
            return _build_minima(stored)
        found = find_minima(snapshot.problem, self.solver)
        if found.minima:
            self._save_minima(snapshot, found)
        return found

    def classify_minimum(self, snapshot: StepSnapshot, p: Positions) -> MinimumCertificate:
        """Find the minimum in whose basin p is.

        A new certified minimum is added to the known ones, and becomes the reference if it is the lowest. Its index is
        `find_minima(snapshot).find_index(minimum)` where it is certified.

        Args:
            snapshot: snapshot whose step problem is minimised, and under whose digest its minima are stored.
            p: positions (n, 3) [m], from which Newton's method starts.

        Returns:
            The known minimum that equals the one found, or the end point of Newton's method where it is not certified.
        """
        found, known = refine_minimum(snapshot.problem, p, self.solver), self.find_minima(snapshot)
        joined = known.add_minimum(found)
        if joined is not known:
            self._save_minima(snapshot, joined)
        return joined.minima[joined.find_index(found)] if found.is_certified else found

    def load_trajectory(
        self,
        spec: SceneSpec,
        size: int,
        times: Sequence[float],
        *,
        error: float,
        report_progress: ProgressFunction | None = None,
        growth_end: float | None = None,
        contact_error: float | None = None,
    ) -> ReferenceTrajectory:
        """Load or compute a reference trajectory at given times.

        It is the same for every step size of the scene. With contact it is self-converged, starting with steps of about
        the scene's own step size.

        Args:
            spec: specification of the scene.
            size: size of the scene.
            times: ascending times [s].
            error: smallest relative error to be measured.
            report_progress: called with the progress of an integration.
            growth_end: time [s] up to which the growth of a perturbation is estimated; the last time by default.
            contact_error: relative error for which a motion with contact is refined if none is stored; `error` by
                default.

        Raises:
            InputError: the scene cannot be built.
            NotIntegrable: the scene has no equations of motion.
            UnpredictableMotion: the reference would not be accurate enough.
        """
        name = _build_motion_name(spec, size, times)
        if has_contact(build_exact_scene(spec, size).system):
            found = self.load_self_converged(spec, size, times, error=error, refined_error=contact_error)
            found.require_accuracy(error)
            return found
        seen = self.load_growth(spec, size, growth_end or times[-1])
        seen.require_predictable(error, times)
        scene = build_ode_scene(spec, size)
        witness, path = OdeField(scene).evaluate_fingerprint(), self.folder / f"trajectory-{name}.npz"
        stored = _read_arrays(path, [*_TRAJECTORY_FIELDS, "fingerprint"])
        if stored and is_equal_to_roundoff(stored.pop("fingerprint"), witness):
            found = ReferenceTrajectory(**stored, growth=seen.interpolate_growth(times))
        else:
            found = replace(integrate_motion(scene, times, report_progress), growth=seen.interpolate_growth(times))
            _write_arrays(path, {key: getattr(found, key) for key in _TRAJECTORY_FIELDS} | {"fingerprint": witness})
        found.require_accuracy(error)
        return found

    def load_growth(self, spec: SceneSpec, size: int, t_end: float) -> PerturbationGrowth:
        """Load or estimate the growth of a perturbation up to an end time [s].

        Args:
            spec: specification of the scene.
            size: size of the scene.
            t_end: end time [s].

        Raises:
            UnpredictableMotion: nothing moves, or the motion is not finite.
            NotIntegrable: the scene has no equations of motion.
        """
        witness = OdeField(build_ode_scene(spec, size)).evaluate_fingerprint()
        path = self.folder / f"growth-{_build_motion_name(spec, size, [t_end])}.npz"
        stored = _read_arrays(path, [*_GROWTH_FIELDS, "fingerprint"])
        if stored and is_equal_to_roundoff(stored.pop("fingerprint"), witness):
            return PerturbationGrowth(scale=float(stored.pop("scale")), **stored)
        found = estimate_growth(spec, size, t_end)
        arrays = {name: np.asarray(getattr(found, name)) for name in _GROWTH_FIELDS}
        _write_arrays(path, arrays | {"fingerprint": witness})
        return found

    def load_self_converged(
        self,
        spec: SceneSpec,
        size: int,
        times: Sequence[float],
        *,
        error: float,
        refined_error: float | None = None,
        seconds: float | None = None,
    ) -> SelfConvergedTrajectory:
        """Load or compute the self-converged trajectory of a scene with contact.

        It may be less accurate than requested. Its fingerprint is a first step, the same for every time step of the
        scene.

        Args:
            spec: specification of the scene.
            size: size of the scene.
            times: ascending times [s].
            error: smallest relative error to be measured, if that takes no longer than `seconds`.
            refined_error: error for which a motion is computed if none for `error` is stored; `error` by default.
            seconds: limit on the processor time [s]; MAX_SECONDS by default.

        Raises:
            InputError: the scene cannot be built.
            NotConverged: not even two step sizes could be compared.
        """
        path = self.folder / f"converged-{_build_motion_name(spec, size, times)}.npz"
        witness = self._compute_contact_fingerprint(spec, size, times[-1])
        if (stored := _read_self_converged(path, witness)) and stored[1] <= error:
            return stored[0]
        error = refined_error or error

        def build_refined(h: float, integrator: str) -> Scene:
            return build_exact_scene(spec.with_time_step(h), size, integrator, show_warnings=False)

        found = compute_self_converged(build_refined, spec.time_step, times, error, seconds or MAX_SECONDS)
        _save_self_converged(path, found, witness, error)
        return found

    def _compute_contact_fingerprint(self, spec: SceneSpec, size: int, t_end: float) -> Positions:
        """Compute the positions (n, 3) [m] after a short step, independently of the scene's time step."""
        short = build_exact_scene(spec.with_time_step(t_end / _NUM_FINGERPRINT_STEPS), size, show_warnings=False)
        return next(iter(run_reference(short, self.solver, 1, [1])[0].values())).positions

    def load_contact_horizon(
        self, spec: SceneSpec, size: int, t_end: float, *, error: float
    ) -> tuple[SelfConvergedTrajectory, str]:
        """Load the motion with contact at the longest time with a measurable error.

        Eighths of t_end are tried, then those of a quarter of it, and so on, within MAX_SECONDS altogether.

        Args:
            spec: specification of the scene.
            size: size of the scene.
            t_end: longest time [s].
            error: relative error to be measured.

        Returns:
            The motion at that time, and why the time is not longer; empty at t_end.

        Raises:
            InputError: the scene cannot be built.
            NotConverged: there is no such time.
        """
        if found := self._find_stored_horizon(spec, size, t_end, error):
            return found, ""
        last, reason, left = max(1, round(t_end / spec.time_step)), "", MAX_SECONDS
        step = t_end / last
        while True:
            began = thread_time()
            ends = sorted({max(1, round(last * part / _NUM_HORIZONS)) for part in range(1, _NUM_HORIZONS + 1)})
            try:
                found = self.load_self_converged(
                    spec, size, [step * end for end in ends], error=error, seconds=TRIAL_SHARE * left
                )
                known = found.find_last_known_time(CONTACT_MARGIN * error)
                if known is None:
                    found.require_accuracy(error)
                else:
                    reason = found.describe_uncertainty(known + 1) if known + 1 < len(ends) else reason
                    return self._save_horizon(spec, size, found.select_times(slice(known, known + 1)), error), reason
            except NotConverged as refused:
                reason, left = str(refused), left - (thread_time() - began)
                if last == 1 or left < SHORTEST_REFINEMENT:
                    raise
            last = max(1, last // 4)

    def _find_stored_horizon(
        self, spec: SceneSpec, size: int, t_end: float, error: float
    ) -> SelfConvergedTrajectory | None:
        """Find a stored motion at t_end [s] by which the error can be measured."""
        path = self.folder / f"converged-{_build_motion_name(spec, size, [t_end])}.npz"
        if not path.exists():
            return None
        stored = _read_self_converged(path, self._compute_contact_fingerprint(spec, size, t_end))
        return stored[0] if stored and stored[0].count_known_times(CONTACT_MARGIN * error) else None

    def _save_horizon(
        self, spec: SceneSpec, size: int, found: SelfConvergedTrajectory, error: float
    ) -> SelfConvergedTrajectory:
        """Store the motion at its only time, the same for all requests."""
        path = self.folder / f"converged-{_build_motion_name(spec, size, found.times.tolist())}.npz"
        if not path.exists():
            witness = self._compute_contact_fingerprint(spec, size, float(found.times[-1]))
            _save_self_converged(path, found, witness, error)
        return found

    def require_contact_horizon(
        self, spec: SceneSpec, size: int, t_end: float, *, error: float
    ) -> SelfConvergedTrajectory:
        """Load the motion of a scene with contact at one time, or fail.

        Args:
            spec: specification of the scene.
            size: size of the scene.
            t_end: time [s] of the motion.
            error: relative error that is to be measured by the motion.

        Raises:
            InputError: the scene cannot be built.
            NotConverged: the error cannot be measured then; the message states until when it can.
        """
        found, reason = self.load_contact_horizon(spec, size, t_end, error=error)
        if reason:
            raise NotConverged(
                f"with contact an error of {error:g} can be measured only up to {found.times[-1]:.4g} s, "
                f"because {reason}; "
                f"use a --t-end of {found.times[-1]:.4g} or less, or a larger --error"
            )
        return found

    def _load_known_snapshots(self, request: _ReferenceRequest, frames: Iterable[int]) -> dict[int, StepSnapshot]:
        """Load the snapshots that are on disk and match the present scene."""
        stored = [_read_arrays(self._snapshot_path(request, frame), SNAPSHOT_ARRAYS) for frame in frames]
        snapshots = [restore_snapshot(arrays, request.scene) for arrays in stored if arrays]
        return {snapshot.frame: snapshot for snapshot in snapshots if snapshot}

    def _snapshot_path(self, request: _ReferenceRequest, frame: int) -> Path:
        return self.folder / f"snapshot-{request.name}-{frame}.npz"

    def _save_steps(self, request: _ReferenceRequest, steps: dict[int, SimulationStep]) -> dict[int, StepSnapshot]:
        snapshots: dict[int, StepSnapshot] = {}
        for frame, step in steps.items():
            snapshots[frame], arrays = save_snapshot(step, request.name)
            _write_arrays(self._snapshot_path(request, frame), arrays)
        return snapshots

    def _save_minima(self, snapshot: StepSnapshot, known: KnownMinima) -> None:
        arrays = {name: np.array([getattr(minimum, name) for minimum in known.minima]) for name in _CERTIFICATE_FIELDS}
        _write_arrays(self.folder / f"minima-{snapshot.digest}.npz", arrays)


class _ReferenceRequest:
    """A scene of one size with one integrator, and its name in file names."""

    def __init__(self, spec: SceneSpec, size: int, integrator: IntegratorName) -> None:
        self.scene: Scene = build_exact_scene(spec, size, integrator)
        self.name = f"{spec.scene_digest[:12]}-{size}-{integrator}"


def _build_motion_name(spec: SceneSpec, size: int, times: Sequence[float]) -> str:
    """Return the part of a file name that identifies a motion.

    It consists of the scene without its step size, its size, and the times.
    """
    return f"{spec.with_time_step(1.0).scene_digest[:12]}-{size}-{'-'.join(f'{t:.9g}' for t in times)}"


def _save_self_converged(path: Path, found: SelfConvergedTrajectory, witness: Positions, error: float) -> None:
    arrays = {name: np.asarray(getattr(found, name)) for name in _SELF_CONVERGED_FIELDS}
    _write_arrays(path, arrays | {"fingerprint": witness, "error": np.asarray(error)})


def _read_self_converged(path: Path, witness: Positions) -> tuple[SelfConvergedTrajectory, float] | None:
    """Read a stored motion and the error that it was computed for.

    The result is None if there is no motion of the same scene, whose fingerprint is `witness`.
    """
    stored = _read_arrays(path, [*_SELF_CONVERGED_FIELDS, "fingerprint", "error"])
    if not stored or not is_equal_to_roundoff(stored.pop("fingerprint"), witness):
        return None
    error = float(stored.pop("error"))
    scalars = {key: stored.pop(key).item() for key in ("step", "last_change")}
    return SelfConvergedTrajectory(**stored, **scalars), error


def _build_minima(arrays: Arrays) -> KnownMinima:
    columns = [arrays[name] if arrays[name].ndim > 1 else arrays[name].tolist() for name in _CERTIFICATE_FIELDS]
    return KnownMinima(tuple(MinimumCertificate(*values, kind=MINIMUM) for values in zip(*columns, strict=True)))


def _read_arrays(path: Path, names: Collection[str]) -> dict[str, Any]:
    """Read the arrays of a file; none if it is missing or lacks a name.

    Files of another version of the code may lack names.
    """
    if not path.exists():
        return {}
    with np.load(path, allow_pickle=False) as stored:
        arrays = dict(stored)
    for array in arrays.values():
        array.flags.writeable = False
    return arrays if arrays.keys() >= set(names) else {}


def _write_arrays(path: Path, arrays: Arrays) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as partial:
        np.savez(partial, allow_pickle=False, **arrays)
