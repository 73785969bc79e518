"""Execute the missing units of an experiment, each in a worker process.

A unit is a file of rows, written once the whole unit has finished. A unit that crashes, hangs or exceeds its memory
costs its worker, and still yields a row. While one unit is timed the others wait; untimed work runs in parallel. A full
disk or invalid input ends the experiment.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Protocol, TypeVar, runtime_checkable

from springbench.harness.execution import machine_info
from springbench.harness.execution.folder_locks import CLAIMED_ELSEWHERE, UnitClaims
from springbench.harness.execution.garbage_collection import resume_collections
from springbench.harness.execution.isolated_worker import ProgressCallback, TaskFailure, TaskLimits
from springbench.harness.execution.progress_display import ProgressDisplay, RunCost, RunProgress, ThrottledMessages
from springbench.harness.execution.progress_events import report_compilation
from springbench.harness.execution.timing_lock import lock_timing_exclusive
from springbench.harness.execution.worker_pool import PoolTask, run_tasks
from springbench.harness.scenes.effects.effect_table import EFFECT_CLASSES
from springbench.harness.scenes.mesh.mesh_table import MESH_CLASSES
from springbench.solvers.registry import SOLVERS

REGISTRY_TABLES = (SOLVERS, EFFECT_CLASSES, MESH_CLASSES)

MAX_WORKERS, MEMORY_PER_WORKER_GIB = 8, 2.0
"""Largest number of workers, which are timed one at a time; memory required for each worker [GiB]."""


class ExperimentUnit(Protocol):
    """Unit of work that is measured as a whole and stored in one file; picklable."""

    @property
    def title(self) -> str:
        """Title of the unit, for messages."""
        ...

    @property
    def num_progress_steps(self) -> int:
        """Number of steps that the unit reports as progress."""
        ...

    @property
    def cost_estimate(self) -> RunCost:
        """Estimated cost, from which the remaining time is predicted."""
        ...

    @property
    def task_limits(self) -> TaskLimits:
        """Limits of time and memory."""
        ...

    def execute_unit(self, tick: ProgressCallback) -> str:
        """Measure, write the rows and return the outcome as text.

        Raises:
            InputError: the input is invalid.
            WriteError: the rows cannot be written.
        """
        ...

    def write_lost_rows(self, task_loss: TaskFailure) -> str:
        """Write the rows of a lost unit, and return the outcome as text."""
        ...


U = TypeVar("U", bound=ExperimentUnit)


@runtime_checkable
class SelfTimedUnit(Protocol):
    """Unit that acquires the timing lock itself (`springbench.harness.execution.timing_lock`).

    Any other unit is timed as a whole.
    """

    @property
    def affinity_group(self) -> Hashable:
        """Key of units that share cached results; one worker runs a group where possible."""
        ...


@runtime_checkable
class PluginUnit(Protocol):
    """Unit that runs user code; a unit without user code runs in another process."""

    @property
    def user_code(self) -> frozenset[Hashable]:
        """Identity of the user code."""
        ...


class StoredUnit(ExperimentUnit, Protocol):
    """Unit that several commands may try to execute at the same time."""

    @property
    def rows_path(self) -> Path:
        """File of the unit's rows."""
        ...


F = TypeVar("F", bound=StoredUnit)


def execute_unclaimed(
    todo: Sequence[F],
    claims: UnitClaims,
    execute_batch: Callable[[Sequence[F], Callable[[F], str]], None],
    print_message: Callable[[str], None],
) -> None:
    """Execute the units that no other command executes.

    Units that another command leaves unfinished are executed at the end.

    Args:
        todo: units to execute.
        claims: ownership of the row files in the results folder.
        execute_batch: executes units; calls its second argument for each unit, immediately before it starts. That
            function returns why another command has the unit, or an empty string.
        print_message: prints a remark.
    """
    remarks = ThrottledMessages(print_message)
    while todo:
        left: list[F] = []

        def claim_unit(unit: F, left: list[F] = left) -> str:
            why = claims.try_claim(unit.rows_path)
            if why == CLAIMED_ELSEWHERE:
                left.append(unit)
            return why

        execute_batch(todo, claim_unit)
        waits = f"waiting for other commands, which execute {len(left)} of these"
        claims.wait_for_any([unit.rows_path for unit in left], partial(remarks, waits))
        todo = left


def execute_units(
    todo: Sequence[U],
    display: ProgressDisplay,
    *,
    isolated: bool = True,
    num_workers: int = 1,
    skip_reason: Callable[[U], str] = lambda unit: "",
) -> None:
    """Execute units, in worker processes or in this process.

    The machine runs no other work of this command while a unit is timed.

    Args:
        todo: units to execute.
        display: shows progress.
        isolated: whether to use worker processes; otherwise units run here, one after the other and without limits.
        num_workers: number of units that run concurrently.
        skip_reason: returns why another command has a unit, or an empty string (`execute_unclaimed`).

    Raises:
        InputError: the input is invalid.
        WriteError: the rows cannot be written.
    """
    display.start_sweep([unit.cost_estimate for unit in todo], num_workers)
    runs: dict[int, RunProgress] = {}

    def start(number: int) -> PoolTask | None:
        unit = todo[number]
        if why := skip_reason(unit):
            display.skip_run(unit.title, unit.cost_estimate, why)
            return None
        run = runs[number] = display.start_run(unit.title, unit.num_progress_steps, unit.cost_estimate)
        own = unit.user_code if isinstance(unit, PluginUnit) else frozenset[Hashable]()
        return PoolTask(partial(execute_timed, unit), run.report_tick, unit.task_limits, user_code=own)

    try:
        if not isolated:
            for number in range(len(todo)):
                if task := start(number):
                    runs.pop(number).finish_run(task.function(task.tick))
            return
        groups = [unit.affinity_group if isinstance(unit, SelfTimedUnit) else None for unit in todo]
        tables = [dict(table) for table in REGISTRY_TABLES]
        for number, outcome in run_tasks(num_workers, partial(update_registries, tables), groups, start):
            outcome_text: str = todo[number].write_lost_rows(outcome) if isinstance(outcome, TaskFailure) else outcome
            runs.pop(number).finish_run(outcome_text)
    finally:
        display.finish_sweep()


def choose_num_workers() -> int:
    """Return the number of workers: the number of cores, limited by the available memory."""
    return max(
        1,
        min(
            machine_info.describe_machine().cores,
            MAX_WORKERS,
            int(machine_info.describe_machine().memory_gib / MEMORY_PER_WORKER_GIB),
        ),
    )


def execute_timed(unit: ExperimentUnit, tick: ProgressCallback) -> str:
    """Execute a unit, alone on the machine unless it times itself.

    Args:
        unit: unit to execute.
        tick: called with the unit's events, and those of compilation and of waiting for the machine.

    Returns:
        The outcome as text.
    """
    resume_collections()
    with report_compilation(tick), nullcontext() if isinstance(unit, SelfTimedUnit) else lock_timing_exclusive(tick):
        return unit.execute_unit(tick)


def require_threads(numbers: set[int]) -> None:
    """Raise InputError for thread numbers that this machine does not support."""
    for number in numbers:
        machine_info.check_thread_count(number)


def update_registries(tables: Sequence[Mapping[str, str]]) -> None:
    """Add the registered names of the parent process to a worker's tables."""
    for table, known in zip(REGISTRY_TABLES, tables, strict=True):
        table.update(known)
