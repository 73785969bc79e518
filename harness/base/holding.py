"""Locks on a results folder: exclusive for one process, or shared by several.

Processes that share a folder claim its units one by one.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path
from time import monotonic, sleep

from harness.base.errors import InputError
from harness.base.files import open_lock

DONE, TAKEN = "was done by another command", "is left to another command"

_PATIENCE = 5.0
"""Seconds that the first or the last process may take to clean up."""

_LOOK = 0.2
"""Seconds between two polls of other processes' results."""


@contextmanager
def alone(folder: Path) -> Generator[None]:
    """Lock a results folder exclusively, and remove incomplete files before and after.

    Raises:
        InputError: if another process has locked the folder.
    """
    with _opened(folder) as lock:
        if not _locked(lock, fcntl.LOCK_EX):
            raise InputError(f"{folder}: another springbench is running this sweep; wait for it or stop it")
        _remove_partial(folder)
        try:
            yield
        finally:
            _remove_partial(folder)  # of workers that were ended


@contextmanager
def together(folder: Path) -> Generator[None]:
    """Lock a results folder together with other processes.

    The first and the last process remove incomplete files.

    Raises:
        InputError: if one process has locked the folder exclusively.
    """
    with _opened(folder) as lock:
        until = monotonic() + _PATIENCE
        while not (first := _locked(lock, fcntl.LOCK_EX)) and not _locked(lock, fcntl.LOCK_SH):
            if monotonic() > until:
                raise InputError(f"{folder}: another springbench has it for itself; wait for it or stop it")
            sleep(0.05)
        if first:
            _remove_partial(folder)
            fcntl.flock(lock, fcntl.LOCK_SH)
        try:
            yield
        finally:
            if _locked(lock, fcntl.LOCK_EX):
                _remove_partial(folder)


@contextmanager
def _opened(folder: Path) -> Generator[int]:
    """Open the lock file of a folder."""
    lock = open_lock(folder / ".lock")
    _LOCKS.add(lock)
    try:
        yield lock
    finally:
        _LOCKS.discard(lock)
        os.close(lock)


def _locked(lock: int, how: int) -> bool:
    """Try to lock a file without waiting, and return whether it succeeded."""
    try:
        fcntl.flock(lock, how | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def _remove_partial(folder: Path) -> None:
    for partial in folder.glob("*/.*partial*"):
        partial.unlink(missing_ok=True)


_LOCKS: set[int] = set()


def _let_go() -> None:
    """Close inherited locks in a forked process, which would otherwise block later processes."""
    while _LOCKS:
        os.close(_LOCKS.pop())


os.register_at_fork(after_in_child=_let_go)


class Claims:
    """Claims of this process on units of a shared folder.

    The first process to claim a unit computes it.
    A claim is a lock on one byte of `.claims` (POSIX record locks, which work on network file systems too). It is
    released when its process ends, however that happens. Units are files of rows. A unit whose file has changed since
    the start was finished by another process.
    """

    def __init__(self, folder: Path, units: Sequence[Path]) -> None:
        """Record the initial state of the units, given as paths of their row files."""
        self._lock = open_lock(folder / ".claims")
        self._units = {path: _state(path) for path in units}

    def take(self, unit: Path) -> str:
        """Claim a unit; return "" on success, else DONE or TAKEN."""
        if self._changed(unit):
            return DONE
        place = int.from_bytes(sha256(unit.name.encode()).digest()[:7])
        try:
            fcntl.lockf(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, place)
        except OSError:
            return TAKEN
        return DONE if self._changed(unit) else ""  # it may have been done just before the lock was let go

    def _changed(self, unit: Path) -> bool:
        return _state(unit) != self._units[unit]

    def wait(self, units: Sequence[Path], look: Callable[[], object] = int) -> None:
        """Wait until one of the units is finished elsewhere or can be claimed.

        Args:
            units: row files of the units.
            look: called between two checks.
        """
        while units and all(self.take(unit) == TAKEN for unit in units):
            look()
            sleep(_LOOK)

    def close(self) -> None:
        """Release all claims."""
        os.close(self._lock)


def _state(path: Path) -> tuple[int, int] | None:
    """Return inode and modification time [ns] of a file, or None if missing."""
    try:
        there = path.stat()
    except OSError:
        return None
    return there.st_ino, there.st_mtime_ns
