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

from harness.base.workers import Going, Limits, Lost, Piece, Tick, Workers

_LOOK = 0.1
"""Seconds between two polls of busy workers."""


class Task(NamedTuple):
    """One task: function, progress callback, limits, group, and the user code that it runs."""

    piece: Piece
    tick: Tick
    limits: Limits
    group: Hashable = None
    own: frozenset[Hashable] = frozenset()


Start = Callable[[int], Task | None]
"""Create the task of a given index; None if it is finished already or runs elsewhere."""


@dataclass
class _Member:
    workers: Workers
    group: Hashable = None
    number: int = -1
    going: Going | None = None

    def end(self) -> None:
        """Stop the running task and the worker."""
        if self.going:
            self.going.close()
        self.workers.end()


def done_by(
    members: int,
    ready: Callable[[], object],
    groups: Iterable[Hashable],
    start: Start,
    meanwhile: Callable[[], object] | None = None,
) -> Iterator[tuple[int, Any]]:
    """Run tasks in a pool of workers and yield each result as it is completed.

    Args:
        members: maximum number of concurrent workers.
        ready: called first in each worker.
        groups: group of each task, by index.
        start: called with the index of a task when a worker is available for it.
        meanwhile: called once in this process after the workers have started. No worker is polled until it
            returns.
    Yields: (index, value or Lost) in order of completion.
    Raises: the SpringbenchError that a task raises.

    Closing the generator stops the workers.
    """
    left = dict(enumerate(groups))
    with ExitStack() as cleanup:
        crew = [_Member(Workers(ready)) for _ in range(min(members, len(left)))]
        for member in crew:
            cleanup.callback(member.end)
        while True:
            for member in crew:
                while member.going is None and left:
                    number = _next(left, member, [other.group for other in crew if other is not member])
                    member.number, member.group = number, left.pop(number)
                    if task := start(number):
                        member.going = member.workers.doing(task.piece, task.tick, task.limits, task.own)
            going = [member for member in crew if member.going]
            if not going:
                return
            pipes = list[Connection]()
            for member in going:
                assert member.going
                try:
                    pipes.append(next(member.going))
                    continue
                except StopIteration as done:
                    outcome = done.value
                except Lost as lost:
                    outcome = lost
                member.going = None
                yield member.number, outcome
            if meanwhile:
                meanwhile()
                meanwhile = None
            elif len(pipes) == len(going):
                wait(pipes, _LOOK)


def _next(left: dict[int, Hashable], member: _Member, others: list[Hashable]) -> int:
    """Select the next task for a worker.

    A task of the worker's own group comes first, then one of a group that no other worker runs, then any.
    """
    grouped = {number: group for number, group in left.items() if group is not None}
    own = (number for number, group in grouped.items() if group == member.group)
    new = (number for number, group in grouped.items() if group not in others)
    return next(chain(own, new, left))
