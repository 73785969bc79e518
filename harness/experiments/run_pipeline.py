"""Execute one run: specification, scene and solver, timed rounds, observed run with its recording, rows.

The timed passes come first and record nothing. Recording, energies and pictures come from an instrumentation pass. Its
final positions must be bitwise identical to the timed ones. The rows are written last: where they exist, the run is
complete.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Generator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from springbench.harness.config.sweep_config import RunSpec
from springbench.harness.errors import InputError, RunFailed
from springbench.harness.execution import machine_info
from springbench.harness.execution.timing_lock import (
    TimingSession,
    lock_timing_exclusive,
    lock_timing_shared,
    reserve_cores,
)
from springbench.harness.execution.worker_process import ProgressCallback
from springbench.harness.experiments.failure_columns import build_energy_growth_columns, build_failure_columns
from springbench.harness.experiments.machine_calibration import calibrate_machine
from springbench.harness.experiments.provenance import (
    ERROR_CONTROL_TARGET,
    build_run_columns,
    build_specification_columns,
    collect_source_parts,
    compute_source_fingerprint,
    convert_tolerance,
    load_solver_class,
)
from springbench.harness.experiments.sweep_plan import RunFiles
from springbench.harness.recording.recorder_interface import (
    FrameSamples,
    RecordedFrame,
    RecordingInfo,
    RunRecorder,
    list_obstacles,
)
from springbench.harness.recording.strain_shading import compute_strain_range
from springbench.harness.reference.gradient_check import measure_gradient_errors
from springbench.harness.reference.residual_audit import AuditedSolver
from springbench.harness.reference.step_verifier import StepVerifier, compute_reference_positions
from springbench.harness.results import parquet_rows
from springbench.harness.results.position_file import save_positions
from springbench.harness.results.quantities import compute_ms_per_step
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.scene_builder import Scene, build_scene
from springbench.harness.scenes.spring_stiffness import compute_modulus_exponent
from springbench.harness.simulation.auto_tolerance import build_stop_rule
from springbench.harness.simulation.device_stepping import build_device_columns
from springbench.harness.simulation.energy_balance import EnergyGrowth
from springbench.harness.simulation.instrumentation_pass import RunObservers, observe_run, require_finite
from springbench.harness.simulation.time_loop import prepare
from springbench.harness.simulation.timing_pass import (
    RunMeasurement,
    StepError,
    SteppingSettings,
    build_timing_rows,
    compute_milliseconds,
    hash_positions,
    measure_rows,
    prepare_untimed,
)
from springbench.solvers.jit import source_digest
from springbench.solvers.model.step_problem import Positions, Solver
from springbench.solvers.registry import SOLVERS, is_minimiser, load_target

if TYPE_CHECKING:
    from springbench.harness.recording.rerun_recorder import RerunRecorder


@dataclass(frozen=True, slots=True, eq=False)
class RunJob:
    """A run to execute, its files, and the callback that gets its progress.

    Attributes:
        run: specification of the run.
        files: paths of its files.
        tick: called with the name of the pass after each step.
        positions_path: where to store the positions after every step; None for not at all.
    """

    run: RunSpec
    files: RunFiles
    tick: ProgressCallback
    positions_path: Path | None


@dataclass(frozen=True, slots=True, eq=False)
class RunSetup:
    """Scene of a run, its solver, and the settings of its steps."""

    scene: Scene
    build_solver: Callable[[], Solver]
    settings: SteppingSettings

    @classmethod
    def from_run(cls, run: RunSpec) -> RunSetup:
        """Build the scene of a run and load its solver; errors of user code propagate."""
        scene = build_scene(run.scene, run.size, run.integrator)
        stop = build_stop_rule(run.max_iterations, run.rtol)
        settings = SteppingSettings(stop, run.initial_guess, run.frames, run.rounds)
        return cls(scene, partial(load_solver_class(run), **run.solver.parameters), settings)

    @property
    def is_minimiser(self) -> bool:
        """Whether the solver's iterates converge to a minimum."""
        return is_minimiser(self.build_solver())

    def observe_first_frames(self, count: int, recorder: RunRecorder | None = None) -> None:
        """Simulate the first frames again, with a new solver, and record them.

        Args:
            count: number of frames.
            recorder: recorder of the frames; None for none.

        Raises:
            StepError: a step failed, or the energy diverges.
        """
        observe_run(
            self.scene,
            prepare(self.scene, self.build_solver()),
            replace(self.settings, frames=count),
            RunObservers(recorder),
            lambda name: None,
        )


