"""What experiments have in common: units of work, of which those that are missing are done, each in a worker.

A unit is a file of rows, written when all of it is done. A unit that crashes, hangs or swells costs its worker and is a
row all the same. While one is timed the others wait; what is not timed is done side by side. A disk that is full ends
the experiment, and so do the user's mistakes.
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
"""At most so many workers: they take turns at being timed. And the memory [GiB] that there is to be for each."""


class Unit(Protocol):
    """What is measured at once, and stands in one file. It pickles."""

    @property
    def title(self) -> str:
        """The unit in words."""
        ...

    @property
    def ticks(self) -> int:
        """So many steps it tells of."""
        ...

    @property
    def effort(self) -> Effort:
        """What it takes, for the time left."""
        ...

    @property
    def limits(self) -> Limits:
        """What it may take."""
        ...

    def do(self, tick: Tick) -> str:
        """Measure, write the rows, and say in words what became of it. Raises InputError, CannotWrite."""
        ...

    def lost(self, lost: Lost) -> str:
        """Write the rows of one that gave no answer, and say so."""
        ...


U = TypeVar("U", bound=Unit)


@runtime_checkable
class Sharing(Protocol):
    """What units have that say themselves when they are timed (`harness.base.machine_lock`); others are as a whole."""

    @property
    def group(self) -> Hashable:
        """Units of one group share what is found once, and are left to one worker where that can be."""
        ...


@runtime_checkable
class Foreign(Protocol):
    """What units have that run code of others; a unit that runs none of it is done in another process."""

    @property
    def own(self) -> frozenset[Hashable]:
        """What tells that code from other code."""
        ...


class Filed(Unit, Protocol):
    """A unit that several commands may be about to do."""

    @property
    def place(self) -> Path:
        """The file of its rows."""
        ...


F = TypeVar("F", bound=Filed)


def do_together(
    todo: Sequence[F],
    claims: Claims,
    do: Callable[[Sequence[F], Callable[[F], str]], None],
    say: Callable[[str], None],
) -> None:
    """Do those of some units that no other command does; what one leaves undone is done here in the end.

    do: does units, asking of each, when its turn comes, why it is another's, empty where it is ours; say: prints a
    remark.
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
    """Do units; isolated: in workers, so many at once, else in this process, one after the other and without limits.

    another: see `do_together`. Nothing else of ours is done on the machine while a unit is timed. Raises InputError,
    CannotWrite.
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
    """As many as there are cores, less what the memory has no room for."""
    return max(1, min(machine.describe().cores, MOST, int(machine.describe().memory_gib / GIB_EACH)))


def watched(unit: Unit, tick: Tick) -> str:
    """What became of a unit; whoever is told of its steps is told what is compiled too."""
    with compiling_told(tick), nullcontext() if isinstance(unit, Sharing) else alone(tick):
        return unit.do(tick)


def require_threads(numbers: set[int]) -> None:
    """Refuse, before anything starts, what this machine cannot do. Raises InputError."""
    for number in numbers:
        machine.require_threads(number)


def ready(tables: Sequence[Mapping[str, str]]) -> None:
    """In a worker: know all names that are known here, those included that were added since."""
    for table, known in zip(TABLES, tables, strict=True):
        table.update(known)
