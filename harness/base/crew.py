"""Several pieces of work at once, each in a worker of its own, from one thread.

A worker does pieces of one group one after the other where it can, because they share what is found once: a reference
motion, a mesh.
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
"""Seconds between two looks at workers that are at work."""


class Task(NamedTuple):
    """A piece of work, what it may take, to whom it ticks, its group, and the code of others that it runs."""

    piece: Piece
    tick: Tick
    limits: Limits
    group: Hashable = None
    own: frozenset[Hashable] = frozenset()


Start = Callable[[int], Task | None]
"""What to do of the task of a number: None where it is done already, or by somebody else."""


@dataclass
class _Member:
    workers: Workers
    group: Hashable = None
    number: int = -1
    going: Going | None = None

    def end(self) -> None:
        """Stop what it does."""
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
    """Do tasks by so many workers; yields (number, value or Lost) of each that is done, in that order.

    ready: called in each worker before anything else; groups: of the tasks, by number; start: see there, called when a
    task's turn comes; meanwhile: done here once the workers have begun, and nothing is looked at as long as it takes.
    Raises what a piece raises. Whoever stops asking ends the workers.
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
    """The next task of the worker's own group, else of one that nobody is at, else any."""
    grouped = {number: group for number, group in left.items() if group is not None}
    own = (number for number, group in grouped.items() if group == member.group)
    new = (number for number, group in grouped.items() if group not in others)
    return next(chain(own, new, left))
