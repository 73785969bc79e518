"""Execute the missing units of an experiment, each in a worker process.

A unit is a file of rows, written once the whole unit has finished. A unit that crashes, hangs or exceeds its memory
costs its worker, and still yields a row. While one unit is timed the others wait; untimed work runs in parallel. A full
disk ends the experiment, and so do errors of the user.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Protocol, TypeVar, runtime_checkable

from harness.base import machine
from harness.base.asides import compiling_told
from harness.base.crew import Task, done_by
from harness.base.holding import TAKEN, Claims
from harness.base.machine_lock import alone
from harness.base.progress import Display, Effort, Remarks, Run
from harness.base.workers import Limits, Lost, Tick
from harness.scenes.effects.effect_names import EFFECTS
from harness.scenes.mesh.mesh_names import MESHES
from solvers.registry import SOLVERS

TABLES = (SOLVERS, EFFECTS, MESHES)

MOST, GIB_EACH = 8, 2.0
"""Largest number of workers, which are timed one at a time; memory required for each worker [GiB]."""


class Unit(Protocol):
    """Unit of work that is measured as a whole and stored in one file; picklable."""

    @property
    def title(self) -> str:
        """Title of the unit, for messages."""
        ...

    @property
    def ticks(self) -> int:
        """Number of steps that the unit reports as progress."""
        ...

    @property
    def effort(self) -> Effort:
        """Estimated cost, from which the remaining time is predicted."""
        ...

    @property
    def limits(self) -> Limits:
        """Limits of time and memory."""
        ...

    def do(self, tick: Tick) -> str:
        """Measure, write the rows and return the outcome as text.

        Raises:
            InputError: the input is invalid.
            CannotWrite: the rows cannot be written.
        """
        ...

    def lost(self, lost: Lost) -> str:
        """Write the rows of a lost unit, and return the outcome as text."""
        ...


U = TypeVar("U", bound=Unit)


@runtime_checkable
class Sharing(Protocol):
    """Unit that acquires the timing lock itself (`harness.base.machine_lock`).

    Any other unit is timed as a whole.
    """

    @property
    def group(self) -> Hashable:
        """Key of units that share cached results; one worker runs a group where possible."""
        ...


@runtime_checkable
class Foreign(Protocol):
    """Unit that runs user code; a unit without user code runs in another process."""

    @property
    def own(self) -> frozenset[Hashable]:
        """Identity of the user code."""
        ...


class Filed(Unit, Protocol):
    """Unit that several commands may be about to execute."""

    @property
    def place(self) -> Path:
        """File of the unit's rows."""
        ...


F = TypeVar("F", bound=Filed)


def do_together(
    todo: Sequence[F],
    claims: Claims,
    do: Callable[[Sequence[F], Callable[[F], str]], None],
    say: Callable[[str], None],
) -> None:
    """Execute the units that no other command executes.

    Units that another command leaves unfinished are executed at the end.

    Args:
        todo: units to execute.
        claims: ownership of the row files in the results folder.
        do: executes units; calls its second argument for each unit, immediately before it starts. That
            function returns why another command has the unit, or an empty string.
        say: prints a remark.
    """
    remarks = Remarks(say)
    while todo:
        left: list[F] = []

        def another(unit: F, left: list[F] = left) -> str:
            why = claims.take(unit.place)
            if why == TAKEN:
                left.append(unit)
            return why

        do(todo, another)
        waits = f"waiting for other commands, which have {len(left)} of these at hand"
        claims.wait([unit.place for unit in left], partial(remarks, waits))
        todo = left


def do_all(
    todo: Sequence[U],
    display: Display,
    *,
    isolated: bool = True,
    at_once: int = 1,
    another: Callable[[U], str] = lambda unit: "",
) -> None:
    """Execute units, in worker processes or in this process.

    The machine runs no other work of this command while a unit is timed.

    Args:
        todo: units to execute.
        display: shows progress.
        isolated: whether to use worker processes; otherwise units run here, one after the other and without limits.
        at_once: number of units that run concurrently.
        another: returns why another command has a unit, or an empty string (`do_together`).

    Raises:
        InputError: the input is invalid.
        CannotWrite: the rows cannot be written.
    """
    display.begin([unit.effort for unit in todo], at_once)
    runs: dict[int, Run] = {}

    def start(number: int) -> Task | None:
        unit = todo[number]
        if why := another(unit):
            display.elsewhere(unit.title, unit.effort, why)
            return None
        run = runs[number] = display.run(unit.title, unit.ticks, unit.effort)
        own = unit.own if isinstance(unit, Foreign) else frozenset[Hashable]()
        return Task(partial(watched, unit), run.tick, unit.limits, own=own)

    try:
        if not isolated:
            for number in range(len(todo)):
                if task := start(number):
                    runs.pop(number).finished(task.piece(task.tick))
            return
        groups = [unit.group if isinstance(unit, Sharing) else None for unit in todo]
        tables = [dict(table) for table in TABLES]
        for number, outcome in done_by(at_once, partial(ready, tables), groups, start):
            told: str = todo[number].lost(outcome) if isinstance(outcome, Lost) else outcome
            runs.pop(number).finished(told)
    finally:
        display.end()


def workers_at_once() -> int:
    """Return the number of workers: the number of cores, limited by the available memory."""
    return max(1, min(machine.describe().cores, MOST, int(machine.describe().memory_gib / GIB_EACH)))


def watched(unit: Unit, tick: Tick) -> str:
    """Execute a unit and return its outcome; compilation is reported through `tick` too."""
    with compiling_told(tick), nullcontext() if isinstance(unit, Sharing) else alone(tick):
        return unit.do(tick)


def require_threads(numbers: set[int]) -> None:
    """Raise InputError for thread numbers that this machine does not support."""
    for number in numbers:
        machine.require_threads(number)


def ready(tables: Sequence[Mapping[str, str]]) -> None:
    """Add the registered names of the parent process to a worker's tables."""
    for table, known in zip(TABLES, tables, strict=True):
        table.update(known)
