"""Whether a recording is whole, and whether it can be read.

A recording is a header of 12 bytes and messages, each a kind and a length of 8 bytes, then that many bytes of payload.
The library aborts the process on some damaged files. So what this process has not written is first read in the child
that `harness.base.child` keeps.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

from harness.base import child
from harness.base.errors import InputError, Mistake

_HEADER, _END = 12, 0

_SECONDS, _BYTES_PER_SECOND = 10.0, 1e7
_MEMORY, _MEMORY_PER_BYTE = 2**30, 8
"""What a recording may take to read, for its bytes: it comes compressed."""

_sound: set[tuple[int, ...]] = set()
"""The files that can be read, each in the state that it had then."""


def trust(path: Path) -> None:
    """Note that a recording can be read as it is now."""
    _sound.add(_state(path))


def _state(path: Path) -> tuple[int, ...]:
    state = path.stat()
    return state.st_dev, state.st_ino, state.st_mtime_ns, state.st_size


def whole_messages(path: Path) -> tuple[bool, int]:
    """Whether the file has its end mark, and where its last whole message ends."""
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
    """Raise InputError for a recording that `read`, a function of a module, cannot read in a child within limits."""
    if _state(path) in _sound:
        return
    size = path.stat().st_size
    limits = child.Allowance(_SECONDS + size / _BYTES_PER_SECOND, _MEMORY + _MEMORY_PER_BYTE * size)
    try:
        child.call(read, path, limits=limits)
    except child.NoAnswer as error:
        raise InputError(Mistake(f"is damaged: {error}; do its run again", file=path)) from None
    trust(path)
