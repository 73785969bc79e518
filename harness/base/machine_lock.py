"""Timing lock of the machine: one exclusive timed run, or any number of untimed computations.

    alone   waits until nothing else computes, and blocks all others
    beside      waits while a run is timed exclusively, or waits for that
    own_cores           as beside, on cores reserved for this process

Runs that wait to be timed have priority. Processes that were timed therefore analyse their results concurrently, and
not each before the next one is timed. A process that prepares a timed run (`Turn`) counts as waiting;
otherwise two processes would alternate indefinitely, each preparing while the other one analyses. The locks are files,
which the system releases when a process dies. All commands and workers of a machine share them, in the folder
`SPRINGBENCH_LOCKS` or else in the folder for temporary files.
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
"""Seconds between two searches for a free core."""


@contextmanager
def alone(tick: Tick) -> Generator[None]:
    """Compute alone on the machine; tick reports the waiting time."""
    with _held("wanted", fcntl.LOCK_SH, tick), _held("used", fcntl.LOCK_EX, tick):
        yield


@contextmanager
def beside(tick: Tick) -> Generator[None]:
    """Compute while no run is timed exclusively; tick reports the waiting time."""
    with _held("wanted", fcntl.LOCK_EX, tick):  # nobody who would be timed waits
        used = _locked("used", fcntl.LOCK_SH, tick)
    try:
        yield
    finally:
        _let_go(used)


class Turn:
    """Session of one timed run: preparation, timing (`alone`), and analysis of its result.

    exclusive: whether the run is timed alone. Otherwise it is timed on reserved cores (`own_cores`) without waiting
    for other sessions.
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
        """Lock the machine for preparation before the timing."""
        return _held("used", fcntl.LOCK_SH, self._tick) if self._exclusive else beside(self._tick)

    def look(self) -> None:
        """End the priority for timing, and lock for shared computation.

        It is called after the timing, or if the run will not be timed.
        """
        self._coming.close()
        self._looking.close()
        self._looking.enter_context(beside(self._tick))


@contextmanager
def own_cores(number: int, tick: Tick) -> Generator[list[int]]:
    """Compute on cores that no other process has reserved.

    All threads of this process are pinned to them.

    Args:
        number: number of cores.
        tick: progress callback, which reports the waiting time.
    Yields: the numbers of the cores.
    Raises:
        ValueError: if this process may not use that many cores.
    """
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
    """Lock free cores, up to a limit, and return their lock files by core."""
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
    """Pin all threads of this process to the given cores."""
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
    """Open a lock file that all users of the machine may lock.

    Raises:
        InputError: if that fails.
    """
    path = Path(os.environ.get("SPRINGBENCH_LOCKS") or tempfile.gettempdir()) / f"springbench-{name}.lock"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return open_lock(path, os.O_RDONLY, otherwise=", or set SPRINGBENCH_LOCKS to a folder of your own")
    except OSError as error:
        problem = f"{path.parent}: expected a folder in which files can be made ({error.strerror})"
        raise InputError(Mistake(problem, key="SPRINGBENCH_LOCKS")) from error
