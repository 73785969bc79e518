"""Find the cheapest method for an error, or the most accurate for a wall time.

The method is selected from stored rows or new measurements. One search serves both cases: where a wall time is given,
its target error is zero, and only the cost ends it.

An error is that of a whole simulation up to a horizon (`springbench.harness.experiments.accuracy.work_precision`). A
cost is the wall time per simulated second. The result is the cheapest measured method that meets the error, or the
one with the least error within the time; one more simulation checks it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from time import monotonic
from typing import Any, NamedTuple

from springbench.harness.config.accuracy_config import AccuracyConfig, BenchmarkCase, MeasurementSettings, WorkSpec
from springbench.harness.config.accuracy_loader import AccuracyPlan, expand_studies
from springbench.harness.config.config_loader import find_scene_mistakes, load_scene
from springbench.harness.config.run_options import RUN_OPTIONS, STEP_OPTIONS
from springbench.harness.config.solver_parameters import read_solvers
from springbench.harness.config.sweep_config import SolverSpec
from springbench.harness.errors import InputError, InputMistake, RunFailed
from springbench.harness.execution import machine_info
from springbench.harness.execution.isolated_call import run_isolated
from springbench.harness.execution.progress_display import ProgressDisplay
from springbench.harness.execution.worker_process import TaskLimits
from springbench.harness.experiments.accuracy.accuracy_schema import ACCURACY_SCHEMA
from springbench.harness.experiments.accuracy.accuracy_study import open_measurement
from springbench.harness.experiments.accuracy.accuracy_units import (
    EXTRA_WALL_SECONDS,
    load_reference_trajectory,
    open_reference_store,
)
from springbench.harness.experiments.accuracy.candidate_grids import StudyCandidates
from springbench.harness.experiments.accuracy.recommendation_goal import MeasuredMethod, RecommendationGoal
from springbench.harness.experiments.accuracy.setting_grid import (
    LEAST_LIMIT,
    SLOWER,
    compute_setting_cost,
    is_measured,
    search_grid,
)
from springbench.harness.experiments.accuracy.work_precision import build_work_rows
from springbench.harness.experiments.best_first_search import SearchSummary
from springbench.harness.reference.reference_store import ReferenceStore
from springbench.harness.reference.reference_trajectory import ReferenceTrajectory
from springbench.harness.reference.self_converged_trajectory import describe_self_convergence, has_contact
from springbench.harness.reference.step_snapshot import build_exact_scene
from springbench.harness.results import parquet_rows, row_store
from springbench.harness.results.folder_ownership import claim_folder
from springbench.harness.scenes.mesh.mesh_generator import MeshGenerator
from springbench.harness.scenes.scene_spec import SceneSpec
from springbench.harness.schema.config_document import ConfigDocument
from springbench.solvers.registry import SOLVER_TABLE, is_engine, load_target

DEFAULT_T_END = 1.0
"""Default simulated time at which the error counts [s]."""
SEARCH_TIME = 60.0
"""Default limit for the wall time of all measurements together [s]."""
BUDGET_RANGE = 2.0
"""Multiple of a given wall time up to which methods are measured, to show what more time would yield."""
_SEARCH_FRACTION = 0.75
"""Part of the time for a search in which powers of two are measured; the rest is for step sizes between them."""
_NUM_TUNED, _TUNING_ROUNDS = 8, 2
"""Number of methods whose step sizes are tuned to a wall time, and how often."""
_MAX_REFINEMENT = 8
"""Largest number of steps that replace one, where the budget is far from used up."""
_BUDGET_AIM = 0.95
"""Fraction of a wall time at which a step size aims, because times scatter."""
_MESSAGE_INTERVAL = 2.0
"""Interval between two messages about the reference [s]."""
_ERROR_RTOL, _MAX_TIME_RATIO = 1e-6, 1.3
"""Relative difference of two errors of one simulation that compilers may cause; accepted ratio of its two times."""


class RecommendationOptions(NamedTuple):
    """Which simulations a recommendation considers, and how long they may take.

    Attributes:
        size: mesh size; the scene's default if None.
        t_end: simulated time [s]. If None, DEFAULT_T_END, or the longest time at which the error can be measured, if
            that is shorter.
        time_limit: wall-time limit of a simulation [s].
        engine: name of the only solver or engine to consider; None for all.
        search_time: limit for the wall time of all measurements together [s].
    """

    size: int | None
    t_end: float | None
    time_limit: float
    engine: str | None = None
    search_time: float = SEARCH_TIME


class _StoredMeasurements(NamedTuple):
    """Measured methods, the cheapest first, and the rows of those that have no error."""

    methods: list[MeasuredMethod]
    failed_rows: list[dict[str, Any]]


@dataclass(frozen=True, slots=True)
class MethodRecommendation:
    """Result of a recommendation.

    Attributes:
        goal: limit on the method.
        frame: time step of the scene [s].
        measured_methods: all measured methods, cheapest first.
        best_method: the best of those within the goal's limit.
        checked_method: a repeated measurement of it.
    """

    goal: RecommendationGoal
    frame: float
    measured_methods: tuple[MeasuredMethod, ...]
    best_method: MeasuredMethod
    checked_method: MeasuredMethod

    @property
    def cost_limit(self) -> float | None:
        """Largest wall time per simulated second that the goal allows; None for an error."""
        return None if self.goal.frame_seconds is None else self.goal.frame_seconds / self.frame

    def find_runner_up(self) -> MeasuredMethod | None:
        """Return the best method within the goal that differs in solver, integrator or parameters."""
        within = self.goal.select_methods(self.measured_methods, self.frame)
        return next((method for method in within if method.kind != self.best_method.kind), None)

    def select_best(self, factor: float) -> MeasuredMethod | None:
        """Return the most accurate method within a multiple of the given wall time.

        Args:
            factor: multiple of the wall time.

        Returns:
            The method; None if none is cheap enough.
        """
        return next(iter(self.goal.select_methods(self.measured_methods, self.frame, factor)), None)

    @property
    def verdict(self) -> str:
        """Comparison of the predicted with the repeated measurement, as text."""
        before, now = self.best_method, self.checked_method
        if not math.isclose(now.error, before.error, rel_tol=_ERROR_RTOL):
            return (
                f"not as predicted: the error is {now.error:.3g}, not {before.error:.3g}; what was measured before is "
                "not this simulation, so remove it and repeat the command"
            )
        ratio = now.seconds_per_simulated_second / before.seconds_per_simulated_second
        if not 1.0 / _MAX_TIME_RATIO <= ratio <= _MAX_TIME_RATIO:
            return (
                f"the error is as predicted, the time {ratio:.2g} times that: other programs ran during one of the "
                "two, so repeat the command on an idle machine before you rely on the time"
            )
        return f"as predicted: the same error, {ratio:.2g} times the time"


def recommend_method(
    path: Path,
    goal: RecommendationGoal,
    options: RecommendationOptions,
    results: Path,
    display: ProgressDisplay,
    print_message: Callable[[str], None],
) -> MethodRecommendation:
    """Recommend the cheapest method for an error, or the most accurate for a wall time.

    The error is relative, at the end of the simulated time. A repeated measurement checks the method.

    Args:
        path: file of the scene.
        goal: error, or wall time of a frame.
        options: which simulations are considered, and how long they may take.
        results: folder that contains a folder for each config.
        display: shows progress.
        print_message: prints a remark.

    Returns:
        The recommended method, its repeated measurement, and all measured methods.

    Raises:
        InputError: an option is invalid.
        RunFailed: no method reaches the goal.
    """
    engine, search_time = options.engine, options.search_time
    positive_values = {
        "--error": goal.max_error,
        "--budget": goal.frame_seconds,
        "--t-end": options.t_end,
        "--time-limit": options.time_limit,
        "--search-time": search_time,
    }
    for key, value in positive_values.items():
        if value is not None and not 0 < value < math.inf:
            raise InputError(InputMistake(f"got {value:g}; expected a number above 0", key=key))
    scene = load_scene(path)
    scene.require_fixed_time_step()
    size = (options.size or scene.default_size or 0) if isinstance(scene.mesh, MeshGenerator) else 0
    isolated = partial(
        run_isolated,
        user_code=scene.find_plugins(),
        print_message=print_message,
        limits=TaskLimits(EXTRA_WALL_SECONDS),
    )
    store = open_reference_store(results)
    candidates = StudyCandidates.from_goal(goal, engine)
    planned: tuple[AccuracyPlan, RecommendationGoal, float] = isolated(
        partial(_plan_study, path, scene, size, goal, candidates, options, store)
    )
    study, goal, reference_error = planned
    if goal.max_error and reference_error:
        goal = replace(goal, max_error=goal.max_error - reference_error)
        print_message(
            f"the reference has an error of up to {reference_error:.1e}; against it, {goal.max_error:.3g} is allowed"
        )
    t_end, frame = study.work[0].t_end, scene.time_step

    def read_methods() -> _StoredMeasurements:
        stored = _read_measured_methods(path.stem, scene, size, t_end, results, goal.reference_error)
        chosen = [one for one in stored.methods if engine in (None, one.work_spec.solver.name)]
        return stored._replace(methods=chosen)

    stored = read_methods()
    summary: SearchSummary[Any] | None = None
    if goal.max_error is None or not any(one.sweep != study.name for one in goal.select_methods(stored.methods, frame)):
        folder = claim_folder(results / study.name, path)
        summary = _measure_study(study, stored, goal, frame, folder, display, print_message, search_time)
        print_message(f"{path.stem} {size or ''}: {summary}")
        stored = read_methods()
        if goal.frame_seconds is not None:
            left = (1.0 - _SEARCH_FRACTION) * search_time
            _tune_time_steps(read_methods, goal.frame_seconds / frame, t_end, folder, display, print_message, left)
            stored = read_methods()
    within = goal.select_methods(stored.methods, frame)
    if not within:
        raise RunFailed(_explain_no_method(stored, goal, frame, t_end, summary))
    checked = isolated(partial(_check_method, within[0], goal.reference_error, store))
    return MethodRecommendation(goal, frame, tuple(stored.methods), within[0], checked)


def _plan_study(
    path: Path,
    scene: SceneSpec,
    size: int,
    goal: RecommendationGoal,
    candidates: StudyCandidates,
    options: RecommendationOptions,
    reference_store: ReferenceStore,
    print_message: Callable[[str], None],
) -> tuple[AccuracyPlan, RecommendationGoal, float]:
    """Compute the reference of a study.

    Returns:
        The study, the goal, which is looser with contact, and the bound on the error of a self-converged reference: 0
        without contact.

    Raises:
        InputError: the scene or a candidate is invalid.
        RunFailed: the motion has no reference.
    """
    print_message("estimating the time up to which the motion is predictable")
    t_end, time_limit = options.t_end, options.time_limit
    if t_end is not None:
        _build_valid_study(path, scene, size, candidates, t_end, time_limit)
    elif mistakes := find_scene_mistakes(scene, [size]):
        raise InputError(mistakes)
    touches = has_contact(build_exact_scene(scene, size).system)
    if touches:
        print_message(describe_self_convergence(scene.path.stem))
        candidates = candidates.restrict_to_contact()
        goal = goal.loosen_for_contact()
        t_end = _find_contact_t_end(scene, size, goal.reference_error, t_end, reference_store, print_message)
    elif t_end is None:
        t_end = find_default_t_end(path, scene, size, goal.reference_error, reference_store, print_message)
    study = _build_valid_study(path, scene, size, candidates, t_end, time_limit)
    trajectory = _compute_reference(scene, size, goal.reference_error, t_end, reference_store, print_message)
    return study, goal, trajectory.get_error_bound(-1) if touches else 0.0


def _build_valid_study(
    path: Path, scene: SceneSpec, size: int, candidates: StudyCandidates, t_end: float, time_limit: float
) -> AccuracyPlan:
    """Build the study; its mistakes are those of options. Raises InputError."""
    try:
        return build_study(path, scene, size, candidates, t_end, time_limit)
    except InputError as refused:  # the study is generated, so the mistake is in an option
        raise InputError(list(dict.fromkeys(map(_convert_to_option, refused.mistakes)))) from refused


def _find_contact_t_end(
    scene: SceneSpec,
    size: int,
    max_error: float,
    t_end: float | None,
    reference_store: ReferenceStore,
    print_message: Callable[[str], None],
) -> float:
    """Return the end time [s] of a motion with contact.

    It is the given one, or else the longest at which the error can be measured, up to that of the scene. Raises
    NotConverged.
    """
    if t_end is not None:
        reference_store.require_contact_horizon(scene, size, t_end, error=max_error)
        return t_end
    longest = min(DEFAULT_T_END, scene.frames * scene.time_step)
    motion, reason = reference_store.load_contact_horizon(scene, size, longest, error=max_error)
    if reason:
        print_message(f"an error of {max_error:g} can be measured up to {motion.times[-1]:.4g} s, because {reason}")
    return float(motion.times[-1])


def find_default_t_end(
    path: Path,
    scene: SceneSpec,
    size: int,
    max_error: float,
    reference_store: ReferenceStore,
    print_message: Callable[[str], None],
) -> float:
    """Return the default end time [s].

    Args:
        path: file of the scene, which the message names.
        scene: the scene.
        size: mesh size.
        max_error: relative error that must be measurable up to the end.
        reference_store: store of the growth of perturbations.
        print_message: called with the reason if the time is shorter than DEFAULT_T_END.

    Returns:
        DEFAULT_T_END, or the longest time at which the error can be measured, if that is shorter. Contact does not
        shorten it.

    Raises:
        InputError: the scene is invalid.
        UnpredictableMotion: nothing moves, or the error can be measured at no time.
        NotIntegrable: the scene has no equations of motion.
    """
    if mistakes := find_scene_mistakes(scene, [size]):
        raise InputError(mistakes)
    if has_contact(build_exact_scene(scene, size).system):
        return DEFAULT_T_END
    seen = reference_store.load_growth(scene, size, DEFAULT_T_END)
    if seen.min_error <= max_error:
        return DEFAULT_T_END
    longest = seen.compute_longest_horizon(max_error)
    if not longest:
        seen.require_predictable(max_error)
    print_message(
        f"{path.stem} {size or ''}: an error of {max_error:g} can be measured "
        f"up to {longest:g} s, because a perturbation of "
        f"1e-12 of the size grows to {seen.growth_factor[-1]:.1e} of the displacement after {DEFAULT_T_END:g} s"
    )
    return longest


def _compute_reference(
    scene: SceneSpec,
    size: int,
    max_error: float,
    t_end: float,
    reference_store: ReferenceStore,
    print_message: Callable[[str], None],
) -> ReferenceTrajectory:
    """Compute the reference trajectory and report progress. Raises RunFailed if there is none."""
    print_message(f"computing the reference motion up to {t_end:g} s, once")
    last = [monotonic()]

    def report_progress(motion: int, time: float) -> None:
        if monotonic() - last[0] > _MESSAGE_INTERVAL:
            last[0] = monotonic()
            print_message(f"  motion {motion} of 2, at {time:.3g} of {t_end:g} s")

    return reference_store.load_trajectory(scene, size, [t_end], error=max_error, report_progress=report_progress)


def _measure_study(
    study: AccuracyPlan,
    stored: _StoredMeasurements,
    goal: RecommendationGoal,
    frame: float,
    folder: Path,
    display: ProgressDisplay,
    print_message: Callable[[str], None],
    search_time: float,
) -> SearchSummary[Any]:
    """Measure the methods that may be the best and have no rows. Raises InputError, WriteError."""
    known: dict[str, dict[str, Any]] = {
        method.work_spec.build_file_stem(): {
            "status": "ok",
            "error": method.error,
            "seconds_per_simulated_second": method.seconds_per_simulated_second,
        }
        for method in stored.methods
    }
    failed, here = {row["unit_id"]: row for row in stored.failed_rows}, machine_info.describe_machine().machine_id
    within = [method.seconds_per_simulated_second for method in goal.select_methods(stored.methods, frame)]
    best, error, end = min(within, default=math.inf), goal.reference_error, f"{SLOWER:g} times as slow as the best"
    if goal.frame_seconds is not None:  # no error is small enough, so that only the cost ends the search
        best, error = BUDGET_RANGE * goal.frame_seconds / frame / SLOWER, 0.0
        end = f"{BUDGET_RANGE:g} times as slow as the budget"
    print_message(
        f"measuring up to {len(study.work)} settings, cheap ones first, for at most {search_time:g} s (--search-time); "
        f"a simulation ends once it is {end}"
    )
    with open_measurement(study.work, folder, display) as measure:

        def look_up(spec: WorkSpec) -> dict[str, Any]:
            return known.get(spec.build_file_stem()) or failed.get(spec.compute_unit_id(here)) or measure(spec)

        part = 1.0 if goal.frame_seconds is None else _SEARCH_FRACTION
        return search_grid(study.work, error, best, look_up, part * search_time)


def _tune_time_steps(
    read_methods: Callable[[], _StoredMeasurements],
    cost_limit: float,
    t_end: float,
    folder: Path,
    display: ProgressDisplay,
    print_message: Callable[[str], None],
    search_time: float,
) -> None:
    """Measure step sizes between powers of two that use up a wall time.

    Only methods with the smallest predicted errors are measured. The prediction assumes that the cost is proportional
    to the number of steps, and the error inversely proportional.
    """
    end, done = monotonic() + search_time, set[str]()
    for _ in range(_TUNING_ROUNDS):
        methods = read_methods().methods
        known = {method.work_spec.build_file_stem() for method in methods} | done
        specs = [one for one in list_tuned_specs(methods, cost_limit, t_end) if one.build_file_stem() not in known]
        if not specs or monotonic() > end:
            return
        print_message(f"tuning the time steps of {len(specs)} settings to the budget")
        with open_measurement(specs, folder, display) as measure:
            for spec in specs:
                if monotonic() < end:
                    measure(spec)
                    done.add(spec.build_file_stem())


def list_tuned_specs(methods: Sequence[MeasuredMethod], cost_limit: float, t_end: float) -> list[WorkSpec]:
    """List simulations whose step size uses up a cost limit, by increasing predicted error.

    Args:
        methods: measured methods, of which the most accurate one of each kind within the limit is refined.
        cost_limit: wall time per simulated second [s/s].
        t_end: simulated time [s].
    """
    finest: dict[tuple[object, ...], MeasuredMethod] = {}
    for method in methods:
        key = (*method.kind, *method.work_spec.options.items())
        within, before = method.seconds_per_simulated_second <= cost_limit, finest.get(key)
        if within and (before is None or method.error < before.error):
            finest[key] = method
    predicted = list[tuple[float, WorkSpec]]()
    for method in finest.values():
        spec, slack = method.work_spec, _BUDGET_AIM * cost_limit / method.seconds_per_simulated_second
        has_substeps = is_engine(load_target(SOLVER_TABLE[spec.solver.name]))
        steps = spec.options["max_iterations"] if has_substeps else round(t_end / spec.case.scene.time_step)
        more = min(int(slack * steps), _MAX_REFINEMENT * steps)
        if more <= steps:
            continue
        if has_substeps:
            spec = replace(spec, options={**spec.options, "max_iterations": more})
        else:
            spec = replace(spec, case=replace(spec.case, scene=spec.case.scene.with_time_step(t_end / more)))
        limit = max(LEAST_LIMIT, BUDGET_RANGE * cost_limit * t_end)
        spec = replace(spec, measurement=replace(spec.measurement, time_limit=limit))
        predicted.append((method.error * steps / more, spec))
    return [spec for _, spec in sorted(predicted, key=lambda pair: pair[0])[:_NUM_TUNED]]


def build_study(
    path: Path, scene: SceneSpec, size: int, candidates: StudyCandidates, t_end: float, time_limit: float
) -> AccuracyPlan:
    """Build the study that is measured where no rows exist.

    Args:
        path: file of the scene, after which the study is named.
        scene: scene, whose time step is refined.
        size: mesh size; 0 for a mesh without sizes.
        candidates: solvers, grid of settings, and refinements of the time step.
        t_end: simulated time [s].
        time_limit: wall-time limit of a simulation [s].

    Raises:
        InputError: an option is invalid for a candidate.
    """
    steps = max(1, round(t_end / scene.time_step))
    time_steps = [t_end / round(steps * factor) for factor in candidates.refinements if round(steps * factor)]
    shared = {"t_end": t_end, "time_step": time_steps, "time_limit": time_limit} | ({"size": size} if size else {})
    work: list[dict[str, Any]] = [shared | entry for entry in candidates.grid]
    data = {"scenes": [path.name], "solvers": list(candidates.solvers), "work": work}
    document = ConfigDocument(path, data)
    validated = document.validate_data(AccuracyConfig, data)
    solvers = read_solvers(document)
    if validated is None or document.mistakes:
        raise document.build_error()
    return replace(expand_studies(document, validated, {path.stem: scene}, solvers), name=f"recommend-{path.stem}")


def _convert_to_option(mistake: InputMistake) -> InputMistake:
    """Convert a mistake in a study to one in a command-line option."""
    return InputMistake(mistake.problem, key="--" + mistake.key.rpartition(".")[2].replace("_", "-"))


def _read_measured_methods(
    name: str, scene: SceneSpec, size: int, t_end: float, results: Path, reference_error: float
) -> _StoredMeasurements:
    """Read the rows of this scene on this machine."""
    here, methods, without = machine_info.describe_machine().machine_id, list[MeasuredMethod](), list[dict[str, Any]]()
    units = (
        unit
        for folder in row_store.find_row_folders(results, "accuracy", "*/")
        for unit in row_store.list_units(folder)
    )
    for path in sorted(unit for unit in units if unit.name.startswith(f"{name}-{size}-work-")):
        row = parquet_rows.read_rows([path], ACCURACY_SCHEMA).to_pylist()[0]
        spec = _build_work_spec(row, name, scene)
        if path.stem != spec.build_file_stem() or row["machine_id"] != here or row["t_end"] != t_end:
            continue  # measured for another scene, machine or end time
        if is_measured(row):
            methods.append(_build_measured_method(spec, row, reference_error))
        else:
            without.append(row)
    return _StoredMeasurements(sorted(methods, key=lambda method: method.seconds_per_simulated_second), without)


def _build_work_spec(row: dict[str, Any], name: str, scene: SceneSpec) -> WorkSpec:
    """Build the specification that a row was measured with, assuming an unchanged scene."""
    case = BenchmarkCase(name, scene.with_time_step(row["time_step"]), row["size"], row["integrator"])
    solver = SolverSpec(row["solver"], json.loads(row["parameters"]))
    how = MeasurementSettings(row["threads"], rounds=1, time_limit=float("inf"))
    return WorkSpec(case, row["t_end"], solver, {name: row[RUN_OPTIONS[name].column] for name in STEP_OPTIONS}, how)


def _check_method(
    best: MeasuredMethod, reference_error: float, reference_store: ReferenceStore, print_message: Callable[[str], None]
) -> MeasuredMethod:
    """Repeat the measurement of a method."""
    print_message(f"checking {best}")
    row = build_work_rows(best.work_spec, load_reference_trajectory(best.work_spec, reference_store), lambda: None)[0]
    if not is_measured(row):
        raise RunFailed(f"the repeated measurement of {best} failed: {row['status']}: {row['reason']}")
    return _build_measured_method(best.work_spec, row, reference_error)


def _build_measured_method(spec: WorkSpec, row: dict[str, Any], reference_error: float) -> MeasuredMethod:
    """Build the method of a row.

    Where the error is too small for the reference, its upper bound is the error that the reference must resolve.
    """
    return MeasuredMethod(
        spec,
        row["error"] if row["status"] == "ok" else reference_error,
        compute_setting_cost(spec, row),
        row["reference_kind"] or "integrated",
        row["solver_description"] or "",
        row.get("sweep") or "",
    )


def _explain_no_method(
    stored: _StoredMeasurements,
    goal: RecommendationGoal,
    frame: float,
    t_end: float,
    summary: SearchSummary[Any] | None,
) -> str:
    """Explain why no method reaches the goal, and suggest what to change."""
    methods, failed_rows = stored
    condition = f"reaches an error of {goal.reference_error:g} over {t_end:g} s"
    if goal.frame_seconds is not None:
        condition = f"takes at most {1e3 * goal.frame_seconds:g} ms for a frame of {frame:.6g} s"
    if summary and not summary.is_complete:
        return (
            f"nothing that was measured {condition}, and settings remain "
            f"({summary}): the same command with a larger --search-time resumes where this one ended"
        )
    if methods and goal.frame_seconds is not None:
        cheapest = methods[0]
        return (
            f"nothing that was measured {condition}; the cheapest is {cheapest}, "
            f"{1e3 * frame * cheapest.seconds_per_simulated_second:.3g} ms: use a larger --budget or a smaller "
            "--size"
        )
    if methods:
        nearest = min(methods, key=lambda method: method.error)
        return (
            f"nothing that was measured {condition}; the nearest is {nearest}, "
            f"which errs by {nearest.error:.2g}: use a larger --error or a shorter --t-end"
        )
    reasons = {row["reason"] for row in failed_rows}
    return f"no error over {t_end:g} s could be measured: {'; '.join(sorted(reasons)) or 'nothing was simulated'}"