@dataclass(frozen=True, slots=True, eq=False)
class TimedRounds:
    """Times of a run.

    Attributes:
        measured: the measurement.
        rows: its rows; None without timed passes, where the rows are built after the instrumentation pass.
        columns: columns of the device and of the timing lock.
    """

    measured: RunMeasurement
    rows: list[dict[str, Any]] | None
    columns: dict[str, Any]


@dataclass(frozen=True, slots=True, eq=False)
class ObservedRun:
    """Results of the instrumentation pass: columns of each frame, and columns of the status."""

    columns_by_frame: dict[int, dict[str, Any]]
    status_columns: dict[str, str]


def execute_run(
    run: RunSpec,
    files: RunFiles,
    tick: ProgressCallback,
    *,
    positions: Path | None = None,
    num_concurrent_runs: int = 1,
) -> list[dict[str, Any]]:
    """Execute one run, write its files and return its rows.

    A failure is a row with status and reason.

    Args:
        run: specification of the run.
        files: paths of its files.
        tick: called with the name of the pass after each step.
        positions: where to store the positions after every step, (frames, n, 3) [m], float64; None for not at all.
        num_concurrent_runs: number of runs that may be timed concurrently.

    Raises:
        InputError: the input is invalid, and the run has no user code.
        WriteError: the files cannot be written; there are then no rows.
    """
    shared: dict[str, Any] = {"num_concurrent_runs": num_concurrent_runs, **calibrate_machine(tick)}
    threads = machine_info.choose_threads(run.threads)
    with machine_info.limit_threads(threads.count), TimingSession(tick, exclusive=run.timing == "exclusive") as session:
        with session.lock_for_preparation():
            shared |= build_run_columns(run) | {
                "source_fingerprint": compute_source_fingerprint(collect_source_parts(run))
            }
        try:
            run = run.replace_options(scene=run.scene.load_plugins())
            found = _run_passes(RunJob(run, files, tick, positions), session)
        except Exception as error:  # a solver may raise any exception; the row states it, and the sweep continues
            if isinstance(error, InputError) and not run.find_plugins():
                raise
            session.finish_timing()
            found = [_build_failure_row(RunJob(run, files, tick, positions), error)]
        if threads.reason:
            for row in found:
                row["solver_description"] = "; ".join(filter(None, [row.get("solver_description"), threads.reason]))
        result = [shared | row for row in found]
        content = parquet_rows.encode_rows(result)
    parquet_rows.write_durably(
        files.rows_path, content
    )  # waiting for the disk takes no CPU time, and disturbs no timed run
    return result


def _run_passes(job: RunJob, session: TimingSession) -> list[dict[str, Any]]:
    """Run all passes and return the rows.

    The session's priority for timing ends after the timed passes.
    """
    if job.run.error_target is not None:
        return _run_error_controlled(job, job.run.error_target, session)
    with session.lock_for_preparation():
        setup = RunSetup.from_run(job.run)
    timed = _time_rounds(job, setup)
    session.finish_timing()
    observed = _observe_run(job, setup, timed.measured)
    return _build_rows(job.run, setup, timed, observed)


def _time_rounds(job: RunJob, setup: RunSetup) -> TimedRounds:
    """Prepare the solver and time the rounds, under the timing lock of the run."""
    with _acquire_timing_lock(job.run, job.tick) as lock_columns:
        if job.run.timing == "none":
            measured, rows = prepare_untimed(setup.scene, setup.build_solver()), None
        else:
            measured, rows = measure_rows(setup.scene, setup.build_solver(), setup.settings, job.tick)
        return TimedRounds(measured, rows, build_device_columns(measured.prepared) | lock_columns)


