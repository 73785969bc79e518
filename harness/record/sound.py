"""Integrity check of recordings: whether a file is complete and whether it can be read.

A recording is a header of 12 bytes and a sequence of messages. Each message is a kind and a length of 8 bytes each,
then that many bytes of payload. The library aborts the process on some damaged files. A file that this process has not
written is therefore first read in the child process of `harness.base.child`.

Files that can be read are noted in the user's cache folder, for all processes, since reading a whole recording takes
far longer than what a report needs from it. A note identifies the state of a file by its inode, size and times; the
change time is set by the system and cannot be forged. Notes are not stored with the results, which may come from
any source.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path

from harness.base import child
from harness.base.errors import InputError, Mistake
from harness.base.files import users_cache

_HEADER, _END = 12, 0

_SECONDS, _BYTES_PER_SECOND = 10.0, 1e7
_MEMORY, _MEMORY_PER_BYTE = 2**30, 8
"""Time [s] and memory [bytes] limits to read a recording, as functions of its size; it is compressed."""

_NOTED = 2**21
"""Size [bytes] of the notes from which on they are discarded."""

_sound: set[bytes] = set()
"""Hashes of the file states that have been read successfully."""

_read: dict[Path, int] = {}
"""Number of bytes of notes that have been read, by file."""


def trust(path: Path, *, noted: bool = True) -> None:
    """Mark a recording in its present state as readable.

    Args:
      path: path of the recording.
      noted: whether other processes see the mark too.
    """
    _sound.add(state := _state(path))
    if noted:
        with suppress(OSError):  # then it is found out again
            notes = _notes()
            notes.parent.mkdir(parents=True, exist_ok=True)
            file = os.open(notes, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o600)
            try:
                if os.fstat(file).st_size > _NOTED:
                    os.truncate(file, 0)
                os.write(file, state)
            finally:
                os.close(file)


def _trusted(path: Path) -> bool:
    state = _state(path)
    if state not in _sound:
        with suppress(OSError):
            notes = _notes()
            size, begin = notes.stat().st_size, _read.get(notes, 0)
            if size != begin:
                with notes.open("rb") as file:
                    file.seek(begin if size > begin else 0)
                    found = file.read()
                _sound.update(found[k : k + len(state)] for k in range(0, len(found), len(state)))
                _read[notes] = size
    return state in _sound


def _notes() -> Path:
    return users_cache("recordings") / f"sound-{_library()}"


@cache
def _library() -> str:
    """Return the version of the library that reads recordings; another version may not read them."""
    return version("rerun-sdk")


def _state(path: Path) -> bytes:
    found = path.stat()
    known = found.st_dev, found.st_ino, found.st_mtime_ns, found.st_ctime_ns, found.st_size
    return sha256(repr(known).encode()).digest()[:16]


def whole_messages(path: Path) -> tuple[bool, int]:
    """Find the end of the last complete message.

    Returns: whether the file has its end mark, and the offset [bytes] of the end of its last complete message.
    """
    size, place = path.stat().st_size, _HEADER
    with path.open("rb") as file:
        while place + 16 <= size:
            file.seek(place)
            kind, length = struct.unpack("<QQ", file.read(16))
            if place + 16 + length > size:
                break
            if kind == _END:
                return True, size
            place += 16 + length
    return False, place


def require_sound(path: Path, read: Callable[[Path], None]) -> None:
    """Require that a recording can be read in a child process within limits.

    Args:
      path: path of the recording.
      read: function at module level that reads it.

    Raises:
      InputError: the recording cannot be read.
    """
    if _trusted(path):
        return
    size = path.stat().st_size
    limits = child.Allowance(_SECONDS + size / _BYTES_PER_SECOND, _MEMORY + _MEMORY_PER_BYTE * size)
    try:
        child.call(read, path, limits=limits)
    except child.NoAnswer as error:
        raise InputError(Mistake(f"is damaged: {error}; do its run again", file=path)) from None
    trust(path)
