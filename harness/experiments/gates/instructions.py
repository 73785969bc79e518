"""Hardware counter of retired instructions, which other programs do not affect.

The counter is that of perf (`perf_event_open`, Linux). It counts the instructions of this thread in user mode. Many
virtual machines hide it, and a kernel with `perf_event_paranoid` above 2 denies it; `reason` describes the
cause. The module needs only the standard library, so that a worker can load it in any environment.
"""

from __future__ import annotations

import ctypes
import os
import platform
import struct
from collections.abc import Callable

_CALL = {"x86_64": 298, "aarch64": 241}
"""Number of the system call, by architecture."""
_SIZE = 128
"""Size of `perf_event_attr` [bytes]; fields not given here are zero."""
_FLAGS = 1 << 5 | 1 << 6
"""exclude_kernel, exclude_hv."""

INSTRUCTIONS = (0, 1)
"""PERF_TYPE_HARDWARE, PERF_COUNT_HW_INSTRUCTIONS."""
PAGE_FAULTS = (1, 2)
"""PERF_TYPE_SOFTWARE, PERF_COUNT_SW_PAGE_FAULTS: available even if a virtual machine hides the hardware counters."""


def count(work: Callable[[], object], event: tuple[int, int] = INSTRUCTIONS) -> int | None:
    """Count the occurrences of an event in this thread during some work.

    Args:
        work: function to call.
        event: type and config of perf.
    Returns: the count, or None if the counter is unavailable.
    """
    handle, _ = _opened(event)
    if handle is None:
        return None
    try:
        before = _read(handle)
        work()
        return _read(handle) - before
    finally:
        os.close(handle)


def reason(event: tuple[int, int] = INSTRUCTIONS) -> str:
    """Explain why an event cannot be counted here; empty if it can."""
    handle, said = _opened(event)
    if handle is not None:
        os.close(handle)
    return said


def _opened(event: tuple[int, int]) -> tuple[int | None, str]:
    """Open a running counter; return its file descriptor, or None and the reason."""
    number = _CALL.get(platform.machine())
    if platform.system() != "Linux" or number is None:
        return None, f"instructions cannot be counted on {platform.system()} {platform.machine()}"
    attributes = bytearray(_SIZE)
    struct.pack_into("=IIQ", attributes, 0, event[0], _SIZE, event[1])
    struct.pack_into("=Q", attributes, 40, _FLAGS)
    libc = ctypes.CDLL(None, use_errno=True)
    given = (ctypes.c_char * _SIZE).from_buffer(attributes)
    handle = libc.syscall(ctypes.c_long(number), given, 0, -1, ctypes.c_long(-1), ctypes.c_ulong(0))
    if handle >= 0:
        return handle, ""
    error = os.strerror(ctypes.get_errno())
    return None, f"instructions cannot be counted here: {error} (perf_event_open; a virtual machine may hide them)"


def _read(handle: int) -> int:
    return struct.unpack("=Q", os.read(handle, 8))[0]
