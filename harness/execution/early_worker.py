"""Worker that is started before the command line is imported.

It imports the libraries of a later task while this process imports those of the command.
"""

from __future__ import annotations

import atexit
import os
from collections.abc import Callable
from typing import Any

from springbench.harness.errors import RunFailed
from springbench.harness.execution.isolated_worker import IsolatedWorker, TaskFailure
from springbench.harness.execution.progress_events import ignore_progress
from springbench.harness.execution.worker_process import ProgressCallback, TaskFunction, TaskLimits
from springbench.solvers.platform_calls import can_isolate_processes

_EARLY_WORKERS = list[IsolatedWorker]()
"""The worker, if it was started; forks of this process have none."""
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_EARLY_WORKERS.clear)


def start_early_worker(initialiser: Callable[[], object]) -> None:
    """Start the worker if the system can isolate processes.

    Args:
        initialiser: imports what the task needs.
    """
    if can_isolate_processes():
        worker = IsolatedWorker(initialiser)
        worker.start_worker()
        atexit.register(worker.stop_worker)
        _EARLY_WORKERS.append(worker)


def take_early_worker(initialiser: Callable[[], object]) -> IsolatedWorker:
    """Return the early worker, which the caller stops, or a new one that starts now.

    Args:
        initialiser: what a new worker calls first.
    """
    if _EARLY_WORKERS:
        return _EARLY_WORKERS.pop()
    worker = IsolatedWorker(initialiser)
    worker.start_worker()
    return worker


def run_in_early_worker(task: TaskFunction, tick: ProgressCallback) -> Any:
    """Return the value of a task of the early worker.

    Without one, the task runs in this process.

    Args:
        task: function of the task; picklable.
        tick: progress callback of the task.

    Raises:
        RunFailed: the worker was lost. Errors of the project are raised unchanged.
    """
    if not _EARLY_WORKERS:
        return task(tick)
    try:
        return _EARLY_WORKERS[0].run_task(task, tick, TaskLimits())
    except TaskFailure as lost:
        raise RunFailed(f"the process that draws or records {lost}") from None


def wait_for_early_worker() -> None:
    """Wait until the early worker has imported its libraries, which would disturb timings."""
    run_in_early_worker(ignore_progress, ignore_progress)
