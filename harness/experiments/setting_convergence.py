"""Convergence of a given setting: substeps and iterations by powers of two around it, compared with a reference.

    error   = max_k |p(t_k) - q(t_k)| / max_k |q(t_k) - p(0)|         q: reference, Frobenius norms over free vertices
    change  = the same of two settings: how much the motion changes where one of the two numbers is doubled
    drift   = (E(T) - E_q(T)) / max_k kinetic energy of q             E: kinetic energy and potentials

A frame is a time step of the scene. A setting divides it into substeps, each with a number of iterations: for a solver
of ours the substep is its time step, for an outside engine both are its own. Solvers that choose steps or have no
iterations get a row of settings. The reference is that of accuracy studies: an independent integration, or with contact
a self-converged motion; where there is none, it is the finest setting.

Effective stiffness: the mesh is hung by its highest vertices along its longest side, with its own material and a drag
that lets it come to rest. The ratio of the true sag to that of the setting is how stiff the material seems: unconverged
constraints give way, and unconverged descent does not reach its sag in time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields, replace
from math import inf, isfinite
from time import monotonic, process_time
from typing import Any

import numpy as np
from numpy.typing import NDArray
from springbench.harness.config.sweep_config import SolverSpec
from springbench.harness.errors import InputError, InputMistake, RunFailed
from springbench.harness.execution import machine_info
from springbench.harness.experiments.accuracy.method_recommendation import find_engine_integrator
from springbench.harness.recording.strain_shading import compute_strains
from springbench.harness.reference.reference_store import ReferenceStore
from springbench.harness.reference.reference_trajectory import ReferenceTrajectory
from springbench.harness.reference.step_snapshot import build_exact_scene
from springbench.harness.results.setting_verdict import (
    ERROR_LEVELS,
    ConvergenceStudy,
    SettingResult,
    StepSetting,
    describe_percent,
    list_settings,
)
from springbench.harness.scenes.effects.bending_effect import BendingEffect
from springbench.harness.scenes.effects.ether_drag_effect import EtherDragEffect
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.effects.strain_limits_effect import StrainLimitsEffect
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.scenes.scene_spec import SceneSpec
from springbench.harness.simulation.energy_balance import compute_kinetic_energy
from springbench.harness.simulation.time_loop import build_initial_state, prepare, simulate_scene
from springbench.solvers.model.step_problem import NotPositiveDefinite, Positions, StopRule, Unsupported, is_lagged
from springbench.solvers.registry import SOLVER_TABLE, SOLVERS, find_solver_info, is_engine, load_target

NUM_SAMPLES = 8
"""Number of times at which motions are compared."""

MATERIAL_EFFECTS = (SpringsEffect, BendingEffect, StrainLimitsEffect)
"""Effects that belong to the material, which hangs with them."""

HANG_SECONDS, HANG_DECAY = 1.0, 5.0
"""Time for which the mesh hangs [s], and the decay rate of its velocity [1/s]: swings fade to a tenth."""

TRUE_SOLVER = "hybrid"
"""Solver of the true sag, to its tolerance."""

_TRUE_STOP_RULE = StopRule(300, 1e-8)
_TOP_RTOL = 1e-6


class SettingSimulator:
    """Simulates a scene by a solver at settings, and compares with a reference."""

    def __init__(self, spec: SceneSpec, size: int, solver: SolverSpec, integrator: str | None, t_end: float) -> None:
        """Prepare a solver for a scene.

        Args:
          spec: scene whose time step is a frame.
          size: mesh size.
          solver: solver or engine with its parameters.
          integrator: name of the integrator; the usual one of the solver if None.
          t_end: simulated time [s], at least a frame.
        """
        self.spec, self.size, self.name = spec, size, solver.name
        self.solver = load_target(SOLVER_TABLE[solver.name])(**solver.parameters)
        info = find_solver_info(self.solver, solver.name)
        self.is_engine = is_engine(self.solver)
        own = info.is_substepping and info.supports_error_control
        usual = find_engine_integrator(self.solver) if self.is_engine else "substepping" if own else "implicit-euler"
        self.integrator = integrator or usual
        names = [one.name for one in fields(self.solver)]
        self.has_iterations = "iterations_per_substep" in names if self.is_engine else not own
        self.num_frames = max(1, round(t_end / spec.time_step))
        count = min(NUM_SAMPLES, self.num_frames)
        self.sample_frames = sorted({round(self.num_frames * (k + 1) / count) for k in range(count)})

    @property
    def sample_times(self) -> list[float]:
        """Times [s] at which motions are compared."""
        return [frame * self.spec.time_step for frame in self.sample_frames]

    def build_step(self, spec: SceneSpec, setting: StepSetting) -> tuple[Scene, Any, StopRule, int]:
        """Return the scene of a setting, its solver, its stop rule, and the number of steps of a frame."""
        if self.is_engine:
            own = {"iterations_per_substep": setting.iterations} if self.has_iterations else {}
            scene = build_exact_scene(spec, self.size, self.integrator, show_warnings=False)
            return scene, replace(self.solver, **own), StopRule(setting.substeps), 1
        step = spec.time_step / setting.substeps
        scene = build_exact_scene(spec.with_time_step(step), self.size, self.integrator, show_warnings=False)
        return scene, self.solver, StopRule(setting.iterations), setting.substeps

    def simulate_setting(
        self, setting: StepSetting, reference: SampledReference | None, time_limit: float
    ) -> SettingResult:
        """Simulate a setting and measure its error; a failure becomes a reason.

        Args:
          setting: substeps and iterations.
          reference: reference; without one, errors and drift are NaN.
          time_limit: wall time [s].
        """
        try:
            scene, solver, stop, pieces = self.build_step(self.spec, setting)
            samples, strains, seconds, velocity = self._step_frames(scene, solver, stop, pieces, time_limit)
        except (Unsupported, NotPositiveDefinite, RunFailed, RuntimeError, ArithmeticError, InputError) as error:
            return SettingResult(setting, reason=str(error) or type(error).__name__)
        positions, error, drift = np.array(samples), np.nan, np.nan
        if reference is not None:
            error = reference.measure_distance(positions)
            drift = reference.measure_drift(scene, positions[-1], velocity)
        return SettingResult(setting, error, max(strains), drift, float(np.median(seconds)), "", positions)

    def _step_frames(
        self, scene: Scene, solver: Any, stop: StopRule, pieces: int, time_limit: float
    ) -> tuple[list[Positions], list[float], list[float], Positions]:
        """Simulate all frames; return sampled positions, strains and times of frames, and the last velocity."""
        prepared, guess = prepare(scene, solver), self.spec.choose_initial_guess(self.integrator)
        next(simulate_scene(scene, prepared, stop, initial_guess=guess, frames=1))  # compiles
        run = simulate_scene(scene, prepared, stop, initial_guess=guess, frames=pieces * self.num_frames)
        samples, strains, seconds = list[Positions](), list[float](), list[float]()
        springs, velocity, end = scene.all_springs, np.empty((0, 3)), monotonic() + time_limit
        for frame in range(1, self.num_frames + 1):
            began = process_time()
            for _ in range(pieces):
                step = next(run)
                p, velocity = step.state.motion
                if not np.isfinite(p).all() or np.abs(p).max() > 1e3 * _measure_scene_scale(scene):
                    raise RunFailed(f"diverged in frame {frame}")
            seconds.append(process_time() - began)
            p = step.positions  # pyright: ignore[reportPossiblyUnboundVariable]
            strains.append(float(np.abs(compute_strains(p, springs.edges, springs.rest_length)[0]).max(initial=0.0)))
            if frame in self.sample_frames:
                samples.append(p.copy())
            if monotonic() > end and frame < self.num_frames:
                raise RunFailed(f"the limit of {time_limit:g} s was reached in frame {frame} of {self.num_frames}")
        return samples, strains, seconds, velocity

    def measure_sag(self, setting: StepSetting | None) -> float:
        """Return the sag of the hung mesh [m], by a setting, or the true one."""
        hung, axis, bottom = build_hanging_scene(self.spec, self.size)
        frames = max(1, round(HANG_SECONDS / hung.time_step))
        if setting is None:
            scene = build_exact_scene(hung, self.size, show_warnings=False)
            solver, stop, pieces = load_target(SOLVERS[TRUE_SOLVER])(), _TRUE_STOP_RULE, 1
        else:
            scene, solver, stop, pieces = self.build_step(hung, setting)
        run = simulate_scene(scene, prepare(scene, solver), stop, initial_guess="previous", frames=frames * pieces)
        p = scene.mesh.rest_positions
        for step in run:
            p = step.positions
        return float(np.mean((scene.mesh.rest_positions - p)[bottom, axis]))


@dataclass(frozen=True, slots=True, eq=False)
class SampledReference:
    """Reference at the times at which motions are compared.

    Attributes:
      description: what it is, in words.
      free_vertices: indices of the vertices that are not pinned.
      start: positions (n, 3) [m] at the start.
      positions: positions (k, n, 3) [m].
      end_energy: energy at the end [J]; None where velocities are unknown.
      kinetic_scale: largest kinetic energy at these times [J].
    """

    description: str
    free_vertices: NDArray[np.int64]
    start: Positions
    positions: Positions
    end_energy: float | None
    kinetic_scale: float

    @classmethod
    def from_trajectory(cls, scene: Scene, trajectory: ReferenceTrajectory) -> SampledReference:
        """Sample a reference trajectory of a scene."""
        kinetic = [_kinetic_energy(scene, v) for v in trajectory.velocities]
        energy = _compute_energy(scene, trajectory.positions[-1], trajectory.velocities[-1])
        words = f"the {trajectory.reference_kind} motion"
        start = build_initial_state(scene).motion.positions
        return cls(words, trajectory.free_vertices, start, trajectory.positions, energy, max(kinetic))

    def measure_distance(self, positions: Positions) -> float:
        """Return the largest distance (k, n, 3) from the reference, relative to its largest displacement."""
        return measure_change(positions, self.positions, self.start, self.free_vertices)

    def measure_drift(self, scene: Scene, p: Positions, v: Positions) -> float:
        """Return the difference of the energy at the end, over the largest kinetic energy; NaN if unknown."""
        if self.end_energy is None or not self.kinetic_scale:
            return float("nan")
        return (_compute_energy(scene, p, v) - self.end_energy) / self.kinetic_scale


def measure_change(p: Positions, q: Positions, start: Positions, free_vertices: NDArray[np.int64]) -> float:
    """Return max_k |p_k - q_k| / max_k |q_k - start|.

    Args:
      p, q: positions of two motions at the same times (k, n, 3) [m].
      start: positions at the start (n, 3) [m].
      free_vertices: vertices that count.
    """
    apart, moved = ((x - y)[:, free_vertices].reshape(len(q), -1) for x, y in ((p, q), (q, start[None])))
    largest = float(np.linalg.norm(moved, axis=1).max(initial=0.0))
    return float(np.linalg.norm(apart, axis=1).max(initial=0.0)) / largest if largest else inf


def study_convergence(
    simulator: SettingSimulator,
    given: StepSetting,
    store: ReferenceStore,
    error_requested: float,
    *,
    num_doublings: int,
    time_limit: float,
    search_time: float,
    print_message: Callable[[str], None],
) -> ConvergenceStudy:
    """Simulate the settings around a given one, and compare them with the reference.

    Args:
      simulator: scene and solver.
      given: the given setting.
      store: store of references.
      error_requested: relative error that counts as converged.
      num_doublings: how often each number is doubled and halved.
      time_limit: wall time of a setting [s].
      search_time: wall time after which no further setting starts [s].
      print_message: prints a remark.

    Raises:
      RunFailed: the given setting failed.
    """
    with machine_info.limit_threads(1):
        reference = _find_reference(simulator, store, error_requested, print_message)
        settings = list_settings(given, num_doublings, has_iterations=simulator.has_iterations)
        settings.sort(key=lambda setting: setting != given)  # the given one first: what it cannot do ends the study
        results, end = list[SettingResult](), monotonic() + search_time
        for k, setting in enumerate(settings):
            if monotonic() > end and k:
                results.append(SettingResult(setting, reason="the time for the search was used up"))
                continue
            result = simulator.simulate_setting(setting, reference, time_limit)
            if setting == given and result.reason and "diverged" not in result.reason:
                raise RunFailed(f"{simulator.name} {given}: {result.reason}")
            results.append(result)
            words = result.reason or f"{1e3 * result.frame_seconds:.3g} ms a frame"
            error = f", error {describe_percent(result.error)}" if isfinite(result.error) else ""
            print_message(f"[{k + 1}/{len(settings)}] {setting}: {words}{error}")
        if reference is None:
            reference, results = _compare_with_finest(simulator, results)
        substeps, iterations = (
            _measure_doubling(results, given, twice, reference)
            for twice in (given._replace(substeps=2 * given.substeps), given._replace(iterations=2 * given.iterations))
        )
        stiffness = _measure_stiffness(simulator, given, print_message)
    results.sort(key=lambda result: result.setting)
    return ConvergenceStudy(
        simulator.name,
        given,
        error_requested,
        reference.description,
        tuple(results),
        substeps,
        iterations if simulator.has_iterations else None,
        stiffness,
    )


def build_hanging_scene(spec: SceneSpec, size: int) -> tuple[SceneSpec, int, NDArray[np.bool_]]:
    """Build the scene that hangs a mesh by one end of its longest side.

    Args:
      spec: scene with the mesh and its material.
      size: mesh size.

    Returns:
      The scene, the axis along which it hangs, and a mask of its lowest vertices (n,).
    """
    rest = spec.mesh.build_mesh(size).rest_positions
    axis = int(np.argmax(np.ptp(rest, axis=0)))
    reach = _TOP_RTOL * float(np.ptp(rest, axis=0).max())
    top, bottom = rest[:, axis] >= rest[:, axis].max() - reach, rest[:, axis] <= rest[:, axis].min() + reach
    strength = next((np.linalg.norm(e.acceleration) for e in spec.effects if isinstance(e, GravityEffect)), 9.81)
    gravity = tuple(-float(strength) if k == axis else 0.0 for k in range(3))
    material = [k for k, effect in enumerate(spec.effects) if isinstance(effect, MATERIAL_EFFECTS)]
    changes = spec.keep_effects(material)
    changes["effects"] = (
        *changes["effects"],
        GravityEffect.model_validate({"acceleration": gravity}),
        EtherDragEffect(decay_rate=HANG_DECAY),
        PinsEffect.model_validate({"indices": np.flatnonzero(top).tolist(), "weight": "exact"}),
    )
    values = {key: getattr(spec, key) for key in SceneSpec.model_fields}
    return (
        SceneSpec.model_construct(None, **values | changes | {"start": None, "velocity": (0.0, 0.0, 0.0)}),
        axis,
        bottom,
    )


def _find_reference(
    simulator: SettingSimulator, store: ReferenceStore, error: float, print_message: Callable[[str], None]
) -> SampledReference | None:
    """Return the reference of the motion; None, with a message, where there is none."""
    scene = build_exact_scene(simulator.spec, simulator.size, show_warnings=False)
    print_message(f"the reference first, the motion up to {simulator.sample_times[-1]:g} s, which is made once")
    try:
        times = simulator.sample_times
        smallest = min(error, *ERROR_LEVELS)
        trajectory = store.load_trajectory(simulator.spec, simulator.size, times, error=smallest)
    except RunFailed as failed:
        print_message(f"there is no reference, so that settings are compared with the finest one: {failed}")
        return None
    return SampledReference.from_trajectory(scene, trajectory)


def _compare_with_finest(
    simulator: SettingSimulator, results: Sequence[SettingResult]
) -> tuple[SampledReference, list[SettingResult]]:
    """Return the finest setting as reference, and the results with their errors against it; its own is unknown."""
    fine = max((result for result in results if not result.reason), key=_number_of_iterations, default=None)
    if fine is None:
        raise RunFailed("all settings failed, and there is no reference")
    scene = build_exact_scene(simulator.spec, simulator.size, show_warnings=False)
    start = build_initial_state(scene).motion.positions
    words = f"the finest setting, {fine.setting}, for there is no reference"
    reference = SampledReference(words, scene.system.free_vertices, start, fine.positions, None, 0.0)
    errors = (inf if one.reason or one is fine else reference.measure_distance(one.positions) for one in results)
    return reference, [replace(one, error=error) for one, error in zip(results, errors, strict=True)]


def _number_of_iterations(result: SettingResult) -> tuple[int, int]:
    return result.setting.substeps * result.setting.iterations, result.setting.substeps


def _measure_doubling(
    results: Iterable[SettingResult], given: StepSetting, twice: StepSetting, reference: SampledReference
) -> float | None:
    """Return the change of the motion between two settings; None if one of them has none."""
    known = {result.setting: result for result in results if not result.reason}
    if given not in known or twice not in known:
        return None
    p, q = known[given].positions, known[twice].positions
    return measure_change(p, q, reference.start, reference.free_vertices)


def _measure_stiffness(
    simulator: SettingSimulator, given: StepSetting, print_message: Callable[[str], None]
) -> float | None:
    """Return the ratio of the true sag to that of a setting; None, with a message, where it cannot be measured."""
    try:
        true, seen = simulator.measure_sag(None), simulator.measure_sag(given)
    except (Unsupported, NotPositiveDefinite, RunFailed, RuntimeError, ArithmeticError, InputError) as error:
        print_message(f"the effective stiffness could not be measured: {error}")
        return None
    return true / seen if true > 0.0 and seen > 0.0 and isfinite(seen) else None


def _compute_energy(scene: Scene, p: Positions, v: Positions) -> float:
    """Return kinetic energy and potentials [J] of energies that depend on positions only, and of constant loads."""
    stored = sum(energy.value(p) for energy in scene.system.energies if not is_lagged(energy))
    return _kinetic_energy(scene, v) + stored - float(np.einsum("ij,ij->", scene.constant_force, p))


def _kinetic_energy(scene: Scene, v: Positions) -> float:
    free = scene.system.free_vertices
    return compute_kinetic_energy(scene.system.mass[free], v[free])


def _measure_scene_scale(scene: Scene) -> float:
    """Return a length [m] of the scale of a scene; coordinates a thousand times as large mean divergence."""
    return 1.0 + float(np.abs(scene.mesh.rest_positions).max()) + scene.mesh.bounding_box_diagonal


def require_setting(substeps: int, iterations: int) -> StepSetting:
    """Return a setting; raise InputError if a number is not positive."""
    for name, value in (("--substeps", substeps), ("--iterations", iterations)):
        if value < 1:
            raise InputError(InputMistake(f"came {value}; expected a whole number above 0", key=name))
    return StepSetting(substeps, iterations)
