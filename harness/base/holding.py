"""Who works in a folder of results: one process alone, or several together that claim units one by one."""

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
"""Seconds that whoever comes first or last may take to clean up."""

_LOOK = 0.2
"""Seconds between two looks at what others do."""


@contextmanager
def alone(folder: Path) -> Generator[None]:
    """Hold a folder of results for one process; whatever is left half written is removed. Raises InputError."""
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
    """Hold a folder beside other processes that do; the first and the last remove what is left half written. Raises
    InputError where one has it for itself."""
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
    """The file by which a folder is held."""
    lock = open_lock(folder / ".lock")
    _LOCKS.add(lock)
    try:
        yield lock
    finally:
        _LOCKS.discard(lock)
        os.close(lock)


def _locked(lock: int, how: int) -> bool:
    """Whether it could be locked at once."""
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
    """A copy of this process holds no folder, and so holds up nobody who comes after this one."""
    while _LOCKS:
        os.close(_LOCKS.pop())


os.register_at_fork(after_in_child=_let_go)


class Claims:
    """Which units of a folder this process does, where several share the folder: the first to come has a unit.

    A claim is a lock on one byte of `.claims` (POSIX record locks, which hold on network file systems too), and goes
    with its process, however that ends. Units are files of rows; one whose file is another than at first was done by
    somebody else since.
    """

    def __init__(self, folder: Path, units: Sequence[Path]) -> None:
        """units: their files of rows."""
        self._lock = open_lock(folder / ".claims")
        self._units = {path: _state(path) for path in units}

    def take(self, unit: Path) -> str:
        """Claim a unit; empty where it is this process's now, DONE or TAKEN where it is not."""
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
        """Until one of them was done by somebody else, or may be claimed. look: called now and then."""
        while units and all(self.take(unit) == TAKEN for unit in units):
            look()
            sleep(_LOOK)

    def close(self) -> None:
        """Give all claims back."""
        os.close(self._lock)


def _state(path: Path) -> tuple[int, int] | None:
    """What tells a file from one that takes its place."""
    try:
        there = path.stat()
    except OSError:
        return None
    return there.st_ino, there.st_mtime_ns
