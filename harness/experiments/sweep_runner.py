"""Execute the missing runs of a sweep, then draw the pictures that compare them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, suppress
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import pyarrow as pa
from springbench.harness.config.sweep_config import RunSpec
from springbench.harness.errors import InputError, InputMistake, RunFailed
from springbench.harness.execution import folder_locks, machine_info
from springbench.harness.execution.early_worker import take_early_worker
from springbench.harness.execution.folder_locks import UnitClaims
from springbench.harness.execution.isolated_worker import IsolatedWorker, TaskFailure, TaskLimits
from springbench.harness.execution.progress_display import ProgressDisplay
from springbench.harness.execution.progress_events import is_step_event
from springbench.harness.experiments.completion_status import select_missing_units
from springbench.harness.experiments.experiment_units import (
    choose_num_workers,
    execute_unclaimed,
    execute_units,
    require_threads,
)
from springbench.harness.experiments.kernel_precompilation import compile_missing_kernels
from springbench.harness.experiments.run_unit import RunUnit
from springbench.harness.experiments.sweep_plan import REQUIRED_COLUMNS, RunFiles, find_stale_run_ids, plan_runs
from springbench.harness.report.drawing_preload import preload_drawing
from springbench.harness.results import parquet_rows, row_store
from springbench.harness.scenes.scene_builder import build_scene
from springbench.harness.simulation.direct_solve_remarks import describe_inaccurate_solvers, solves_with_system_matrix
from springbench.solvers.plugins.plugin_discovery import PluginName, load_target
from springbench.solvers.registry import SOLVER_TABLE

if TYPE_CHECKING:
    from springbench.harness.experiments.dask_cluster import DaskCluster


_MAX_RUNS_TO_PRELOAD = 100
"""Largest number of runs for which the drawing code is preloaded: its start-up matters, and the rows are small."""


def _connect_cluster(
    scheduler_address: str, runs: Sequence[RunSpec], print_message: Callable[[str], None]
) -> AbstractContextManager[DaskCluster]:
    try:
        from springbench.harness.experiments.dask_cluster import connect_cluster
    except ModuleNotFoundError as error:
        raise InputError(
            InputMistake(f"needs {error.name}: pip install 'springbench[cluster]'", key="--scheduler")
        ) from None
    return connect_cluster(scheduler_address, runs, print_message)


class SweepResults(NamedTuple):
    """Results of a sweep.

    Attributes:
        table: rows of all runs.
        stale_ids: ids of the runs whose rows come from other source code.
    """

    table: pa.Table
    stale_ids: set[str]


class ExecutionOptions(NamedTuple):
    """Which runs of a sweep are executed, and by which processes.

    Attributes:
        rerun: whether to repeat all runs; `positions` implies it.
        rerun_stale: whether to repeat runs whose rows come from other source code.
        positions: where to store the positions of the sweep's only run.
        isolated: whether runs are executed in worker processes with limits, or in this process.
        num_workers: number of worker processes; chosen by cores and memory if None.
        scheduler_address: scheduler of other machines that execute the runs; None for this machine
            (`springbench.harness.experiments.dask_cluster`).
    """

    rerun: bool = False
    rerun_stale: bool = False
    positions: Path | None = None
    isolated: bool = True
    num_workers: int | None = None
    scheduler_address: str | None = None


DEFAULT_EXECUTION = ExecutionOptions()
"""Missing runs only, in worker processes of this machine."""


def run_sweep(
    name: str,
    runs: Sequence[RunSpec],
    folder: Path,
    display: ProgressDisplay,
    print_message: Callable[[str], None],
    execution: ExecutionOptions = DEFAULT_EXECUTION,
    *,
    background_call: Callable[[], object] = int,
) -> SweepResults:
    """Execute the missing runs of a sweep, draw its pictures and return its results.

    Rows of many runs are packed into one file (`springbench.harness.experiments.archive.compaction`).

    Args:
        name: name of the sweep.
        runs: its runs.
        folder: its folder in the results.
        display: shows progress.
        print_message: prints a remark.
        execution: which runs are executed, and by which processes.
        background_call: called while another process draws.

    Returns:
        The rows of all runs, and the ids of the stale ones.

    Raises:
        InputError: the options contradict each other, or the input is invalid.
        RunFailed: the drawing process was lost.
    """
    positions, isolated, scheduler_address = execution.positions, execution.isolated, execution.scheduler_address
    if scheduler_address and (positions or not isolated):
        given = [name for name, is_set in (("--positions", positions), ("--in-process", not isolated)) if is_set]
        raise InputError(
            f"{' and '.join(given)} cannot be combined with --scheduler, which executes the runs elsewhere; "
            "omit one or the other"
        )
    if positions and len(runs) != 1:
        raise InputError(f"--positions stores the positions of one run; this is {len(runs)} runs")
    if not scheduler_address:
        require_threads({machine_info.choose_threads(run.threads).count for run in runs})
    for part in ("rows", "recordings", "pictures"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    with ExitStack() as locks:
        locks.enter_context(folder_locks.lock_folder_shared(folder))
        away = (
            locks.enter_context(_connect_cluster(scheduler_address, runs, print_message)) if scheduler_address else None
        )
        machines = away.machine_ids if away else (None,)
        claims = locks.enter_context(
            closing(UnitClaims(folder, [RunFiles.for_run(r, folder, m).rows_path for r in runs for m in machines]))
        )
        planned = plan_runs(runs, folder, machines)
        todo = select_missing_units(
            planned,
            "runs",
            print_message,
            rerun=execution.rerun or positions is not None,
            rerun_stale=execution.rerun_stale,
        )
        drawing: IsolatedWorker | None = None
        here = isolated and not away
        if here and len(runs) <= _MAX_RUNS_TO_PRELOAD and any(p.run.record and p.run.pictures for p in todo):
            drawing = take_early_worker(preload_drawing)
            locks.callback(drawing.stop_worker)
        if todo and not away:
            import_module(
                "springbench.harness.experiments.run_pipeline"
            )  # imported before workers fork, so that they inherit it
            for solver in {p.run.solver.name: None for p in todo if not isinstance(p.run.solver.name, PluginName)}:
                load_target(SOLVER_TABLE[solver])
            if isolated:
                compile_missing_kernels({p.run.solver.name for p in todo}, print_message)
        for remark in describe_inaccurate_runs([p.run for p in todo]):
            print_message(remark)
        many = min(execution.num_workers or choose_num_workers(), max(1, len(todo)))
        units = [RunUnit(p.run, p.files, positions, 1 if p.run.timing == "exclusive" else many) for p in todo]
        if away:
            execute_unclaimed(units, claims, partial(away.execute_units, folder, display), print_message)
            planned = plan_runs(runs, folder, machines)
        else:
            do_here = partial(execute_units, display=display, isolated=isolated, num_workers=many)
            execute_unclaimed(
                units, claims, lambda some, skip_reason: do_here(some, skip_reason=skip_reason), print_message
            )
        from springbench.harness.report.sweep_pictures import PictureJob, draw_sweep_pictures

        table = parquet_rows.read_rows([p.files.rows_path for p in planned], required_columns=REQUIRED_COLUMNS)
        stale_ids = find_stale_run_ids(runs, table)
        pictured = [PictureJob(p.run, p.files.recording_path, p.files.picture_path) for p in planned]
        draw = partial(
            draw_sweep_pictures,
            name,
            pictured,
            folder,
            table,
            num_concurrent=many,
            stale_ids=stale_ids,
        )
        if drawing is None:
            draw(print_message)
        else:
            _draw_in_process(drawing, draw, print_message, background_call)
    if row_store.has_many_files(folder / "rows"):
        from springbench.harness.experiments.archive.compaction import compact_sweep

        compact_sweep(folder, print_message)
    return SweepResults(table, stale_ids)


def _draw_in_process(
    drawing: IsolatedWorker,
    draw: Callable[[Callable[[str], None]], None],
    print_message: Callable[[str], None],
    background_call: Callable[[], object],
) -> None:
    """Draw the pictures in another process; raise RunFailed if it is lost."""
    try:
        drawing.run_task(
            draw,
            lambda message: print_message(message) if is_step_event(message) else None,
            TaskLimits(),
            background_call,
        )
    except TaskFailure as lost:
        raise RunFailed(
            f"the process that draws {lost}; measured results remain, and the same command draws them"
        ) from None


def describe_inaccurate_runs(runs: Iterable[RunSpec]) -> Iterator[str]:
    """Describe the solvers that keep few digits of the positions, for each scene.

    The smallest size of a scene is examined.

    Args:
        runs: runs that are about to start; those with user code are ignored.

    Yields:
        A line for a scene and time step, with the solvers, the cause and a remedy.
    """
    concerned: dict[tuple[str, float], list[RunSpec]] = defaultdict(list)
    for run in runs:
        if not run.find_plugins() and solves_with_system_matrix(run.solver.name, run.solver.parameters):
            concerned[run.scene_name, run.scene.time_step].append(run)
    for (name, _), some in concerned.items():
        least = min(some, key=lambda run: run.size)
        with suppress(InputError):  # the run reports it
            scene = build_scene(least.scene, least.size, least.integrator, log_warnings=False)
            if remark := describe_inaccurate_solvers(scene, dict.fromkeys(run.solver.name for run in some)):
                yield f"{name}: {remark}"


def list_failed_runs(table: pa.Table) -> list[str]:
    """Return a line for each failed run: scene, size, solver, status and reason."""
    ended = table.select(["scene", "size", "solver", "status", "reason"]).to_pylist()
    failed = [row for row in ended if row["status"] != "ok"]
    lines = [f"{r['scene']} {r['size']} {r['solver']}: {r['status']}: {r['reason']}" for r in failed]
    return list(dict.fromkeys(lines))  # a finished run has a row for each step
