"""Integrity check of recordings: whether a file is complete and whether it can be read.

A recording is a header of 12 bytes and a sequence of messages. Each message is a kind and a length of 8 bytes each,
then that many bytes of payload. The library aborts the process on some damaged files. A file that this process has not
written is therefore first read in the child process of `springbench.harness.execution.sandbox`.

Files that can be read are noted in the user's cache folder, for all processes, since reading a whole recording takes
far longer than what a report needs from it. A note identifies the state of a file by its device, inode, size and times;
the change time is set by the system and cannot be forged. Notes are not stored with the results, which may come from
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

from springbench.harness.atomic_files import get_user_cache_dir
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.execution import sandbox

_HEADER_BYTES, _END_KIND = 12, 0

_BASE_SECONDS, _BYTES_PER_SECOND = 10.0, 1e7
_BASE_MEMORY, _MEMORY_PER_BYTE = 2**30, 8
"""Time [s] and memory [bytes] limits to read a recording, as functions of its size; it is compressed."""

_MAX_NOTES_BYTES = 2**21
"""Size [bytes] of the notes from which on they are discarded."""

_verified_states: set[bytes] = set()
"""Hashes of the file states that have been read successfully."""

_notes_offset: dict[Path, int] = {}
"""Number of bytes of notes that have been read, by file."""


def mark_verified(path: Path, *, shared: bool = True) -> None:
    """Mark a recording in its present state as readable.

    Args:
        path: path of the recording.
        shared: whether other processes see the mark too.
    """
    _verified_states.add(state := _file_state(path))
    if shared:
        with suppress(OSError):  # without a note, other processes check the file again
            notes = _notes_path()
            notes.parent.mkdir(parents=True, exist_ok=True)
            file = os.open(notes, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
            try:
                if os.fstat(file).st_size > _MAX_NOTES_BYTES:
                    os.truncate(file, 0)
                os.write(file, state)
            finally:
                os.close(file)


def _is_verified(path: Path) -> bool:
    state = _file_state(path)
    if state not in _verified_states:
        with suppress(OSError):
            notes = _notes_path()
            size, begin = notes.stat().st_size, _notes_offset.get(notes, 0)
            if size != begin:
                with notes.open("rb") as file:
                    file.seek(begin if size > begin else 0)
                    found = file.read()
                _verified_states.update(found[k : k + len(state)] for k in range(0, len(found), len(state)))
                _notes_offset[notes] = size
    return state in _verified_states


def _notes_path() -> Path:
    return get_user_cache_dir("recordings") / f"sound-{_read_library_version()}"


@cache
def _read_library_version() -> str:
    """Return the version of the library that reads recordings; another version may not read them."""
    return version("rerun-sdk")


def _file_state(path: Path) -> bytes:
    found = path.stat()
    known = found.st_dev, found.st_ino, found.st_mtime_ns, found.st_ctime_ns, found.st_size
    return sha256(repr(known).encode()).digest()[:16]


def scan_messages(path: Path) -> tuple[bool, int]:
    """Find the end of the last complete message.

    Returns:
        Whether the file has its end mark, and the offset [bytes] of the end of its last complete message.
    """
    size, place = path.stat().st_size, _HEADER_BYTES
    with path.open("rb") as file:
        while place + 16 <= size:
            file.seek(place)
            kind, length = struct.unpack("<QQ", file.read(16))
            if place + 16 + length > size:
                break
            if kind == _END_KIND:
                return True, size
            place += 16 + length
    return False, place


def require_intact(path: Path, read_recording: Callable[[Path], None]) -> None:
    """Require that a recording can be read in a child process within limits.

    Args:
        path: path of the recording.
        read_recording: function at module level that reads it.

    Raises:
        InputError: the recording cannot be read.
    """
    if _is_verified(path):
        return
    size = path.stat().st_size
    limits = sandbox.CallLimits(_BASE_SECONDS + size / _BYTES_PER_SECOND, _BASE_MEMORY + _MEMORY_PER_BYTE * size)
    try:
        sandbox.call_in_sandbox(read_recording, path, limits=limits)
    except sandbox.SandboxError as error:
        raise InputError(InputMistake(f"is damaged: {error}; repeat its run", file=path)) from None
    mark_verified(path)
