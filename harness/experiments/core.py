"""What experiments have in common: units of work, of which those that are missing are done, each in a worker.

A unit is a file of rows, written when all of it is done. A unit that crashes, hangs or swells costs its worker and is a
row all the same. A disk that is full ends the experiment, and so do the user's mistakes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Protocol

from harness.base import machine
from harness.base.progress import Display
from harness.base.workers import Executor, Here, Limits, Lost, Tick, Workers
from harness.scenes.effects.table import EFFECTS
from harness.scenes.mesh.table import MESHES
from solvers.registry import SOLVERS

_TABLES = (SOLVERS, EFFECTS, MESHES)


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
    def work(self) -> float:
        """Its effort, by a measure that is the same for all of an experiment."""
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


def do_all(todo: Sequence[Unit], display: Display, *, isolated: bool = True) -> None:
    """Do units one after the other; isolated: each in a worker, else in this process, without limits.

    Raises InputError, CannotWrite.
    """
    executor: Executor = Workers(partial(_ready, [dict(table) for table in _TABLES])) if isolated else Here()
    display.begin(len(todo), sum(unit.work for unit in todo))
    try:
        for unit in todo:
            display.run(unit.title, unit.ticks, unit.work)
            try:
                outcome = executor.do(unit.do, display.tick, unit.limits)
            except Lost as lost:
                outcome = unit.lost(lost)
            display.finished(outcome)
    finally:
        executor.end()
        display.end()


def require_threads(numbers: set[int]) -> None:
    """Refuse, before anything starts, what this machine cannot do. Raises InputError."""
    for number in numbers:
        machine.require_threads(number)


def _ready(tables: Sequence[Mapping[str, str]]) -> None:
    """In a worker: know all names that are known here, those included that were added since."""
    for table, known in zip(_TABLES, tables, strict=True):
        table.update(known)
