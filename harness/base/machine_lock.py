"""Who computes on this machine at a time: one that is timed, alone, or any number of those that are not.

    alone    waits until nobody computes, and keeps all others waiting
    beside   waits while somebody is timed alone, or waits for it
    own_cores   as `beside`, on cores that nobody else has

Whoever wants to be timed goes first, so that those who were timed look at what they found side by side and not each
before the next is timed. Who gets ready for it (`Turn`) counts among them, or two would take turns for ever, each
getting ready while the other looks. The locks are files, which the system lets go of where a process dies; they are
the same for all commands and workers of a machine: in the folder `SPRINGBENCH_LOCKS`, else in that for temporary files.
"""

from __future__ import annotations

import fcntl
import os
import tempfile
from collections.abc import Generator
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from pathlib import Path
from time import sleep

from harness.base.asides import WAITING, Tick, aside
from harness.base.errors import InputError, Mistake
from harness.base.files import open_lock

_PAUSE = 0.02
"""Seconds between two looks for a free core."""


@contextmanager
def alone(tick: Tick) -> Generator[None]:
    """Be the only one on the machine. tick: is told while this waits."""
    with _held("wanted", fcntl.LOCK_SH, tick), _held("used", fcntl.LOCK_EX, tick):
        yield


@contextmanager
def beside(tick: Tick) -> Generator[None]:
    """Compute while nobody is timed. tick: is told while this waits."""
    with _held("wanted", fcntl.LOCK_EX, tick):  # nobody who would be timed waits
        used = _locked("used", fcntl.LOCK_SH, tick)
    try:
        yield
    finally:
        _let_go(used)


class Turn:
    """The turn of one that is timed alone: it gets ready, is timed (`alone`), and looks at what was found.

    exclusive: else it is timed beside others (`own_cores`), and waits for nobody's turn.
    """

    def __init__(self, tick: Tick, *, exclusive: bool) -> None:
        self._tick, self._exclusive = tick, exclusive
        self._coming, self._looking = ExitStack(), ExitStack()

    def __enter__(self) -> Turn:
        if self._exclusive:
            self._coming.enter_context(_held("wanted", fcntl.LOCK_SH, self._tick))
        return self

    def __exit__(self, *_: object) -> None:
        self._coming.close()
        self._looking.close()

    def ready(self) -> AbstractContextManager[None]:
        """Compute before it is timed."""
        return _held("used", fcntl.LOCK_SH, self._tick) if self._exclusive else beside(self._tick)

    def look(self) -> None:
        """Compute beside others from now on: it was timed, or will not be."""
        self._coming.close()
        self._looking.close()
        self._looking.enter_context(beside(self._tick))


@contextmanager
def own_cores(number: int, tick: Tick) -> Generator[list[int]]:
    """Compute beside others, kept to so many cores that are nobody else's, by number. Raises ValueError where this
    process may not use as many."""
    mine = sorted(os.sched_getaffinity(0))
    if number > len(mine):
        raise ValueError(f"{number} cores of {len(mine)}")
    with beside(tick):
        claimed: dict[int, int] = {}
        try:
            claimed = _free(mine, number)
            if len(claimed) < number:
                with aside(tick, WAITING):
                    while len(claimed) < number:
                        _let_go(*claimed.values())  # or two that have half of what they want wait for each other
                        claimed = {}
                        sleep(_PAUSE)
                        claimed = _free(mine, number)
            _keep_to(set(claimed))
            yield sorted(claimed)
        finally:
            _keep_to(set(mine))
            _let_go(*claimed.values())


def _free(cores: list[int], most: int) -> dict[int, int]:
    """Locks of cores that nobody has, at most so many."""
    found: dict[int, int] = {}
    for core in cores:
        if len(found) == most:
            break
        lock = _opened(f"core-{core}")
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            found[core] = lock
        except BlockingIOError:
            os.close(lock)
    return found


def _keep_to(cores: set[int]) -> None:
    """Let all threads of this process run on these cores alone."""
    for thread in os.listdir("/proc/self/task"):
        with suppress(OSError):  # it has ended
            os.sched_setaffinity(int(thread), cores)


@contextmanager
def _held(name: str, how: int, tick: Tick) -> Generator[None]:
    lock = _locked(name, how, tick)
    try:
        yield
    finally:
        _let_go(lock)


def _locked(name: str, how: int, tick: Tick) -> int:
    lock = _opened(name)
    try:
        try:
            fcntl.flock(lock, how | fcntl.LOCK_NB)
        except BlockingIOError:
            with aside(tick, WAITING):
                fcntl.flock(lock, how)
    except BaseException:
        os.close(lock)
        raise
    return lock


def _let_go(*locks: int) -> None:
    for lock in locks:
        fcntl.flock(lock, fcntl.LOCK_UN)  # copies that this process has made of itself have it open too
        os.close(lock)


def _opened(name: str) -> int:
    """A lock's file, which all users of the machine may lock. Raises InputError."""
    path = Path(os.environ.get("SPRINGBENCH_LOCKS") or tempfile.gettempdir()) / f"springbench-{name}.lock"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return open_lock(path, os.O_RDONLY, otherwise=", or set SPRINGBENCH_LOCKS to a folder of your own")
    except OSError as error:
        problem = f"{path.parent}: expected a folder in which files can be made ({error.strerror})"
        raise InputError(Mistake(problem, key="SPRINGBENCH_LOCKS")) from error
