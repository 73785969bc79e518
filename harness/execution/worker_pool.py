"""Worker pool: run several tasks concurrently, each in its own worker process, from one thread.

Where possible a worker runs tasks of one group one after the other, because they share cached data such as a reference
trajectory or a mesh.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import chain
from multiprocessing.connection import Connection, wait
from typing import Any, NamedTuple

from springbench.harness.execution.isolated_worker import (
    IsolatedWorker,
    ProgressCallback,
    RunningTask,
    TaskFailure,
    TaskFunction,
    TaskLimits,
)

_POLL_INTERVAL = 0.1
"""Seconds between two polls of busy workers."""


class PoolTask(NamedTuple):
    """One task: function, progress callback, limits, group, and the user code that it runs."""

    function: TaskFunction
    tick: ProgressCallback
    limits: TaskLimits
    group: Hashable = None
    user_code: frozenset[Hashable] = frozenset()


TaskFactory = Callable[[int], PoolTask | None]
"""Create the task of a given index; None if it is finished already or runs elsewhere."""


@dataclass
class _PoolWorker:
    process: IsolatedWorker
    group: Hashable = None
    number: int = -1
    running_task: RunningTask | None = None

    def stop_worker(self) -> None:
        """Stop the running task and the worker."""
        if self.running_task:
            self.running_task.close()
        self.process.stop_worker()


def run_tasks(
    num_workers: int,
    initialiser: Callable[[], object],
    groups: Iterable[Hashable],
    create_task: TaskFactory,
    background_call: Callable[[], object] | None = None,
) -> Iterator[tuple[int, Any]]:
    """Run tasks in a pool of workers and yield each result as it is completed.

    Closing the generator stops the workers.

    Args:
        num_workers: maximum number of concurrent workers.
        initialiser: called first in each worker.
        groups: group of each task, by index.
        create_task: called with the index of a task when a worker is available for it.
        background_call: called once in this process after the workers have started. No worker is polled until it
            returns.

    Yields:
        (index, value or TaskFailure) in order of completion.

    Raises:
        SpringbenchError: a task raised it.
    """
    left = dict(enumerate(groups))
    with ExitStack() as cleanup:
        workers = [_PoolWorker(IsolatedWorker(initialiser)) for _ in range(min(num_workers, len(left)))]
        for worker in workers:
            cleanup.callback(worker.stop_worker)
        while True:
            for worker in workers:
                while worker.running_task is None and left:
                    number = _select_task(left, worker, [other.group for other in workers if other is not worker])
                    worker.number, worker.group = number, left.pop(number)
                    if task := create_task(number):
                        worker.running_task = worker.process.start_task(
                            task.function, task.tick, task.limits, task.user_code
                        )
            going = [worker for worker in workers if worker.running_task]
            if not going:
                return
            pipes = list[Connection]()
            for worker in going:
                assert worker.running_task
                try:
                    pipes.append(next(worker.running_task))
                    continue
                except StopIteration as done:
                    outcome = done.value
                except TaskFailure as lost:
                    outcome = lost
                worker.running_task = None
                yield worker.number, outcome
            if background_call:
                background_call()
                background_call = None
            elif len(pipes) == len(going):
                wait(pipes, _POLL_INTERVAL)


def _select_task(left: dict[int, Hashable], worker: _PoolWorker, others: list[Hashable]) -> int:
    """Select the next task for a worker.

    A task of the worker's own group comes first, then one of a group that no other worker runs, then any.
    """
    grouped = {number: group for number, group in left.items() if group is not None}
    own = (number for number, group in grouped.items() if group == worker.group)
    new = (number for number, group in grouped.items() if group not in others)
    return next(chain(own, new, left))
