"""Locks on a results folder: exclusive for one process, or shared by several.

Processes that share a folder claim its units one by one.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path
from time import monotonic, sleep

from springbench.harness.atomic_files import open_lock_file
from springbench.harness.errors import InputError
from springbench.solvers.platform_calls import (
    LockMode,
    run_after_fork,
    try_lock_byte,
    try_lock_file,
    wait_for_lock,
)

DONE_ELSEWHERE, CLAIMED_ELSEWHERE = "was done by another command", "is left to another command"

_LOCK_TIMEOUT = 60.0
"""Seconds that the first or the last process may take to clean up, or to pack rows."""

_POLL_INTERVAL = 0.2
"""Seconds between two polls of other processes' results."""


@contextmanager
def lock_folder_exclusive(folder: Path) -> Generator[None]:
    """Lock a results folder exclusively, and remove incomplete files before and after.

    Raises:
        InputError: if another process has locked the folder.
    """
    with _open_folder_lock(folder) as lock:
        if not try_lock_file(lock, LockMode.EXCLUSIVE):
            raise InputError(f"{folder}: another springbench is running this sweep; wait for it or stop it")
        _remove_partial_files(folder)
        try:
            yield
        finally:
            _remove_partial_files(folder)  # files of killed workers


@contextmanager
def lock_folder_shared(folder: Path) -> Generator[None]:
    """Lock a results folder together with other processes.

    The first and the last process remove incomplete files.

    Raises:
        InputError: if one process has locked the folder exclusively.
    """
    with _open_folder_lock(folder) as lock:
        until = monotonic() + _LOCK_TIMEOUT
        while not (first := try_lock_file(lock, LockMode.EXCLUSIVE)) and not try_lock_file(lock, LockMode.SHARED):
            if monotonic() > until:
                raise InputError(f"{folder}: another springbench has locked it exclusively; wait for it or stop it")
            sleep(0.05)
        if first:
            _remove_partial_files(folder)
            wait_for_lock(lock, LockMode.SHARED)
        try:
            yield
        finally:
            if try_lock_file(lock, LockMode.EXCLUSIVE):
                _remove_partial_files(folder)


@contextmanager
def _open_folder_lock(folder: Path) -> Generator[int]:
    """Open the lock file of a folder."""
    lock = open_lock_file(folder / ".lock")
    _OPEN_LOCKS.add(lock)
    try:
        yield lock
    finally:
        _OPEN_LOCKS.discard(lock)
        os.close(lock)


def _remove_partial_files(folder: Path) -> None:
    for partial in folder.glob("*/.*partial*"):
        partial.unlink(missing_ok=True)


_OPEN_LOCKS: set[int] = set()


def _close_locks() -> None:
    """Close inherited locks in a forked process, which would otherwise block later processes."""
    while _OPEN_LOCKS:
        os.close(_OPEN_LOCKS.pop())


run_after_fork(_close_locks)


class UnitClaims:
    """Claims of this process on units of a shared folder.

    The first process to claim a unit computes it. A claim is a lock on one byte of `.claims` (POSIX record locks, which
    work on network file systems too). It is released when its process ends, however that happens. Units are files of
    rows. A unit whose file has changed since the start was finished by another process.
    """

    def __init__(self, folder: Path, units: Sequence[Path]) -> None:
        """Record the initial state of the units.

        Args:
            folder: folder of the sweep, in which `.claims` is created.
            units: row files of the units, which need not exist.
        """
        self._lock = open_lock_file(folder / ".claims")
        self._units = {path: _file_identity(path) for path in units}

    def try_claim(self, unit: Path) -> str:
        """Claim a unit; return "" on success, else DONE_ELSEWHERE or CLAIMED_ELSEWHERE."""
        if self._has_changed(unit):
            return DONE_ELSEWHERE
        place = int.from_bytes(sha256(unit.name.encode()).digest()[:7])
        if not try_lock_byte(self._lock, place):
            return CLAIMED_ELSEWHERE
        return (
            DONE_ELSEWHERE if self._has_changed(unit) else ""
        )  # another process may have finished it just before it released the lock

    def _has_changed(self, unit: Path) -> bool:
        return _file_identity(unit) != self._units[unit]

    def wait_for_any(self, units: Sequence[Path], poll: Callable[[], object] = int) -> None:
        """Wait until one of the units is finished elsewhere or can be claimed.

        Args:
            units: row files of the units.
            poll: called between two checks.
        """
        while units and all(self.try_claim(unit) == CLAIMED_ELSEWHERE for unit in units):
            poll()
            sleep(_POLL_INTERVAL)

    def close(self) -> None:
        """Release all claims."""
        os.close(self._lock)


def _file_identity(path: Path) -> tuple[int, int] | None:
    """Return inode and modification time [ns] of a file, or None if missing."""
    try:
        there = path.stat()
    except OSError:
        return None
    return there.st_ino, there.st_mtime_ns
