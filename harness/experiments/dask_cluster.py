# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyright: reportMissingTypeArgument=false, reportUnknownParameterType=false
# Dask has no type annotations.
"""Execute runs on many machines with Dask.

Each run is a task, in a separate process of a free worker. A worker executes one run at a time. Workers of one machine
wait for each other while one is timed (`springbench.harness.execution.timing_lock`). A run that crashes ends its
process and not Dask's worker, so failed runs do not use up the workers. The files of a run return with its outcome,
except where the worker shares the client's folder. If a worker is lost, its current run is repeated on another. A
worker that cannot write or has other source code gets no more runs.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager
from functools import partial
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic, sleep, time
from typing import Any, NamedTuple
from uuid import uuid4

import distributed
from distributed import Client, Future, KilledWorker
from distributed.utils import silence_logging_cmgr
from springbench.harness.atomic_files import WriteError, atomic_write
from springbench.harness.config.sweep_config import RunSpec
from springbench.harness.config.user_code import DEFAULT_LOAD_LIMITS
from springbench.harness.errors import InputError, InputMistake, RunFailed
from springbench.harness.execution import machine_info
from springbench.harness.execution.dask_scheduler import (
    CONNECT_TIMEOUT,
    DASK_LOG_LEVEL,
    MAX_QUEUE_WAITS,
    check_address,
    open_scheduler,
)
from springbench.harness.execution.isolated_worker import IsolatedWorker, ProgressCallback, TaskFailure, TaskLimits
from springbench.harness.execution.progress_display import ProgressDisplay, RunCost
from springbench.harness.experiments.experiment_units import REGISTRY_TABLES, execute_timed, update_registries
from springbench.harness.experiments.run_unit import RunUnit
from springbench.harness.experiments.sweep_plan import RunFiles
from springbench.solvers.plugins.plugin_discovery import PluginName, load_target

MAX_CLOCK_OFFSET = 60.0
"""Difference between the clocks of a worker and the client above which a message is printed [s]."""

_MAX_ATTEMPTS = 4
"""Largest number of attempts for a run whose worker is lost."""

_SCHEDULER_LOST_MESSAGE = "the scheduler was lost; completed results remain, and the same command resumes"

_WORKER_POLL_SECONDS, _TASK_POLL_SECONDS = 1.0, 0.05
"""Seconds between two queries of the workers; seconds between two queries of the tasks if none has finished."""

_QUEUED_TASKS_PER_THREAD = 4
"""Tasks queued at the scheduler per worker thread; more would use its memory without benefit."""


_VERSION_TITLES = {"source_fingerprint": "source code", "python_version": "Python", "dask_version": "distributed"}
"""Fields of WorkerInfo that must agree with this process, with their titles in messages."""


class WorkerInfo(NamedTuple):
    """Machine, versions and clock of a worker."""

    machine_id: str
    node_id: str
    source_fingerprint: str
    python_version: str
    dask_version: str
    clock_seconds: float

    @classmethod
    def from_this_process(cls) -> WorkerInfo:
        """Return the information about this process."""
        python = ".".join(map(str, sys.version_info[:2]))
        return cls(
            machine_info.describe_machine().machine_id,
            machine_info.compute_node_id(),
            machine_info.hash_sources(),
            python,
            version("distributed"),
            time(),
        )


class ClusterOutcome(NamedTuple):
    """Outcome of a run on a worker.

    Attributes:
        worker_address: address of the worker.
        message: outcome as text.
        files: content of the files that the run wrote, by name.
        worker_error: why this worker cannot execute runs; empty if it can.
    """

    worker_address: str
    message: str = ""
    files: Mapping[str, bytes] = {}
    worker_error: str = ""


class DaskCluster(NamedTuple):
    """Client of the workers, and the ids of their machines."""

    client: Client
    machine_ids: Sequence[str]

    def execute_units(
        self, folder: Path, display: ProgressDisplay, units: Sequence[RunUnit], skip_reason: Callable[[RunUnit], str]
    ) -> None:
        """Execute units on the workers (`execute_on_cluster`).

        Args:
            folder: folder of the sweep, which receives the files of the runs.
            display: shows progress.
            units: runs to execute.
            skip_reason: returns why another command has a unit, or an empty string (`execute_unclaimed`).

        Raises:
            InputError: the input is invalid.
            WriteError: no worker can write any more.
            RunFailed: the connection to the scheduler is lost.
        """
        execute_on_cluster(self.client, units, folder, display, skip_reason)


@contextmanager
def connect_cluster(
    scheduler_address: str, runs: Sequence[RunSpec], print_message: Callable[[str], None]
) -> Generator[DaskCluster]:
    """Connect to the workers of a scheduler, and yield the cluster.

    Args:
        scheduler_address: an address, a number of workers on this machine (`local:4`), or a file for a batch system.
        runs: runs to execute, whose plug-ins the workers must have.
        print_message: prints a remark.

    Raises:
        InputError: there is no scheduler, or no worker that can execute the runs.
    """
    with open_scheduler(scheduler_address) as address:
        try:
            if isinstance(address, str):
                check_address(address)
            client = Client(address, timeout=CONNECT_TIMEOUT, set_as_default=False)
        except (OSError, ValueError) as error:
            why = f"no scheduler answers within {CONNECT_TIMEOUT:g} s ({' '.join(str(error).split())[:200]})"
            raise InputError(
                InputMistake(f"{scheduler_address}: {why}; start one with `dask scheduler`", key="--scheduler")
            ) from None
        # Dask's log would print tracebacks in addition to the message about a lost scheduler.
        with silence_logging_cmgr(DASK_LOG_LEVEL), client, client.as_current():
            for waits in range(0 if address is scheduler_address else MAX_QUEUE_WAITS, -1, -1):
                try:
                    client.wait_for_workers(1, timeout=CONNECT_TIMEOUT)
                    break
                except TimeoutError:
                    if not waits:
                        why = (
                            "the scheduler has no worker; start some with `dask worker "
                            f"{scheduler_address} --nthreads 1`"
                        )
                        raise InputError(InputMistake(f"{scheduler_address}: {why}", key="--scheduler")) from None
                    print_message(f"{scheduler_address}: waiting for the first worker")
            yield DaskCluster(client, check_workers(client, runs, print_message))


def check_workers(client: Client, runs: Sequence[RunSpec], print_message: Callable[[str], None]) -> list[str]:
    """Check all workers and return the ids of their machines; print which clocks differ.

    Args:
        client: Dask client.
        runs: runs whose plug-ins are required.
        print_message: prints a remark.

    Raises:
        InputError: a worker has other versions, or lacks a plug-in.
    """
    here = WorkerInfo.from_this_process()
    before = time()
    plugins = list({plugin for run in runs for plugin in run.find_plugins()})
    answered: Any = client.run(_describe_worker, plugins, on_error="return")
    found: dict[str, Any] = answered
    problems = []
    for worker, answer in found.items():
        if isinstance(answer, OSError):
            print_message(f"the worker {worker} was lost: {answer}")
            continue
        if isinstance(answer, BaseException):
            problems.append(f"the worker {worker} cannot execute runs: {type(answer).__name__}: {answer}")
            continue
        about, missing = answer
        for field, title in _VERSION_TITLES.items():
            theirs, ours = getattr(about, field), getattr(here, field)
            if theirs != ours:
                problems.append(f"the worker {worker} has another version: {title} {theirs}, here {ours}")
        problems += [f"the worker {worker} has no {name}: {why}" for name, why in missing.items()]
        # The offset is zero if the worker's clock lies between the start of the query and now.
        off = about.clock_seconds - min(max(about.clock_seconds, before), time())
        if abs(off) > MAX_CLOCK_OFFSET:
            print_message(
                f"the clock of {worker} is {abs(off):.0f} s {'ahead' if off > 0 else 'behind'}, "
                "and so are the times in its rows"
            )
    if problems:
        raise InputError([InputMistake(problem, key="--scheduler") for problem in problems])
    answers = [answer for answer in found.values() if not isinstance(answer, OSError)]
    if not answers:
        raise InputError(InputMistake("all workers were lost; start new ones", key="--scheduler"))
    return sorted({about.machine_id for about, _ in answers})


def _describe_worker(plugins: Sequence[PluginName]) -> tuple[WorkerInfo, dict[str, str]]:
    """On a worker: return its description, and why plug-ins cannot be imported."""
    missing = dict[str, str]()
    if plugins:
        _allow_child_processes()
        process = IsolatedWorker(fork=False)
        try:
            missing = process.run_task(
                partial(_find_missing_plugins, plugins), lambda _: None, TaskLimits(*DEFAULT_LOAD_LIMITS)
            )
        except TaskFailure as lost:
            missing = {", ".join(plugins): f"the process that imports it {lost}"}
        finally:
            process.stop_worker()
    return WorkerInfo.from_this_process(), missing


def _find_missing_plugins(plugins: Sequence[PluginName], tick: ProgressCallback) -> dict[str, str]:
    missing = {}
    for plugin in plugins:
        try:
            load_target(plugin.import_target)
        except Exception as error:
            missing[str(plugin)] = f"{type(error).__name__}: {error}"
    return missing


def _allow_child_processes() -> None:
    """Allow child processes: Dask's nannies start workers as daemons, which may not have any.

    The children end with their parent.
    """
    multiprocessing.current_process()._config["daemon"] = False  # type: ignore[attr-defined]


def execute_on_cluster(
    client: Client,
    units: Sequence[RunUnit],
    folder: Path,
    display: ProgressDisplay,
    skip_reason: Callable[[RunUnit], str] = lambda unit: "",
) -> None:
    """Execute units on the workers of a client; their files are written to `folder`.

    Args:
        client: Dask client.
        units: runs to execute.
        folder: folder of the sweep.
        display: shows progress.
        skip_reason: returns why another command has a unit, or an empty string (`execute_unclaimed`).

    Raises:
        InputError: the input is invalid.
        WriteError: no worker can write any more.
        RunFailed: the connection to the scheduler is lost.
    """
    # A worker that sees this file shares the folder. A leftover is removed like other partial files.
    token = folder / "rows" / f".{uuid4().hex}.partial"
    left, tries, excluded = list(enumerate(units))[::-1], dict[int, int](), set[str]()
    threads, last_query_time = dict[str, int](), 0.0
    going: dict[Future, tuple[int, RunUnit]] = {}
    fixed = (
        folder.resolve(),
        f"rows/{token.name}",
        machine_info.hash_sources(),
        [dict(table) for table in REGISTRY_TABLES],
    )
    display.start_sweep([unit.cost_estimate for unit in units])
    looks = display.start_run(
        f"{len(units)} runs on {client.scheduler.address if client.scheduler else 'a cluster'}", 1, RunCost(amount=0.0)
    )
    try:
        token.touch()
        while left or going:
            if not threads or monotonic() - last_query_time > _WORKER_POLL_SECONDS:
                threads, last_query_time = _read_worker_threads(client), monotonic()
            workers = {name: many for name, many in threads.items() if name not in excluded}
            while left and len(going) < _QUEUED_TASKS_PER_THREAD * max(1, sum(workers.values())):
                number, unit = left.pop()
                if why := skip_reason(unit):
                    display.skip_run(unit.title, unit.cost_estimate, why)
                    continue
                key = f"springbench-{unit.run.title.replace(' ', '-')}-{uuid4().hex}"
                only = list(workers) if excluded and workers else None
                task = client.submit(_execute_run, unit, *fixed, key=key, pure=False, workers=only)
                going[task] = number, unit
            ended = [task for task in going if task.done()]
            if not ended:
                sleep(_TASK_POLL_SECONDS)
            looks.report_tick("")
            answers = _gather_outcomes(client, ended)
            for task in ended:
                number, unit = going.pop(task)
                last = tries.get(number, 1) >= _MAX_ATTEMPTS
                again = _finish_task(task, answers.get(task), unit, folder, display, excluded, is_last_attempt=last)
                if again:
                    tries[number] = tries.get(number, 1) + 1
                    left.append((number, unit))
            if excluded and not set(_read_worker_threads(client)) - excluded:
                raise WriteError(f"all workers have failed: {', '.join(sorted(excluded))}")
    finally:
        token.unlink(missing_ok=True)
        display.finish_sweep()


def _gather_outcomes(client: Client, ended: Sequence[Future]) -> dict[Future, ClusterOutcome]:
    """Fetch the outcomes of finished tasks together.

    Failed tasks are left out; the result is empty if a worker was lost meanwhile.
    """
    finished = [task for task in ended if task.status == "finished"]
    try:
        found: Any = client.gather(finished)
    except (KilledWorker, CancelledError):
        return {}
    except OSError:
        raise RunFailed(_SCHEDULER_LOST_MESSAGE) from None
    return dict(zip(finished, found, strict=True))


def _finish_task(
    future: Future,
    outcome: ClusterOutcome | None,
    unit: RunUnit,
    folder: Path,
    display: ProgressDisplay,
    excluded: set[str],
    *,
    is_last_attempt: bool,
) -> bool:
    """Store the files of a finished task, and return whether to repeat its run.

    `outcome` is the result if it has been fetched already; `is_last_attempt` excludes another attempt.
    """
    if future.status in ("cancelled", "lost"):
        raise RunFailed(_SCHEDULER_LOST_MESSAGE)
    run = display.start_run(unit.title, 1, unit.cost_estimate)
    try:
        done: ClusterOutcome = outcome or future.result()
    except KilledWorker as error:
        if is_last_attempt:
            run.finish_run(unit.write_lost_rows(TaskFailure("killed", f"all attempts lost their worker: {error}")))
        return not is_last_attempt
    if done.worker_error:
        excluded.add(done.worker_address)
        run.finish_run(f"is repeated by another worker: {done.worker_address} {done.worker_error}")
        return True
    for name, content in sorted(done.files.items(), key=lambda item: item[0].endswith(".parquet")):  # rows last
        with atomic_write(folder / name) as partial_name:
            partial_name.write_bytes(content)
    run.finish_run(done.message)
    return False


def _read_worker_threads(client: Client) -> dict[str, int]:
    """Return the number of threads of each worker. Raises RunFailed."""
    try:
        found: Any = client.nthreads()
    except OSError:
        raise RunFailed(_SCHEDULER_LOST_MESSAGE) from None
    return found


_IDLE_PROCESSES: list[IsolatedWorker] = []
"""Idle processes of this worker, which wait for their next run."""


def _execute_run(
    unit: RunUnit, folder: Path, shared_token: str, fingerprint: str, tables: Sequence[Mapping[str, str]]
) -> ClusterOutcome:
    """On a worker: execute one run in a separate process."""
    me = distributed.get_worker().address
    if machine_info.hash_sources() != fingerprint:
        return ClusterOutcome(me, worker_error=f"has other code, {machine_info.hash_sources()} and not {fingerprint}")
    _allow_child_processes()
    process = (
        _IDLE_PROCESSES.pop() if _IDLE_PROCESSES else IsolatedWorker(partial(update_registries, tables), fork=False)
    )
    try:
        with TemporaryDirectory(prefix="springbench-") as temporary:
            shared = (folder / shared_token).exists()
            place = folder if shared else Path(temporary)
            for part in ("rows", "recordings", "pictures"):
                (place / part).mkdir(exist_ok=True)
            here = RunUnit(unit.run, RunFiles.for_run(unit.run, place), None, unit.num_concurrent_runs)
            try:
                outcome = process.run_task(partial(execute_timed, here), lambda _: None, here.task_limits)
            except TaskFailure as lost:
                outcome = here.write_lost_rows(lost)
            made = [] if shared else [here.files.rows_path, here.files.recording_path]
            return ClusterOutcome(
                me, outcome, {os.path.relpath(path, place): path.read_bytes() for path in made if path.exists()}
            )
    except (WriteError, OSError) as error:
        return ClusterOutcome(me, worker_error=f"cannot write: {error}")
    finally:
        _IDLE_PROCESSES.append(process)
