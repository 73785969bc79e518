"""Command `springbench run SCENE --error 1e-3`: simulate a scene to a given error.

It writes rows and a recording.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from math import isfinite
from pathlib import Path
from typing import Any, NamedTuple

from springbench.harness.config.config_loader import load_scene
from springbench.harness.config.sweep_config import FixedOptions
from springbench.harness.errors import InputError, InputMistake, RunFailed
from springbench.harness.execution import machine_info
from springbench.harness.execution.early_worker import run_in_early_worker, wait_for_early_worker
from springbench.harness.execution.isolated_call import run_isolated
from springbench.harness.execution.optional_parts import RECORDINGS
from springbench.harness.execution.progress_events import ignore_progress
from springbench.harness.execution.worker_process import TaskLimits
from springbench.harness.experiments.accuracy.accuracy_schema import ACCURACY_SCHEMA
from springbench.harness.experiments.error_control.candidate_methods import (
    ErrorTarget,
    format_method_name,
    list_contact_methods,
)
from springbench.harness.experiments.error_control.method_search import (
    compute_predictability_horizon,
    search_cheapest_contact_method,
    search_cheapest_method,
)
from springbench.harness.experiments.error_control.method_trials import SearchResult, Trial
from springbench.harness.experiments.error_control.stored_trials import (
    ResultRow,
    build_trial_rows,
    format_problem_id,
    read_stored_trials,
    select_best_predicted,
)
from springbench.harness.experiments.kernel_precompilation import ERROR_CONTROL, compile_missing_kernels
from springbench.harness.experiments.provenance import build_provenance_columns
from springbench.harness.recording.recorder_interface import RecordedFrame, RecordingInfo
from springbench.harness.recording.strain_shading import compute_strain_range
from springbench.harness.reference.perturbation_growth import PerturbationGrowth
from springbench.harness.reference.self_converged_trajectory import describe_self_convergence
from springbench.harness.report.energy_losses import describe_losses
from springbench.harness.results import parquet_rows
from springbench.harness.results.folder_ownership import claim_folder
from springbench.harness.results.position_file import save_positions
from springbench.harness.results.quantities import DISSIPATION_CAUSES
from springbench.harness.results.solver_metadata import read_solver_metadata
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.scenes.scene_spec import SceneSpec
from springbench.harness.simulation.energy_balance import StepDissipation, sum_dissipation
from springbench.solvers.model.step_problem import Positions

PrintMessage = Callable[[str], None]
_ENERGY_COLUMNS = ("provided_energy", *(f"dissipation_{cause}" for cause in DISSIPATION_CAUSES if cause != "engine"))
"""Columns of the energies of the whole motion."""
_SHARED_COLUMNS = ("sweep", "scene", "size", "vertices", "threads", "t_end", "error_requested")
"""Columns that the rows of third-party integrators share."""


class ErrorRequest(NamedTuple):
    """What is simulated to a relative error, and what is done with the motion.

    Attributes:
        error: relative error at t_end.
        t_end: simulated time [s]; that of the scene if None.
        size: mesh size; the scene's default if None.
        verify: whether to compare with the reference solution.
        compare_third_party: whether to time third-party integrators too.
        positions: where to store the positions of the frames; None for not at all.
        rerun: whether to try all methods, even those that were expensive according to stored rows.
    """

    error: float
    t_end: float | None
    size: int | None
    verify: bool
    compare_third_party: bool
    positions: Path | None
    rerun: bool


def run_error_control(
    config: Path,
    request: ErrorRequest,
    results: Path,
    print_message: PrintMessage,
    rejected_options: Mapping[str, Any],
) -> bool:
    """Simulate the scene in a file to a relative error, and print the cost.

    Args:
        config: file of the scene.
        request: what is simulated, and what is done with the motion.
        results: folder of results.
        print_message: prints a message.
        rejected_options: other options on the command line, which are not supported here.

    Returns:
        Whether energy has grown only by its sources and, if it is verified, the measured error is at most the requested
        one.

    Raises:
        InputError: an option is invalid.
        RunFailed: no method reaches the error.
    """
    _check_options(request.error, request.t_end, rejected_options)
    scene = load_scene(config)
    wait_for_early_worker()
    return run_isolated(
        partial(_execute_error_control, config, scene, request, results),
        scene.find_plugins(),
        TaskLimits(FixedOptions().time_limit),
        print_message,
    )


def _execute_error_control(
    config: Path,
    scene: SceneSpec,
    request: ErrorRequest,
    results: Path,
    print_message: PrintMessage,
) -> bool:
    error = request.error
    print_message("estimating the time up to which the motion is predictable")
    error_target = ErrorTarget.from_scene(scene, request.size, request.t_end)
    folder = claim_folder(results / config.stem, config)
    with machine_info.limit_threads(1):
        before = read_stored_trials(folder / "accuracy", error_target)
        if error_target.has_contact:
            print_message(describe_self_convergence(scene.path.stem))
            answer = search_cheapest_contact_method(
                error_target, error, results, print_message, print_message, list_contact_methods()
            )
        else:
            if not scene.find_plugins():  # the process that isolates user code starts no others
                compile_missing_kernels([ERROR_CONTROL], print_message)
            seen = compute_predictability_horizon(error_target, error, print_message)
            answer = _search_method(error_target, error, seen, [] if request.rerun else before, print_message)
    path, best = answer.best_trial.trajectory, answer.best_trial
    print_message(
        f"requested error {error:g}, estimated error {best.error_estimated:.1g}, "
        f"processor time {path.cpu_seconds:.3g} s"
    )
    factors = f", {path.num_factorisations} factorisations" if path.num_factorisations else ""
    print_message(
        f"{best.method}: {path.num_accepted_steps} accepted steps, {path.num_rejected_steps} rejected{factors}"
        + (f"; more accurate than requested, because {answer.note}" if answer.note else "")
    )
    print_message(f"search and error estimate took {answer.search_seconds:.3g} s in addition")
    motion_scene = error_target.build_scene(error_target.frame_seconds, "substepping")
    status = answer.build_status_columns(answer.compute_balances(motion_scene))
    if status["status"] != "ok":
        print_message(f"{status['status']}: {status['reason']}")
    energies = sum_dissipation(best.measure_dissipation(error_target.frame_seconds))
    if sentence := _describe_dissipation(best, error_target, energies):
        print_message(sentence)
    measured = (
        _verify_error(error_target, error, path.positions[-1], results, print_message) if request.verify else None
    )
    label = f"{config.stem}-{error_target.size}-error-{error:g}-{error_target.t_end:g}"
    row = _build_row(config.stem, error_target, error, answer, status) | {"error": measured}
    if error_target.has_contact:
        bound = answer.reference_trial.error_estimated
        row |= {"reference_kind": "self-converged", "reference_error": bound}
    row |= {name: value for name, value in energies.columns.items() if name in _ENERGY_COLUMNS}
    if RECORDINGS.is_installed():
        recording = _record_motion(
            folder / "recordings" / f"{label}.rrd", config.stem, error_target, motion_scene, answer, status
        )
        row["recording_path"] = f"recordings/{recording.name}"
        print_message(f"the recording is {recording}")
    else:
        print_message(f"the motion is not recorded: {RECORDINGS.describe_absence()}")
    (folder / "accuracy").mkdir(exist_ok=True)
    found = [
        row,
        *(
            _build_third_party_rows(row, error_target, error, answer, print_message)
            if request.compare_third_party
            else ()
        ),
    ]
    shared = {name: row[name] for name in (*_SHARED_COLUMNS, "problem_digest")} | build_provenance_columns()
    found += [shared | trial_row for trial_row in build_trial_rows(answer, before, error)]
    parquet_rows.write_rows(
        folder / "accuracy" / f"{label}.parquet", [one | {"unit_id": label} for one in found], ACCURACY_SCHEMA
    )
    if request.positions:
        save_positions(request.positions, path.positions[1:])
    print_message(f"the row is in {folder / 'accuracy'}")
    return status["status"] == "ok" and (not request.verify or (measured is not None and measured <= error))


def _describe_dissipation(trial: Trial, error_target: ErrorTarget, energies: StepDissipation) -> str:
    """Describe the energy balance of the motion; empty if unknown or no energy was provided."""
    if not energies.provided_energy or energies.dissipation_integrator is None:
        return ""
    name = trial.method.solver if trial.method.integrator == "substepping" else trial.method.integrator
    lost = energies.dissipation_integrator, energies.dissipation_damping, energies.dissipation_friction
    return describe_losses(name, error_target.t_end, *((one or 0.0) / energies.provided_energy for one in lost))


def _search_method(
    error_target: ErrorTarget,
    error: float,
    growth: PerturbationGrowth,
    stored_trials: Sequence[ResultRow],
    print_message: PrintMessage,
) -> SearchResult:
    """Search for the cheapest method, first among those that were cheap for a similar error.

    Args:
        error_target: scene, size and end time.
        error: requested relative error.
        growth: growth of a perturbation up to the end time.
        stored_trials: rows of earlier searches; without any, all methods are tried.
        print_message: prints a message.

    Raises:
        RunFailed: no method reaches the error.
    """
    nearest, pairs = select_best_predicted(stored_trials, error)
    if not pairs:
        return search_cheapest_method(error_target, error, growth, print_message)
    names = ", ".join(format_method_name(integrator, solver.name) for integrator, solver in pairs)
    print_message(
        f"trying the cheapest methods of stored results for an error of {nearest:g}: {names}; --rerun tries all"
    )
    try:
        return search_cheapest_method(error_target, error, growth, print_message, pairs)
    except RunFailed as failed:
        print_message(f"{failed}; trying all methods")
        return search_cheapest_method(error_target, error, growth, print_message)


def _verify_error(
    error_target: ErrorTarget, error: float, p: Positions, results: Path, print_message: PrintMessage
) -> float | None:
    """Print and return the error of positions p (n, 3) [m] against the reference.

    The result is None if there is no reference.
    """
    from springbench.harness.experiments.accuracy.accuracy_units import open_reference_store

    try:
        trajectory = open_reference_store(results).load_trajectory(
            error_target.scene, error_target.size, [error_target.t_end], error=error
        )
    except RunFailed as failed:
        print_message(f"the error cannot be measured, because there is no reference: {failed}")
        return None
    measured = trajectory.measure_error(-1, p)
    print_message(f"measured error {measured:.2g}, {'within' if measured <= error else 'above'} the requested error")
    return measured


def _check_options(error: float, t_end: float | None, rejected_options: Mapping[str, Any]) -> None:
    """Raise InputError for invalid options."""
    mistakes = [
        InputMistake(
            "cannot be combined with --error, which selects solver and steps; leave it out",
            key=f"--{name.replace('_', '-')}",
        )
        for name, value in rejected_options.items()
        if value
    ]
    if not 0.0 < error < 1.0:
        mistakes.append(InputMistake(f"got {error:g}; expected a number between 0 and 1", key="--error"))
    if t_end is not None and not (isfinite(t_end) and 0.0 < t_end <= 1e4):
        mistakes.append(InputMistake(f"got {t_end:g}; expected seconds above 0, at most 10,000", key="--t-end"))
    if mistakes:
        raise InputError(mistakes)


def _build_row(
    name: str,
    error_target: ErrorTarget,
    error: float,
    search_result: SearchResult,
    status_columns: Mapping[str, str | None],
) -> dict[str, Any]:
    best, path = search_result.best_trial, search_result.best_trial.trajectory
    return {
        "kind": "error-control",
        **status_columns,
        "sweep": name,
        "scene": name,
        "problem_digest": format_problem_id(error_target),
        "size": error_target.size,
        "vertices": path.positions.shape[1],
        "solver": best.method.solver,
        "parameters": json.dumps({}),
        **read_solver_metadata(best.method.solver),
        "time_step": error_target.frame_seconds,
        "threads": 1,
        "t_end": error_target.t_end,
        "error_requested": error,
        **best.columns,
        "num_iterations": path.num_iterations,
        "seconds": [path.wall_seconds],
        "cpu_seconds": path.cpu_seconds,
        "seconds_per_simulated_second": path.wall_seconds / error_target.t_end,
        "search_seconds": search_result.search_seconds,
        **build_provenance_columns(),
    }


def _build_third_party_rows(
    row: dict[str, Any],
    error_target: ErrorTarget,
    error: float,
    search_result: SearchResult,
    print_message: PrintMessage,
) -> list[dict[str, Any]]:
    """Build the rows of third-party integrators, and print their relative times."""
    from springbench.harness.experiments.error_control.third_party_comparison import compare_third_party

    shared = {name: row[name] for name in _SHARED_COLUMNS} | build_provenance_columns()
    found = list[dict[str, Any]]()
    print_message("third-party integrators in the same process, at the same error:")
    for other in compare_third_party(error_target, error, search_result):
        comparison = f"{other.cpu_time_ratio:.3g} times the processor time, estimated error {other.error_estimated:.1g}"
        print_message(f"  {other.name}: {other.reason or comparison}")
        became = {"status": "failed", "reason": other.reason} if other.reason else {"status": "ok"}
        times = (
            {}
            if other.reason
            else {
                "seconds": [other.wall_seconds],
                "seconds_per_simulated_second": other.wall_seconds / error_target.t_end,
            }
        )
        estimated = {} if other.reason else {"error_estimated": other.error_estimated}
        found.append(shared | became | times | estimated | {"kind": "third-party", "solver": other.name})
    return found


def _record_motion(
    path: Path,
    name: str,
    error_target: ErrorTarget,
    scene: Scene,
    search_result: SearchResult,
    status_columns: Mapping[str, str | None],
) -> Path:
    """Write the recording of the motion, with the requested error as a property."""
    best, here = search_result.best_trial, machine_info.describe_machine()
    properties = {
        "scene": name,
        "size": error_target.size,
        "solver": best.method.solver,
        "integrator": best.method.integrator,
    }
    info = RecordingInfo(
        title=f"{name} {error_target.size or ''}".strip()
        + f" - {best.method}, estimated error {best.error_estimated:.1g}",
        run_id=f"{path.stem}-{here.machine_id}",
        mesh=scene.mesh,
        springs=scene.all_springs.edges,
        rest_lengths=scene.all_springs.rest_length,
        pinned_vertices=scene.system.pins.vertices,
        time_step=error_target.frame_seconds,
        strain_range=compute_strain_range(
            scene.mesh.rest_positions,
            best.trajectory.positions[-1:],
            scene.all_springs.edges,
            scene.all_springs.rest_length,
        ),
        has_self_contact=scene.has_self_contact,
        properties={
            **properties,
            **{column: value for column, value in status_columns.items() if value},
            "error_estimated": best.error_estimated,
            "cpu": here.cpu,
            "commit": machine_info.read_commit(),
        },
    )
    task = partial(_write_recording, path, info, best.trajectory.positions)
    return run_in_early_worker(task, ignore_progress)


def _write_recording(path: Path, info: RecordingInfo, positions: Positions, tick: PrintMessage) -> Path:
    """Write the recording of positions (frames, n, 3) [m], and return its path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    from springbench.harness.recording.rerun_recorder import RerunRecorder

    recorder = RerunRecorder(path, info)
    try:
        for k, p in enumerate(positions):
            recorder.record_frame(RecordedFrame(k, k * info.time_step, p, {}, float("nan"), 0))
        return recorder.finish_recording({})
    finally:
        recorder.abandon_recording()
