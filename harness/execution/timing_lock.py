"""Timing lock of the machine: one exclusive timed run, or any number of untimed computations.

    lock_timing_exclusive   waits until nothing else computes, and blocks all others
    lock_timing_shared      waits while a run is timed exclusively, or waits for that
    reserve_cores           as lock_timing_shared, on cores reserved for this process

Runs that wait to be timed have priority. Processes that were timed therefore analyse their results together after the
timings, instead of each before the next one is timed. A process that prepares a timed run (`TimingSession`) counts as
waiting; otherwise two processes would alternate indefinitely, each preparing while the other one analyses. The locks
are files, which the system releases when a process dies. All commands and workers of a machine share them, in the
folder `SPRINGBENCH_LOCKS` or else in the folder for temporary files.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Generator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from time import sleep

from springbench.harness.atomic_files import open_lock_file
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.execution.progress_events import WAITING, ProgressCallback, report_activity
from springbench.solvers.platform_calls import (
    LockMode,
    list_usable_cores,
    pin_threads,
    try_lock_file,
    unlock_file,
    wait_for_lock,
)

_RETRY_SECONDS = 0.02
"""Seconds between two searches for a free core."""


@contextmanager
def lock_timing_exclusive(tick: ProgressCallback) -> Generator[None]:
    """Compute alone on the machine; tick reports the waiting time."""
    with _lock_context("wanted", LockMode.SHARED, tick), _lock_context("used", LockMode.EXCLUSIVE, tick):
        yield


@contextmanager
def lock_timing_shared(tick: ProgressCallback) -> Generator[None]:
    """Compute while no run is timed exclusively; tick reports the waiting time."""
    with _lock_context("wanted", LockMode.EXCLUSIVE, tick):  # timed runs have priority
        used = _acquire_lock("used", LockMode.SHARED, tick)
    try:
        yield
    finally:
        _release_locks(used)


class TimingSession:
    """Session of one timed run: preparation, timing (`lock_timing_exclusive`), and analysis of its result.

    Args:
        tick: progress callback, which reports the waiting time.
        exclusive: whether the run is timed alone. Otherwise it is timed on reserved cores (`reserve_cores`) without
            waiting for other sessions.
    """

    def __init__(self, tick: ProgressCallback, *, exclusive: bool) -> None:
        self._tick, self._exclusive = tick, exclusive
        self._coming, self._looking = ExitStack(), ExitStack()

    def __enter__(self) -> TimingSession:
        if self._exclusive:
            self._coming.enter_context(_lock_context("wanted", LockMode.SHARED, self._tick))
        return self

    def __exit__(self, *_: object) -> None:
        self._coming.close()
        self._looking.close()

    def lock_for_preparation(self) -> AbstractContextManager[None]:
        """Lock the machine for preparation before the timing."""
        return _lock_context("used", LockMode.SHARED, self._tick) if self._exclusive else lock_timing_shared(self._tick)

    def finish_timing(self) -> None:
        """End the priority for timing, and lock for shared computation.

        It is called after the timing, or if the run will not be timed.
        """
        self._coming.close()
        self._looking.close()
        self._looking.enter_context(lock_timing_shared(self._tick))


@contextmanager
def reserve_cores(number: int, tick: ProgressCallback) -> Generator[list[int]]:
    """Compute on cores that no other process has reserved.

    All threads of this process are pinned to them.

    Args:
        number: number of cores.
        tick: progress callback, which reports the waiting time.

    Yields:
        The numbers of the cores.

    Raises:
        ValueError: if this process may not use that many cores.
    """
    mine = list_usable_cores()
    if number > len(mine):
        raise ValueError(
            f"{number} cores are requested, and this process may use {len(mine)}; use at most {len(mine)} threads"
        )
    with lock_timing_shared(tick):
        claimed: dict[int, int] = {}
        try:
            claimed = _claim_free_cores(mine, number)
            if len(claimed) < number:
                with report_activity(tick, WAITING):
                    while len(claimed) < number:
                        _release_locks(*claimed.values())  # otherwise two processes with half of their cores deadlock
                        claimed = {}
                        sleep(_RETRY_SECONDS)
                        claimed = _claim_free_cores(mine, number)
            pin_threads(set(claimed))
            yield sorted(claimed)
        finally:
            pin_threads(set(mine))
            _release_locks(*claimed.values())


def _claim_free_cores(cores: list[int], limit: int) -> dict[int, int]:
    """Lock free cores, up to a limit, and return their lock files by core."""
    found: dict[int, int] = {}
    for core in cores:
        if len(found) == limit:
            break
        lock = _open_machine_lock(f"core-{core}")
        if try_lock_file(lock, LockMode.EXCLUSIVE):
            found[core] = lock
        else:
            os.close(lock)
    return found


@contextmanager
def _lock_context(name: str, mode: LockMode, tick: ProgressCallback) -> Generator[None]:
    lock = _acquire_lock(name, mode, tick)
    try:
        yield
    finally:
        _release_locks(lock)


def _acquire_lock(name: str, mode: LockMode, tick: ProgressCallback) -> int:
    lock = _open_machine_lock(name)
    try:
        if not try_lock_file(lock, mode):
            with report_activity(tick, WAITING):
                wait_for_lock(lock, mode)
    except BaseException:
        os.close(lock)
        raise
    return lock


def _release_locks(*locks: int) -> None:
    for lock in locks:
        unlock_file(lock)
        os.close(lock)


def _open_machine_lock(name: str) -> int:
    """Open a lock file that all users of the machine may lock.

    Raises:
        InputError: if that fails.
    """
    path = Path(os.environ.get("SPRINGBENCH_LOCKS") or tempfile.gettempdir()) / f"springbench-{name}.lock"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return open_lock_file(path, os.O_RDONLY, hint=", or set SPRINGBENCH_LOCKS to a folder of your own")
    except OSError as error:
        problem = f"{path.parent}: expected a folder in which files can be made ({error.strerror})"
        raise InputError(InputMistake(problem, key="SPRINGBENCH_LOCKS")) from error