def _build_rows(run: RunSpec, setup: RunSetup, timed: TimedRounds, observed: ObservedRun) -> list[dict[str, Any]]:
    """Build the rows of a finished run; raises StepError for values that are not finite."""
    prepared, by_frame = timed.measured.prepared, observed.columns_by_frame
    rows = timed.rows or build_timing_rows(timed.measured)
    require_finite(by_frame, is_minimiser=setup.is_minimiser, has_rtol=isinstance(run.rtol, float))
    shared: dict[str, Any] = {
        "vertices": len(setup.scene.mesh.rest_positions),
        "springs": len(setup.scene.all_springs.edges),
        **{name: int(value) for name, value in prepared.stats.items()},
        "solver_description": prepared.description,
        "modulus_exponent": _find_modulus_exponent(run, setup.scene),
        **timed.columns,
        **observed.status_columns,
    }
    return [shared | row | (by_frame[row["frame"]] if row["phase"] == "step" else {}) for row in rows]


def _find_modulus_exponent(run: RunSpec, scene: Scene) -> int | None:
    """Return how the spring stiffness scales with mesh size.

    The result is None without springs or with several rules.
    """
    rules = {effect.scaling_rule for effect in run.scene.effects if isinstance(effect, SpringsEffect)}
    found = {compute_modulus_exponent(rule, scene.mesh.dimension) for rule in rules}
    return found.pop() if len(found) == 1 else None


def _build_status_columns(run: RunSpec, scene: Scene, by_frame: Mapping[int, Mapping[str, Any]]) -> dict[str, str]:
    stands = _build_formula_check_columns(scene, run.frames) if run.verify else {"status": "ok"}
    growth = EnergyGrowth.from_rows(by_frame) if stands["status"] == "ok" else None
    return stands | (build_energy_growth_columns(run, growth, by_frame) if growth else {})


def _build_formula_check_columns(scene: Scene, frames: int) -> dict[str, str]:
    """Return `status` and `formula_check` of a finished run, and `reason` if a gradient is wrong."""
    errors = measure_gradient_errors(scene, frames)
    check = f"gradient: {', '.join(sorted(errors))}" if errors else "release"
    wrong = [f"that of {name} by {error:.2g} of its size" for name, error in sorted(errors.items()) if error]
    if not wrong:
        return {"status": "ok", "formula_check": check}
    reason = f"a gradient differs from the derivative of its energy's value: {', '.join(wrong)}"
    return {"status": "wrong-gradient", "formula_check": check, "reason": f"{reason}; mend `add_gradient` or `value`"}


def _run_error_controlled(job: RunJob, max_error: float, session: TimingSession) -> list[dict[str, Any]]:
    """Return the rows of an error-controlled run, whose integrator and step size are chosen first."""
    run = job.run
    with _acquire_timing_lock(run, job.tick) as lock_columns:
        found = load_target(ERROR_CONTROL_TARGET)(run, max_error, job.tick, job.files.results_folder)
    rows, seen, last = found.build_rows(), found.positions, dict[str, Any]()
    session.finish_timing()
    if job.positions_path:
        save_positions(job.positions_path, seen[1:])
    if run.record:
        from springbench.harness.recording.recording_check import require_recorded_frames

        chosen = {name: rows[0][name] for name in ("status", "integrator", "error_estimated")}
        recorder = _open_recorder(job, found.scene, chosen | {"milliseconds_per_step": found.ms_per_step}, seen[-1])
        try:
            for k, p in enumerate(seen):
                recorder.record_frame(RecordedFrame(k, found.scene.compute_time(k), p, {}, float("nan"), 0))
            recorder.finish_recording({})
        finally:
            recorder.abandon_recording()
        chosen = sorted(FrameSamples(run.frames).frames)
        due = {k: found.scene.compute_time(k) for k in chosen}
        last = {
            "recording_digest": require_recorded_frames(
                job.files.recording_path, recorder.info, due, {k: seen[k] for k in chosen}
            )
        }
    return [lock_columns | row | (last if row["frame"] == run.frames else {}) for row in rows]


