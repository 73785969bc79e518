"""Store of references on disk, indexed by a digest of the scene and the request.

    run-SCENE-SIZE-INTEGRATOR.npz             decrease of the objective in each step of a reference run
    problem-SCENE-SIZE-INTEGRATOR-FRAME.npz   a step snapshot
    minima-PROBLEM.npz                        its known minima
    trajectory-SCENE-SIZE-TIMES.npz           positions and velocities at some times; SCENE without its step size
    growth-SCENE-SIZE-HORIZON.npz             growth of a perturbation of the start up to an end time
    converged-SCENE-SIZE-TIMES.npz            positions and velocities of a scene with contact, self-converged

Files have a temporary name until they are complete, and contain arrays only.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from harness.base.files import replacing
from harness.reference.frozen import Arrays, Frozen, agree, bind, freeze, moment_frames, reference_run, thaw
from harness.reference.growth import Growth, growth
from harness.reference.minimiser import MINIMUM, KnownMinima, Minimum, find_minima, polish
from harness.reference.motion import Field, moving
from harness.reference.self_converged import SelfConverged, converge, touches
from harness.reference.trajectory import Told, Trajectory, integrate
from harness.scenes.bind import Scene
from harness.scenes.spec import IntegratorName, SceneSpec
from harness.simulation.step import Step
from solvers.methods.newton import Newton
from solvers.problem import Positions, Solver

_CERTIFICATE = ("positions", "g", "error", "smallest_eigenvalue", "doubt", "near")
"""Stored fields of a minimum: the complete certificate of the stored point."""
_INTEGRATED = tuple(f.name for f in fields(Trajectory) if f.name != "growth")
"""Stored fields of a trajectory; the growth of perturbations has its own file."""


@dataclass(frozen=True, slots=True)
class Store:
    """Store of all references in one folder, shared by all users of the same scenes.

    Attributes:
      folder: folder of the files.
      solver: solver of reference runs, Newton's method.
    """

    folder: Path
    solver: Solver = field(default_factory=Newton)

    def moments(self, spec: SceneSpec, size: int, integrator: IntegratorName = "implicit-euler") -> dict[str, Frozen]:
        """Load or compute the snapshots MOMENTS of the scene's `frames` steps.

        Args:
          spec: specification of the scene.
          size: size of the scene.
          integrator: name of the integrator.

        Raises:
          InputError: the scene cannot be built.
          RunFailed: a step of the reference run does not converge.
        """
        asked = _Asked(spec, size, integrator)
        path = self.folder / f"run-{asked.name}.npz"
        violence = _read(path)["violence"] if path.exists() else np.empty(0)
        moments = moment_frames(violence, spec.frames)
        known = self._known(asked, moments.values()) if len(violence) == spec.frames else {}
        if not set(moments.values()) <= set(known):
            steps, violence = reference_run(asked.scene, self.solver, spec.frames)
            _write(path, {"violence": violence})
            known, moments = self._keep(asked, steps), moment_frames(violence, spec.frames)
        return {moment: known[frame] for moment, frame in moments.items()}

    def frames(
        self, spec: SceneSpec, size: int, frames: Collection[int], integrator: IntegratorName = "implicit-euler"
    ) -> dict[int, Frozen]:
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
        asked = _Asked(spec, size, integrator)
        known = self._known(asked, frames)
        if missing := set(frames) - set(known):
            there = range(min(missing) - 1, 0, -1)
            before = next((one for frame in there for one in self._known(asked, [frame]).values()), None)
            state = before.state if before else None
            steps, _ = reference_run(asked.scene, self.solver, max(missing), missing, state)
            known |= self._keep(asked, steps)
        return {frame: known[frame] for frame in frames}

    def reference(self, frozen: Frozen) -> KnownMinima:
        """Load the known minima of a problem, or find them.

        `lowest` of the result raises Uncertified if there is none.
        """
        path = self.folder / f"minima-{frozen.digest}.npz"
        if path.exists() and (stored := _read(path)).keys() >= set(_CERTIFICATE):  # else by code that certified less
            return _minima(stored)
        found = find_minima(frozen.problem, self.solver)
        if found.minima:
            self._remember(frozen, found)
        return found

    def classify(self, frozen: Frozen, p: Positions) -> Minimum:
        """Find the minimum in whose basin p (n, 3) [m] is.

        A new certified minimum is added to the known ones, and becomes the reference if it is the lowest. Its index is
        `find_minima(moment).branch(minimum)` where it is certified.
        """
        found, known = polish(frozen.problem, p, self.solver), self.reference(frozen)
        joined = known.joined(found)
        if joined is not known:
            self._remember(frozen, joined)
        return joined.minima[joined.branch(found)] if found.certified else found

    def trajectory(
        self, spec: SceneSpec, size: int, times: Sequence[float], *, error: float, told: Told | None = None
    ) -> Trajectory:
        """Load or compute a reference trajectory at given times.

        It is the same for every step size of the scene. With contact it is self-converged, starting with steps of about
        the scene's own step size.

        Args:
          spec: specification of the scene.
          size: size of the scene.
          times: ascending times [s].
          error: smallest relative error to be measured.
          told: called with the progress of an integration.

        Raises:
          InputError: the scene cannot be built.
          Unintegrable: the scene has no equations of motion.
          Unpredictable: the reference would not be accurate enough.
        """
        name = _named(spec, size, times)
        if touches(bind(spec, size).system):
            return self._converged(self.folder / f"converged-{name}.npz", spec, size, times, error)
        seen = self.growth(spec, size, times[-1])
        seen.require(error, times)
        scene = moving(spec, size)
        witness, path = Field(scene).witness(), self.folder / f"trajectory-{name}.npz"
        stored: dict[str, Any] = dict(_read(path)) if path.exists() else {}
        if stored and agree(stored.pop("witness"), witness):
            found = Trajectory(**{key: stored[key] for key in _INTEGRATED}, growth=seen.at(times))
        else:
            found = replace(integrate(scene, times, told), growth=seen.at(times))
            _write(path, {key: getattr(found, key) for key in _INTEGRATED} | {"witness": witness})
        found.require(error)
        return found

    def growth(self, spec: SceneSpec, size: int, horizon: float) -> Growth:
        """Load or estimate the growth of a perturbation up to an end time [s].

        Args:
          spec: specification of the scene.
          size: size of the scene.
          horizon: end time [s].

        Raises:
          Unpredictable: nothing moves, or the motion is not finite.
          Unintegrable: the scene has no equations of motion.
        """
        witness = Field(moving(spec, size)).witness()
        path = self.folder / f"growth-{_named(spec, size, [horizon])}.npz"
        stored: dict[str, Any] = dict(_read(path)) if path.exists() else {}
        if stored and agree(stored.pop("witness"), witness):
            return Growth(scale=float(stored.pop("scale")), **stored)
        found = growth(spec, size, horizon)
        arrays = {f.name: np.asarray(getattr(found, f.name)) for f in fields(Growth)}
        _write(path, arrays | {"witness": witness})
        return found

    def _converged(self, path: Path, spec: SceneSpec, size: int, times: Sequence[float], error: float) -> SelfConverged:
        """Load the self-converged trajectory if stored for such an error, else compute it.

        Its fingerprint is its first step.
        """
        witness = next(iter(reference_run(bind(spec, size), self.solver, 1, [1])[0].values())).positions
        stored: dict[str, Any] = dict(_read(path)) if path.exists() else {}
        known = bool(stored) and agree(stored.pop("witness"), witness)
        if known and float(stored.pop("error")) <= error:
            plain = {key: stored.pop(key).item() for key in ("step", "moved_last")}
            found = SelfConverged(**stored, **plain)
        else:
            found = converge(lambda h, name: bind(spec.stepped(h), size, name), spec.time_step, times, error)
            arrays = {f.name: np.asarray(getattr(found, f.name)) for f in fields(SelfConverged)}
            _write(path, arrays | {"witness": witness, "error": np.asarray(error)})
        found.require(error)
        return found

    def _known(self, asked: _Asked, frames: Iterable[int]) -> dict[int, Frozen]:
        """Load those of the snapshots that are on disk and match the present scene."""
        paths = [path for path in (self._problem(asked, frame) for frame in frames) if path.exists()]
        thawed = [thaw(_read(path), asked.scene) for path in paths]
        return {one.frame: one for one in thawed if one}

    def _problem(self, asked: _Asked, frame: int) -> Path:
        return self.folder / f"problem-{asked.name}-{frame}.npz"

    def _keep(self, asked: _Asked, steps: dict[int, Step]) -> dict[int, Frozen]:
        kept: dict[int, Frozen] = {}
        for frame, step in steps.items():
            kept[frame], arrays = freeze(step, asked.name)
            _write(self._problem(asked, frame), arrays)
        return kept

    def _remember(self, frozen: Frozen, known: KnownMinima) -> None:
        arrays = {name: np.array([getattr(minimum, name) for minimum in known.minima]) for name in _CERTIFICATE}
        _write(self.folder / f"minima-{frozen.digest}.npz", arrays)


class _Asked:
    """A scene of one size with one integrator, and its name in file names."""

    def __init__(self, spec: SceneSpec, size: int, integrator: IntegratorName) -> None:
        self.scene: Scene = bind(spec, size, integrator)
        self.name = f"{spec.digest[:12]}-{size}-{integrator}"


def _named(spec: SceneSpec, size: int, times: Sequence[float]) -> str:
    """Return the part of a file name that identifies a motion.

    It consists of the scene without its step size, its size, and the times.
    """
    return f"{spec.stepped(1.0).digest[:12]}-{size}-{'-'.join(f'{t:.9g}' for t in times)}"


def _minima(arrays: Arrays) -> KnownMinima:
    numbers = (arrays[name].tolist() for name in ("g", "error", "smallest_eigenvalue", "doubt"))
    columns = zip(arrays["positions"], *numbers, arrays["near"], strict=True)
    return KnownMinima(tuple(Minimum(*values, kind=MINIMUM) for values in columns))


def _read(path: Path) -> Arrays:
    with np.load(path, allow_pickle=False) as stored:
        arrays = dict(stored)
    for array in arrays.values():
        array.flags.writeable = False
    return arrays


def _write(path: Path, arrays: Arrays) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as partial:
        np.savez(partial, allow_pickle=False, **arrays)
