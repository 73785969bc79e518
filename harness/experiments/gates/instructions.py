"""Instructions that a program retires, as the processor counts them: no other program moves them.

The counter is perf's (`perf_event_open`, Linux); it counts this thread's own instructions, not the kernel's. Many
virtual machines hide it, and a kernel whose `perf_event_paranoid` is above 2 refuses it: `reason` then says so. Only
the standard library is needed, so that a worker may load this file wherever it runs.
"""

from __future__ import annotations

import ctypes
import os
import platform
import struct
from collections.abc import Callable

_CALL = {"x86_64": 298, "aarch64": 241}
"""The number of the system call."""
_SIZE = 128
"""Bytes of `perf_event_attr`; what lies beyond the fields given here is zero."""
_FLAGS = 1 << 5 | 1 << 6
"""exclude_kernel, exclude_hv."""

INSTRUCTIONS = (0, 1)
"""PERF_TYPE_HARDWARE, PERF_COUNT_HW_INSTRUCTIONS."""
PAGE_FAULTS = (1, 2)
"""PERF_TYPE_SOFTWARE, PERF_COUNT_SW_PAGE_FAULTS: there even where a virtual machine hides the processor's counters."""


def count(work: Callable[[], object], event: tuple[int, int] = INSTRUCTIONS) -> int | None:
    """How often an event happens in this thread while the work is done; None where that cannot be read."""
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
    """Why an event cannot be counted here, in words; empty where it can."""
    handle, said = _opened(event)
    if handle is not None:
        os.close(handle)
    return said


def _opened(event: tuple[int, int]) -> tuple[int | None, str]:
    """A counter that runs, or why there is none."""
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