@contextmanager
def _acquire_timing_lock(run: RunSpec, tick: ProgressCallback) -> Generator[dict[str, Any]]:
    """Acquire the run's timing lock (exclusive, shared, or reserved cores), and yield its columns."""
    if run.timing != "shared":
        with (lock_timing_exclusive if run.timing == "exclusive" else lock_timing_shared)(tick):
            yield {}
    else:
        with reserve_cores(machine_info.choose_threads(run.threads).count, tick) as cores:
            yield {"pinned_cores": " ".join(map(str, cores))}


def _observe_run(job: RunJob, setup: RunSetup, measured: RunMeasurement) -> ObservedRun:
    """Repeat the simulation and observe energies, convergence, positions and the recording."""
    run, scene = job.run, setup.scene
    stored = np.empty((run.frames, len(scene.mesh.rest_positions), 3)) if job.positions_path else None
    samples = FrameSamples(run.frames)
    middle_frames = {1, (run.frames + 1) // 2, run.frames}
    with ExitStack() as cleanup:
        recorder = None
        if run.record:
            assert measured.final_positions is not None  # a sweep with `timing: none` and `record` is rejected
            seconds = [t.seconds for t in measured.timings if t.phase == "step"]
            facts = {"status": "ok", "milliseconds_per_step": compute_ms_per_step(seconds)}
            recorder = _open_recorder(job, scene, facts, measured.final_positions)
            cleanup.callback(recorder.abandon_recording)
        graded = AuditedSolver(measured.prepared, setup.build_solver(), middle_frames)
        observers = RunObservers(
            recorder,
            convergence_frames=middle_frames if run.convergence_frames is None else run.convergence_frames,
            positions_out=stored,
            sample_frame=samples.add_frame if recorder else None,
            verify_step=_build_verifier(run, setup),
        )
        found = observe_run(scene, graded, setup.settings, observers, job.tick, measured.clock)
        if measured.final_positions is not None and found[run.frames]["positions_digest"] != hash_positions(
            measured.final_positions
        ):
            raise RunFailed(
                "the final positions of the recorded pass differ from those of the timed pass; expected equal bits"
            )
        status_columns = _build_status_columns(run, scene, found)
        if recorder and measured.final_positions is not None:
            from springbench.harness.recording.recording_check import require_recorded_frames

            is_ok = status_columns["status"] == "ok"
            outcome = None if is_ok else {name: status_columns[name] for name in ("status", "reason")}
            recorder.finish_recording(compute_milliseconds(measured, run.frames), outcome)
            due = {frame: scene.compute_time(frame) for frame in samples.frames}
            motion = samples.positions | {run.frames: measured.final_positions}
            found[run.frames]["recording_digest"] = require_recorded_frames(
                job.files.recording_path, recorder.info, due, motion
            )
    if job.positions_path and stored is not None:
        save_positions(job.positions_path, stored)
    return ObservedRun({frame: graded.found.get(frame, {}) | row for frame, row in found.items()}, status_columns)


def _build_failure_row(job: RunJob, error: Exception) -> dict[str, Any]:
    """Return the row of a failed run, and record the frames before the failed one."""
    own = _list_solver_files(job.run)
    row = _find_first_diverged_frame(job.run, build_failure_columns(error, own), own)
    for earlier in (
        job.files.recording_path,
        job.files.picture_path,
    ):  # of an earlier execution; they would hide the failure
        earlier.unlink(missing_ok=True)
    if job.run.record and "frame" in row:
        _record_before_failure(job, row)
    return row


def _find_first_diverged_frame(
    run: RunSpec, failure_row: dict[str, Any], solver_files: Collection[Path]
) -> dict[str, Any]:
    """Return the row of a failed run; after divergence, that of the first diverged frame.

    Timed passes detect only positions that are not finite, which may occur later.
    """
    if failure_row["status"] != "diverged" or "frame" not in failure_row:
        return failure_row
    try:
        RunSetup.from_run(run).observe_first_frames(failure_row["frame"] - 1)
    except StepError as earlier:
        return build_failure_columns(earlier, solver_files)
    except Exception:  # the failure is reported already
        return failure_row
    return failure_row


def _record_before_failure(job: RunJob, failure_row: dict[str, Any]) -> None:
    """Record the frames before the failed one and mark the recording.

    Nothing is recorded if these frames fail, too.
    """
    facts = {"status": failure_row["status"], "reason": failure_row["reason"], "failed_frame": failure_row["frame"]}
    with ExitStack() as cleanup, suppress(Exception):  # the first error is already reported
        setup = RunSetup.from_run(job.run)
        recorder = _open_recorder(job, setup.scene, facts)
        cleanup.callback(recorder.abandon_recording)
        setup.observe_first_frames(failure_row["frame"] - 1, recorder)
        recorder.finish_recording({})


def _list_solver_files(run: RunSpec) -> frozenset[Path]:
    """Return the source files of the solver, in which an error is located first."""
    try:
        return source_digest.find_class_sources(load_solver_class(run))
    except Exception:  # user code that cannot be imported is the reported error
        return frozenset()


@dataclass(frozen=True, slots=True)
class _MotionKey:
    """Cache key: a run's scene and the other settings that determine its motion."""

    key: tuple[str | int, ...]
    run: RunSpec = field(compare=False)


def _build_verifier(run: RunSpec, setup: RunSetup) -> StepVerifier | None:
    if not run.verify:
        return None
    key = (run.scene.scene_digest, run.size, run.integrator, run.initial_guess, run.frames)
    return StepVerifier(setup.scene, _compute_reference(_MotionKey(key, run)), is_minimiser=setup.is_minimiser)


@lru_cache(maxsize=1)
def _compute_reference(motion: _MotionKey) -> NDArray[np.float64] | None:
    """Return the reference motion of a scene; None where Newton's method fails.

    One entry is cached, because the runs of a scene are consecutive.
    """
    run = motion.run
    scene = build_scene(run.scene, run.size, run.integrator)
    try:
        return compute_reference_positions(
            scene, load_target(SOLVERS["newton"])(), initial_guess=run.initial_guess, frames=run.frames
        )
    except Exception:  # the row of Newton's method states the error
        return None


def _open_recorder(job: RunJob, scene: Scene, outcome: Mapping[str, Any], *final_positions: Positions) -> RerunRecorder:
    """Open the recording of a run.

    `outcome` contains columns that state how the run ended; they become properties of the recording. `final_positions`
    set the colour scale.
    """
    from springbench.harness.recording.rerun_recorder import (
        RerunRecorder,  # with Rerun, which a light installation lacks
    )

    run, recording_path = job.run, job.files.recording_path
    recording_path.parent.mkdir(parents=True, exist_ok=True)
    here = machine_info.describe_machine()
    properties = {
        "sweep": run.sweep,
        **{
            name: value for name, value in build_specification_columns(run).items() if value is not None
        },  # a property has no null
        "residual_rtol": convert_tolerance(run.rtol) or 0.0,
        "vertices": len(scene.mesh.rest_positions),
        "springs": len(scene.all_springs.edges),
        "frames": run.frames,
        **outcome,
        "cpu": here.cpu,
        "cores": here.cores,
        "memory_gib": here.memory_gib,
        "operating_system": here.operating_system,
        "commit": machine_info.read_commit(),
        **{f"version_{name}": version for name, version in machine_info.collect_versions().items()},
    }
    size = f" {run.size}" if run.size else ""
    return RerunRecorder(
        recording_path,
        RecordingInfo(
            title=f"{run.scene_name}{size} - {run.solver.name}",
            run_id=run.compute_run_id(here.machine_id),
            mesh=scene.mesh,
            springs=scene.all_springs.edges,
            rest_lengths=scene.all_springs.rest_length,
            pinned_vertices=scene.system.pins.vertices,
            time_step=run.scene.time_step,
            strain_range=run.strain_range
            or compute_strain_range(
                scene.mesh.rest_positions, final_positions, scene.all_springs.edges, scene.all_springs.rest_length
            ),
            has_self_contact=scene.has_self_contact,
            properties=properties,
            obstacles=list_obstacles(run.scene.effects),
        ),
    )
