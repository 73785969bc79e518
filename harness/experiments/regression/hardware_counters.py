"""Hardware counter of retired instructions, which other programs do not affect.

The counter is that of perf (`perf_event_open`, Linux). It counts the instructions of this thread in user mode. Many
virtual machines hide it, and a kernel with `perf_event_paranoid` above 2 denies it; `explain_unavailable` describes the
cause. The module needs only the standard library, so that a worker can load it in any environment.
"""

from __future__ import annotations

import ctypes
import os
import platform
import struct
from collections.abc import Callable

_SYSTEM_CALL_NUMBERS = {"x86_64": 298, "aarch64": 241}
"""Number of the system call `perf_event_open`, by architecture."""
_ATTRIBUTE_BYTES = 128
"""Size of `perf_event_attr` [bytes]; fields not given here are zero."""
_EXCLUDE_FLAGS = 1 << 5 | 1 << 6
"""exclude_kernel, exclude_hv."""

INSTRUCTIONS = (0, 1)
"""PERF_TYPE_HARDWARE, PERF_COUNT_HW_INSTRUCTIONS."""
PAGE_FAULTS = (1, 2)
"""PERF_TYPE_SOFTWARE, PERF_COUNT_SW_PAGE_FAULTS: available even if a virtual machine hides the hardware counters."""


def count_events(work: Callable[[], object], event: tuple[int, int] = INSTRUCTIONS) -> int | None:
    """Count the occurrences of an event in this thread during some work.

    Args:
        work: function to call.
        event: type and config of perf.

    Returns:
        The count, or None if the counter is unavailable.
    """
    handle, _ = _open_counter(event)
    if handle is None:
        return None
    try:
        before = _read_counter(handle)
        work()
        return _read_counter(handle) - before
    finally:
        os.close(handle)


def explain_unavailable(event: tuple[int, int] = INSTRUCTIONS) -> str:
    """Explain why an event cannot be counted here; empty if it can."""
    handle, message = _open_counter(event)
    if handle is not None:
        os.close(handle)
    return message


def _open_counter(event: tuple[int, int]) -> tuple[int | None, str]:
    """Open a running counter; return its file descriptor, or None and the reason."""
    number = _SYSTEM_CALL_NUMBERS.get(platform.machine())
    if platform.system() != "Linux" or number is None:
        return None, f"instructions cannot be counted on {platform.system()} {platform.machine()}"
    attributes = bytearray(_ATTRIBUTE_BYTES)
    struct.pack_into("=IIQ", attributes, 0, event[0], _ATTRIBUTE_BYTES, event[1])
    struct.pack_into("=Q", attributes, 40, _EXCLUDE_FLAGS)  # offset of the flags in the structure
    libc = ctypes.CDLL(None, use_errno=True)
    given = (ctypes.c_char * _ATTRIBUTE_BYTES).from_buffer(attributes)
    # pid 0 and cpu -1: this thread on any core; group -1: a counter without a group.
    handle = libc.syscall(ctypes.c_long(number), given, 0, -1, ctypes.c_long(-1), ctypes.c_ulong(0))
    if handle >= 0:
        return handle, ""
    error = os.strerror(ctypes.get_errno())
    return None, f"instructions cannot be counted here: {error} (perf_event_open; a virtual machine may hide them)"


def _read_counter(handle: int) -> int:
    return struct.unpack("=Q", os.read(handle, 8))[0]
