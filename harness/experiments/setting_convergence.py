"""Convergence of given settings: substeps and iterations around them, compared with a reference.

    error   = max_k |p(t_k) - q(t_k)| / max_k |q(t_k) - p(0)|         q: reference, Frobenius norms over free vertices
    change  = the same of two settings: how much the motion changes where one of the two numbers is doubled
    drift   = (E(T) - E_q(T)) / max_k kinetic energy of q             E: kinetic energy and potentials

A frame is a time step of the scene. A setting divides it into substeps, each with a number of iterations: for a solver
of this package the substep is its time step; an outside engine takes the substeps itself. For solvers without
iterations in a substep, the settings differ in the number of substeps only. The reference is that of accuracy studies:
an independent integration, or with contact a self-converged motion, up to the time until which it is known accurately
enough. A scene without equations of motion is compared with the finest setting.

Effective stiffness: the mesh is hung by its highest vertices along its longest side, with its own material and a drag
that lets it come to rest. The ratio of the true sag to that of the setting is how stiff the material seems: unconverged
constraints yield, and unconverged descent does not reach its sag in time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from math import inf, isfinite
from time import monotonic, process_time
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.harness.config.sweep_config import SolverSpec
from springbench.harness.errors import InputError, InputMistake, RunFailed
from springbench.harness.execution import machine_info
from springbench.harness.experiments.accuracy.candidate_grids import find_engine_integrator
from springbench.harness.reference.equations_of_motion import NotIntegrable
from springbench.harness.reference.reference_store import ReferenceStore
from springbench.harness.reference.reference_trajectory import REFERENCE_MARGIN, ReferenceTrajectory
from springbench.harness.reference.self_converged_trajectory import (
    CONTACT_MARGIN,
    describe_self_convergence,
    has_contact,
)
from springbench.harness.reference.step_snapshot import build_exact_scene
from springbench.harness.results.setting_verdict import (
    ERROR_LEVELS,
    ConvergenceStudy,
    SettingAssessment,
    SettingChange,
    SettingResult,
    StepSetting,
    describe_percent,
    find_doubled,
    find_largest_difference,
    list_settings,
)
from springbench.harness.scenes.effects.bending_effect import BendingEffect
from springbench.harness.scenes.effects.effect_interface import SceneEffect
from springbench.harness.scenes.effects.ether_drag_effect import EtherDragEffect
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.effects.strain_limits_effect import StrainLimitsEffect
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.harness.scenes.orthotropic_cloth import OrthotropicStiffness
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.scenes.scene_spec import MeshSource, SceneSpec
from springbench.harness.scenes.spring_strains import compute_strains
from springbench.harness.simulation.energy_balance import compute_kinetic_energy
from springbench.harness.simulation.time_loop import build_initial_state, prepare, simulate_scene
from springbench.solvers.model.step_problem import NotPositiveDefinite, Positions, StopRule, Unsupported, is_lagged
from springbench.solvers.registry import SOLVER_TABLE, SOLVERS, find_solver_info, is_engine, load_target

DEFAULT_ITERATIONS = 50
"""Iterations of a substep where no setting is given."""

NUM_SAMPLES = 8
"""Number of times at which motions are compared."""

MATERIAL_EFFECTS = (SpringsEffect, BendingEffect, StrainLimitsEffect)
"""Effects that belong to the material: the hung mesh has them, too."""

HANG_SECONDS, HANG_DECAY = 1.0, 5.0
"""Time for which the mesh hangs [s], and the decay rate of its velocity [1/s]: swings fade to a tenth."""

TRUE_SOLVER = "hybrid"
"""Solver of the true sag, by _TRUE_STOP_RULE."""

_PROJECTION_FRAMES, _PROJECTION_MARGIN = 3, 1.3
"""Frames after which the time of a simulation is projected, and how far that may exceed the limit."""

_TRUE_STOP_RULE = StopRule(300, 1e-8)
_TOP_RTOL = 1e-6
"""Height difference up to which vertices belong to the top or the bottom, relative to the height of the mesh."""


def has_iterations_in_substep(solver: Any, name: str) -> bool:
    """Return whether a solver or engine iterates within a substep.

    A setting then has two numbers.

    Args:
        solver: solver or engine.
        name: its name in the registry.
    """
    info = find_solver_info(solver, name)
    if is_engine(solver):
        return "iterations_per_substep" in [one.name for one in fields(solver)]
    return not (info.is_substepping and info.supports_error_control)


def complete_settings(settings: Sequence[StepSetting], solver: SolverSpec) -> list[StepSetting]:
    """Return the given settings without repetitions, or the default one of a solver.

    Args:
        settings: given settings; 0 iterations where none were given.
        solver: solver or engine with its parameters.

    Raises:
        InputError: a setting has iterations, and the solver has none; or vice versa.
    """
    iterates = has_iterations_in_substep(load_target(SOLVER_TABLE[solver.name])(**solver.parameters), solver.name)
    for one in settings:
        if bool(one.iterations) != iterates:
            there = "iterates within a substep" if iterates else "has no iterations within a substep"
            expected = f"{one.substeps}x10" if iterates else str(one.substeps)
            raise InputError(
                InputMistake(f"got {one}; {solver.name} {there}: expected such as {expected}", key="--setting")
            )
    return list(dict.fromkeys(settings)) or [StepSetting(1, DEFAULT_ITERATIONS if iterates else 0)]


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
        self.has_iterations = has_iterations_in_substep(self.solver, solver.name)
        self.num_frames = max(1, round(t_end / spec.time_step))
        count = min(NUM_SAMPLES, self.num_frames)
        self.sample_frames = sorted({round(self.num_frames * (k + 1) / count) for k in range(count)})

    def shorten_motion(self, num_samples: int) -> None:
        """Shorten the motion to its first sampled times.

        Args:
            num_samples: number of these times, at least 1.
        """
        self.sample_frames = self.sample_frames[:num_samples]
        self.num_frames = self.sample_frames[-1]

    @property
    def sample_times(self) -> list[float]:
        """Times [s] at which motions are compared."""
        return [frame * self.spec.time_step for frame in self.sample_frames]

    def build_step(self, spec: SceneSpec, setting: StepSetting) -> tuple[Scene, Any, StopRule, int]:
        """Build the scene, the solver and the stop rule that simulate a setting.

        Args:
            spec: scene whose time step is a frame.
            setting: substeps of a frame, and iterations of a substep.

        Returns:
            Scene of the setting, its solver, its stop rule, and the number of steps of a frame, which is 1 for an
            engine: it takes the substeps itself.
        """
        if self.is_engine:
            own = {"iterations_per_substep": setting.iterations} if self.has_iterations else {}
            scene = build_exact_scene(spec, self.size, self.integrator, show_warnings=False)
            return scene, replace(self.solver, **own), StopRule(setting.substeps), 1
        step = spec.time_step / setting.substeps
        scene = build_exact_scene(spec.with_time_step(step), self.size, self.integrator, show_warnings=False)
        return scene, self.solver, StopRule(max(1, setting.iterations)), setting.substeps

    def simulate_setting(
        self, setting: StepSetting, reference: SampledReference | None, time_limit: float
    ) -> SettingResult:
        """Simulate a setting and measure its error; a failure becomes a reason.

        Args:
            setting: substeps and iterations.
            reference: reference; without one, errors and drift are NaN.
            time_limit: processor time [s].
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
        springs, velocity, started = scene.all_springs, np.empty((0, 3)), process_time()
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
            used = process_time() - started
            projected = used * self.num_frames / frame  # known after a few frames, so that little time is wasted
            if used > time_limit or (frame > _PROJECTION_FRAMES and projected > _PROJECTION_MARGIN * time_limit):
                raise RunFailed(f"exceeds the time limit of {time_limit:g} s")
        return samples, strains, seconds, velocity

    def measure_sag(self, setting: StepSetting | None) -> float:
        """Return the sag of the hung mesh [m].

        Args:
            setting: substeps and iterations; None for the true sag.
        """
        hung, bottom = build_hanging_scene(self.spec, self.size)
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
        return float(np.mean((scene.mesh.rest_positions - p)[bottom, 1]))


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
        min_error: smallest relative error that can be measured against it.
    """

    description: str
    free_vertices: NDArray[np.int64]
    start: Positions
    positions: Positions
    end_energy: float | None
    kinetic_scale: float
    min_error: float

    @classmethod
    def from_trajectory(cls, scene: Scene, trajectory: ReferenceTrajectory) -> SampledReference:
        """Sample a reference trajectory of a scene.

        Args:
            scene: scene of the trajectory, whose energy is evaluated.
            trajectory: reference at the times at which motions are compared.
        """
        kinetic = [_kinetic_energy(scene, v) for v in trajectory.velocities]
        energy = _compute_mechanical_energy(scene, trajectory.positions[-1], trajectory.velocities[-1])
        uncertainty = float(trajectory.disagreement.max())
        words = f"the {trajectory.reference_kind} motion"
        words += f" (known to {describe_percent(uncertainty)})" if has_contact(scene.system) else ""
        start = build_initial_state(scene).motion.positions
        smallest = uncertainty / (CONTACT_MARGIN if has_contact(scene.system) else REFERENCE_MARGIN)
        return cls(words, trajectory.free_vertices, start, trajectory.positions, energy, max(kinetic), smallest)

    def measure_distance(self, positions: Positions) -> float:
        """Return the largest distance from the reference, relative to its largest displacement.

        Args:
            positions: positions at the times of the reference (k, n, 3) [m].
        """
        return self.measure_change(positions, self.positions)

    def measure_change(self, p: Positions, q: Positions) -> float:
        """Return the largest distance of two motions, relative to the largest displacement of q.

        Args:
            p, q: positions at the times of the reference (k, n, 3) [m].
        """
        return measure_change(p, q, self.start, self.free_vertices)

    def measure_drift(self, scene: Scene, p: Positions, v: Positions) -> float:
        """Return the error of the energy at the end, over the largest kinetic energy.

        Args:
            scene: scene whose energy is evaluated.
            p: positions at the end (n, 3) [m].
            v: velocities at the end (n, 3) [m/s].

        Returns:
            Signed ratio; NaN if the energy of the reference is unknown, or if the reference does not move.
        """
        if self.end_energy is None or not self.kinetic_scale:
            return float("nan")
        return (_compute_mechanical_energy(scene, p, v) - self.end_energy) / self.kinetic_scale


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
    given: Sequence[StepSetting],
    store: ReferenceStore,
    error_requested: float,
    *,
    num_doublings: int,
    limits: StudyLimits,
    print_message: Callable[[str], None],
) -> ConvergenceStudy:
    """Simulate the settings around given ones, and compare them with the reference.

    Args:
        simulator: scene and solver.
        given: the given settings, at least one.
        store: store of references.
        error_requested: relative error that counts as converged.
        num_doublings: how often numbers are doubled and halved.
        limits: limits of times.
        print_message: prints a remark.

    Returns:
        Results of all settings, and assessments of the given ones.

    Raises:
        RunFailed: the motion is unpredictable, or a given setting is not supported.
    """
    with machine_info.limit_threads(1):
        _require_support(simulator, given)
        reference = _find_reference(simulator, store, error_requested, limits, print_message)
        settings = _order_settings(list_settings(given, num_doublings), given)
        results, end, iteration_seconds = list[SettingResult](), monotonic() + limits.search_time, 0.0
        for k, setting in enumerate(settings):
            began = monotonic()
            if began + iteration_seconds * setting.total_iterations > end and setting not in given:
                results.append(SettingResult(setting, reason="no time left"))
                continue
            result = simulator.simulate_setting(setting, reference, limits.time_limit)
            if setting in given and result.reason and "diverged" not in result.reason:
                raise RunFailed(f"{simulator.name}, {setting}: {result.reason}")
            results.append(result)
            if not result.reason:
                iteration_seconds = (monotonic() - began) / setting.total_iterations
            words = result.reason or f"{1e3 * result.frame_seconds:.3g} ms a frame"
            error = f", error {describe_percent(result.error)}" if isfinite(result.error) else ""
            print_message(f"[{k + 1}/{len(settings)}] {setting}: {words}{error}")
        if reference is None:
            reference, results = _compare_with_finest(simulator, results)
        assessments = _assess_settings(simulator, given, results, reference, print_message)
    results.sort(key=lambda result: result.setting)
    return ConvergenceStudy(
        simulator.name,
        error_requested,
        reference.description,
        tuple(results),
        assessments,
        find_largest_difference([one for one in results if one.setting in given], reference.measure_change),
        reference.min_error,
    )


def _require_support(simulator: SettingSimulator, given: Sequence[StepSetting]) -> None:
    """Raise RunFailed where a given setting is not supported, before the reference is made."""
    for one in given:
        try:
            scene, solver, *_ = simulator.build_step(simulator.spec, one)
            prepare(scene, solver)
        except (Unsupported, NotPositiveDefinite) as error:
            raise RunFailed(f"{simulator.name}, {one}: {error}") from None


class StudyLimits(NamedTuple):
    """Limits of times of a study.

    Attributes:
        time_limit: processor time of a setting [s].
        search_time: wall time after which no further setting starts [s].
        growth_end: time [s] up to which the growth of perturbations is known; None for that of the motion.
        is_end_given: whether the end of the motion was requested, so that it must not be shortened.
    """

    time_limit: float
    search_time: float
    growth_end: float | None = None
    is_end_given: bool = True


def _order_settings(settings: Sequence[StepSetting], given: Sequence[StepSetting]) -> list[StepSetting]:
    """Order settings: the given ones, those with a doubled number, and the others.

    The given ones are first, because a failure of one ends the study.
    """
    doubled = [find_doubled(settings, one, name) for one in given for name in ("substeps", "iterations")]
    return list(dict.fromkeys([*given, *filter(None, doubled), *settings]))


def _assess_settings(
    simulator: SettingSimulator,
    given: Sequence[StepSetting],
    results: Sequence[SettingResult],
    reference: SampledReference,
    print_message: Callable[[str], None],
) -> tuple[SettingAssessment, ...]:
    """Assess the given settings.

    An assessment states what changes with more substeps or iterations, and how stiff the material seems.
    """
    known = {result.setting: result for result in results if not result.reason}

    def change(one: StepSetting, name: str) -> SettingChange | None:
        more = find_doubled(known, one, name)
        if one not in known or more is None:
            return None
        distance = reference.measure_change(known[one].positions, known[more].positions)
        return SettingChange(getattr(more, name) / getattr(one, name), distance)

    stiffness = _measure_stiffness(simulator, [one for one in given if one in known], print_message)
    return tuple(
        SettingAssessment(one, change(one, "substeps"), change(one, "iterations"), stiffness.get(one)) for one in given
    )


def build_hanging_scene(spec: SceneSpec, size: int) -> tuple[SceneSpec, NDArray[np.bool_]]:
    """Build the scene that hangs a mesh by one end of its longest side.

    That side is turned upright.

    Args:
        spec: scene with the mesh and its material.
        size: mesh size.

    Returns:
        The scene, and a mask of its lowest vertices (n,).
    """
    axis = int(np.argmax(np.ptp(spec.mesh.build_mesh(size).rest_positions, axis=0)))
    mesh = _UprightMesh(spec.mesh, axis)
    height = mesh.build_mesh(size).rest_positions[:, 1]
    reach = _TOP_RTOL * float(np.ptp(height))
    top, bottom = height >= height.max() - reach, height <= height.min() + reach
    strength = next((np.linalg.norm(e.acceleration) for e in spec.effects if isinstance(e, GravityEffect)), 9.81)
    material = [k for k, effect in enumerate(spec.effects) if isinstance(effect, MATERIAL_EFFECTS)]
    changes: dict[str, Any] = {
        "mesh": mesh,
        "start": None,
        "velocity": (0.0, 0.0, 0.0),
        **spec.select_effect_fields(material),
    }
    changes["effects"] = (
        *(_turn_upright(effect, axis) for effect in changes["effects"]),
        GravityEffect.model_validate({"acceleration": (0.0, -float(strength), 0.0)}),
        EtherDragEffect(decay_rate=HANG_DECAY),
        PinsEffect.model_validate({"indices": np.flatnonzero(top).tolist(), "weight": "exact"}),
    )
    values = {key: getattr(spec, key) for key in SceneSpec.model_fields}
    return SceneSpec.model_construct(None, **values | changes), bottom


def _turn_upright(effect: SceneEffect, axis: int) -> SceneEffect:
    """Return an effect with its warp direction turned as the axes of `_UprightMesh`."""
    if not (isinstance(effect, SpringsEffect) and isinstance(effect.stretch, OrthotropicStiffness)):
        return effect
    direction = tuple(np.roll(effect.stretch.direction, 1 - axis).tolist())
    return effect.model_copy(update={"stretch": effect.stretch.model_copy(update={"direction": direction})})


@dataclass(frozen=True, slots=True)
class _UprightMesh:
    """Mesh whose axes are exchanged in cyclic order, so that one becomes y."""

    source: MeshSource
    axis: int

    def build_mesh(self, size: int) -> Mesh:
        mesh = self.source.build_mesh(size)
        return replace(mesh, rest_positions=np.roll(mesh.rest_positions, 1 - self.axis, axis=1))


def _find_reference(
    simulator: SettingSimulator,
    store: ReferenceStore,
    error: float,
    limits: StudyLimits,
    print_message: Callable[[str], None],
) -> SampledReference | None:
    """Return the reference of the motion; None, with a message, if there is none.

    With contact, the simulated motion may be shortened to the time until which the reference is accurate enough.

    Raises:
        RunFailed: the motion is unpredictable.
    """
    spec, size, times = simulator.spec, simulator.size, simulator.sample_times
    scene = build_exact_scene(spec, size, show_warnings=False)
    smallest = min(error, *ERROR_LEVELS)
    print_message(f"computing the reference motion up to {times[-1]:g} s, once")
    if not has_contact(scene.system):
        try:
            seen = store.load_trajectory(spec, size, times, error=smallest, growth_end=limits.growth_end)
        except NotIntegrable as refused:
            print_message(f"settings are compared with the finest one, because there is no reference: {refused}")
            return None
        return SampledReference.from_trajectory(scene, seen)
    print_message(describe_self_convergence(spec.path.stem))
    trajectory = store.load_self_converged(spec, size, times, error=smallest)
    num_known = trajectory.count_known_times(CONTACT_MARGIN * error)
    if num_known < len(times):
        if not num_known:
            trajectory.require_accuracy(error)
        until = times[num_known - 1]
        if limits.is_end_given:
            raise RunFailed(
                f"with contact an error of {describe_percent(error)} can be measured up to {until:g} s; later the "
                f"self-converged motion is accurate only to {trajectory.disagreement.max():.1e} of the displacement; "
                f"use --t-end {until:g}, or a larger --error"
            )
        print_message(f"the comparison is limited to {until:g} s, up to which the reference is accurate enough")
        simulator.shorten_motion(num_known)
    return SampledReference.from_trajectory(scene, trajectory.select_times(slice(num_known)))


def _compare_with_finest(
    simulator: SettingSimulator, results: Sequence[SettingResult]
) -> tuple[SampledReference, list[SettingResult]]:
    """Return the finest setting as reference, and the results with their errors against it.

    The error of the finest setting itself is infinite, because it is unknown.
    """
    known = (result for result in results if not result.reason)
    fine = max(known, key=lambda one: (one.setting.total_iterations, one.setting), default=None)
    if fine is None:
        raise RunFailed("all settings failed, and there is no reference")
    scene = build_exact_scene(simulator.spec, simulator.size, show_warnings=False)
    start = build_initial_state(scene).motion.positions
    words = f"the finest setting, {fine.setting}, because there is no reference"
    reference = SampledReference(words, scene.system.free_vertices, start, fine.positions, None, 0.0, 0.0)
    errors = (inf if one.reason or one is fine else reference.measure_distance(one.positions) for one in results)
    return reference, [replace(one, error=error) for one, error in zip(results, errors, strict=True)]


def _measure_stiffness(
    simulator: SettingSimulator, settings: Sequence[StepSetting], print_message: Callable[[str], None]
) -> dict[StepSetting, float]:
    """Return the ratio of the true sag to that of each setting.

    The result is empty, with a message, where a sag cannot be measured.
    """
    if not settings:
        return {}
    try:
        true = simulator.measure_sag(None)
        sags = {setting: simulator.measure_sag(setting) for setting in settings}
    except (Unsupported, NotPositiveDefinite, RunFailed, RuntimeError, ArithmeticError, InputError) as error:
        print_message(f"the effective stiffness could not be measured: {error}")
        return {}
    return {setting: true / sag for setting, sag in sags.items() if true > 0.0 and sag > 0.0 and isfinite(sag)}


def _compute_mechanical_energy(scene: Scene, p: Positions, v: Positions) -> float:
    """Return the kinetic energy plus the potentials [J].

    Potentials are those of energies that depend on positions only, and of constant forces.
    """
    stored = sum(energy.value(p) for energy in scene.system.energies if not is_lagged(energy))
    return _kinetic_energy(scene, v) + stored - float(np.einsum("ij,ij->", scene.constant_force, p))


def _kinetic_energy(scene: Scene, v: Positions) -> float:
    free = scene.system.free_vertices
    return compute_kinetic_energy(scene.system.mass[free], v[free])


def _measure_scene_scale(scene: Scene) -> float:
    """Return a length [m] of the scale of a scene.

    Coordinates a thousand times as large mean divergence.
    """
    return 1.0 + float(np.abs(scene.mesh.rest_positions).max()) + scene.mesh.bounding_box_diagonal
