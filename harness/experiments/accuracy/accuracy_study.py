"""Execute the missing units of an accuracy config.

Step snapshots come first, then curves on them, and simulations. A unit is executed again if the config requests it with
other settings, or on another step snapshot.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from springbench.harness.config.accuracy_config import BenchmarkCase, CurveSpec, WorkSpec
from springbench.harness.config.accuracy_loader import AccuracyPlan
from springbench.harness.config.user_code import DEFAULT_LOAD_LIMITS
from springbench.harness.execution import folder_locks, machine_info
from springbench.harness.execution.isolated_call import run_isolated
from springbench.harness.execution.isolated_worker import IsolatedWorker, TaskFailure, TaskLimits
from springbench.harness.execution.progress_display import ProgressDisplay, RunCost
from springbench.harness.experiments.accuracy.accuracy_schema import ACCURACY_SCHEMA
from springbench.harness.experiments.accuracy.accuracy_units import (
    AccuracyResults,
    CurveUnit,
    ResultRow,
    SnapshotUnit,
    WorkPrecisionUnit,
)
from springbench.harness.experiments.completion_status import (
    CompletionStatus,
    read_completion_statuses,
    select_missing_units,
)
from springbench.harness.experiments.experiment_units import (
    REGISTRY_TABLES,
    execute_timed,
    execute_units,
    require_threads,
    update_registries,
)
from springbench.harness.reference.self_converged_trajectory import describe_self_convergence, has_contact
from springbench.harness.reference.step_snapshot import build_exact_scene
from springbench.harness.results import parquet_rows


@dataclass(frozen=True, slots=True)
class _PlannedUnit:
    """Unit and its completion status (`springbench.harness.experiments.completion_status.PlannedUnit`)."""

    unit: CurveUnit | WorkPrecisionUnit
    completion_status: CompletionStatus

    @property
    def title(self) -> str:
        return self.unit.title


def run_accuracy_study(
    accuracy: AccuracyPlan,
    folder: Path,
    display: ProgressDisplay,
    print_message: Callable[[str], None],
    *,
    rerun: bool = False,
    rerun_stale: bool = False,
    isolated: bool = True,
) -> list[Path]:
    """Execute the missing units and return the files of all units and their step snapshots.

    Files of units that only an earlier version of the config requested stay in place, and are not returned.

    Args:
        accuracy: the accuracy config.
        folder: folder of its results; the reference solutions for all configs are stored next to it.
        display: shows progress.
        print_message: prints a remark.
        rerun: whether to repeat all units.
        rerun_stale: whether to repeat units measured by other source code.
        isolated: whether to use worker processes; otherwise units run here, without limits.

    Raises:
        InputError: the input is invalid.
        WriteError: the rows cannot be written.
    """
    home = AccuracyResults(accuracy.name, folder)
    cases = {spec.case.scene_name: spec.case for spec in reversed(accuracy.work)}
    plugins = [plugin for case in cases.values() for plugin in case.scene.find_plugins()] if isolated else []
    run_isolated(partial(_report_contact, cases), plugins, TaskLimits(*DEFAULT_LOAD_LIMITS), print_message)
    require_threads({spec.measurement.threads for spec in (*accuracy.curves, *accuracy.work)})
    (folder / "accuracy").mkdir(parents=True, exist_ok=True)
    with folder_locks.lock_folder_exclusive(folder):
        execute_units(
            _build_snapshot_units(accuracy.curves, home), display, isolated=isolated
        )  # fast for snapshots that are stored already
        planned = _plan_units(
            [*_build_curve_units(accuracy.curves, home), *_build_work_units(accuracy.work, home)], home
        )
        todo = select_missing_units(planned, "units", print_message, rerun=rerun, rerun_stale=rerun_stale)
        execute_units([p.unit for p in todo], display, isolated=isolated)
    paths = [home.rows_path(label) for p in planned for label in _list_labels(p.unit.spec)]
    return list(dict.fromkeys(paths))


def _report_contact(cases: Mapping[str, BenchmarkCase], print_message: Callable[[str], None]) -> None:
    """Report the scenes with contact, for which no certified reference exists; this imports user code."""
    for name, case in cases.items():
        if has_contact(build_exact_scene(case.scene, case.size).system):
            print_message(describe_self_convergence(name))


@contextmanager
def open_measurement(
    work: Sequence[WorkSpec], folder: Path, display: ProgressDisplay
) -> Generator[Callable[[WorkSpec], ResultRow]]:
    """Yield a function that measures one simulation in a worker and returns its row.

    Args:
        work: the simulations that may be measured.
        folder: folder of the results, as in `run_accuracy_study`.
        display: shows progress.

    Raises:
        InputError: the input is invalid.
        WriteError: the rows cannot be written.
    """
    home = AccuracyResults(folder.name, folder)
    require_threads({spec.measurement.threads for spec in work})
    (folder / "accuracy").mkdir(parents=True, exist_ok=True)
    worker = IsolatedWorker(partial(update_registries, [dict(table) for table in REGISTRY_TABLES]))

    def measure(spec: WorkSpec) -> ResultRow:
        unit = WorkPrecisionUnit(spec, home)
        run = display.start_run(unit.title, unit.num_progress_steps, unit.cost_estimate)
        try:
            outcome = worker.run_task(partial(execute_timed, unit), run.report_tick, unit.task_limits)
        except TaskFailure as lost:
            outcome = unit.write_lost_rows(lost)
        run.finish_run(outcome)
        return parquet_rows.read_rows([home.rows_path(spec.build_file_stem())], ACCURACY_SCHEMA).to_pylist()[0]

    with folder_locks.lock_folder_exclusive(folder):
        # No run ends with this kind of cost, so no remaining time is estimated: the search omits most simulations.
        display.start_sweep([RunCost("omitted")] * len(work))
        try:
            yield measure
        finally:
            worker.stop_worker()
            display.finish_sweep()


def list_failed_units(paths: Sequence[Path]) -> list[str]:
    """Return a line for each failed unit: scene, size, snapshot, solver and reason.

    Other statuses are results.
    """
    found = [parquet_rows.read_rows([path], ACCURACY_SCHEMA).to_pylist()[0] for path in paths]
    return [
        f"{r['scene']} {r['size']} {r['snapshot'] or r['integrator']} {r['solver']}: {r['reason']}"
        for r in found
        if r["kind"] != "snapshot" and r["status"] in ("failed", "killed")
    ]


def _list_labels(spec: CurveSpec | WorkSpec) -> list[str]:
    return (
        [spec.build_file_stem(), spec.build_problem_stem()] if isinstance(spec, CurveSpec) else [spec.build_file_stem()]
    )


def _build_snapshot_units(curves: Sequence[CurveSpec], results: AccuracyResults) -> list[SnapshotUnit]:
    """Return one unit for each case."""
    moments: dict[str, CurveSpec] = {}
    for spec in curves:
        moments.setdefault(spec.build_problem_stem(), spec)
    cases: dict[str, list[CurveSpec]] = {}
    for spec in moments.values():
        cases.setdefault(_format_case(spec), []).append(spec)
    return [SnapshotUnit(tuple(specs), results) for specs in cases.values()]


def _format_case(spec: CurveSpec) -> str:
    return f"{spec.case.scene_name} {spec.case.build_identity()}"


def _build_curve_units(curves: Sequence[CurveSpec], results: AccuracyResults) -> Iterator[CurveUnit]:
    """Yield the units for the curves of each step.

    Where two snapshots of a case are the same step, only the first one yields units.
    """
    paths = dict.fromkeys(results.rows_path(spec.build_problem_stem()) for spec in curves)
    steps = parquet_rows.read_first_rows(
        paths, ("problem_digest", "snapshot", "frame", "status", "reason"), ACCURACY_SCHEMA
    )
    moments: dict[tuple[str, str], str] = {}
    for spec in curves:
        label = spec.build_problem_stem()
        step = steps.get(results.rows_path(label))
        if (
            isinstance(step, dict)
            and moments.setdefault((_format_case(spec), step["problem_digest"] or label), label) == label
        ):
            yield CurveUnit(spec, results, step)


def _build_work_units(work: Sequence[WorkSpec], results: AccuracyResults) -> Iterator[WorkPrecisionUnit]:
    for spec in sorted(work, key=lambda spec: (spec.case.scene_name, spec.case.size, spec.t_end)):
        yield WorkPrecisionUnit(spec, results)


def _plan_units(units: Sequence[CurveUnit | WorkPrecisionUnit], results: AccuracyResults) -> list[_PlannedUnit]:
    """Return the units and whether their rows match the request and the current step snapshot."""
    here = machine_info.describe_machine().machine_id

    def is_match(unit: CurveUnit | WorkPrecisionUnit, row: Mapping[str, Any]) -> bool:
        of_step = not isinstance(unit, CurveUnit) or row["problem_digest"] == unit.snapshot_row["problem_digest"]
        return of_step and row["unit_id"] == unit.spec.compute_unit_id(here)

    planned = {results.rows_path(unit.spec.build_file_stem()): partial(is_match, unit) for unit in units}
    found = read_completion_statuses(planned, ("unit_id", "problem_digest"), ACCURACY_SCHEMA)
    return [_PlannedUnit(unit, found[results.rows_path(unit.spec.build_file_stem())]) for unit in units]
