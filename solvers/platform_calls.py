"""System calls that not every platform has, each with a portable path.

Linux has all of them. Elsewhere runs are executed in the process of the command, without limits of time and memory; see
`can_isolate_processes`. macOS has file locks. Without these (Windows) nothing prevents two commands from disturbing
each other's times, so only one should run at a time.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from contextlib import suppress
from enum import Enum
from math import ceil, inf

try:
    import fcntl
except ImportError:
    fcntl = None
try:
    import resource
except ImportError:
    resource = None


class LockMode(Enum):
    """Mode of a file lock: shared by several processes, or exclusive."""

    SHARED = "LOCK_SH"
    EXCLUSIVE = "LOCK_EX"


def try_lock_file(handle: int, mode: LockMode) -> bool:
    """Lock an open file without waiting.

    Args:
        handle: file descriptor, whose copies share the lock.
        mode: shared or exclusive; replaces a lock that the descriptor already has.

    Returns:
        Whether that succeeded; always True on a platform without locks.
    """
    if fcntl is None:
        return True
    try:
        fcntl.flock(handle, getattr(fcntl, mode.value) | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def wait_for_lock(handle: int, mode: LockMode) -> None:
    """Lock an open file as soon as no other process prevents it.

    Does nothing on a platform without locks.

    Args:
        handle: file descriptor, whose copies share the lock.
        mode: shared or exclusive; replaces a lock that the descriptor already has.
    """
    if fcntl is not None:
        fcntl.flock(handle, getattr(fcntl, mode.value))


def unlock_file(handle: int) -> None:
    """Release the lock of an open file, also for forked processes that share it."""
    if fcntl is not None:
        fcntl.flock(handle, fcntl.LOCK_UN)


def try_lock_byte(handle: int, offset: int) -> bool:
    """Lock one byte of an open file for this process, without waiting.

    Args:
        handle: descriptor of a file that is open for writing.
        offset: position of the byte, which may be beyond the end of the file.

    Returns:
        Whether that succeeded; always True on a platform without locks.
    """
    if fcntl is None:
        return True
    try:
        fcntl.lockf(handle, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, offset)
    except OSError:
        return False
    return True


def run_after_fork(function: Callable[[], None]) -> None:
    """Call a function in each process that is forked from this one."""
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=function)


def list_usable_cores() -> list[int]:
    """List the numbers of the cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def pin_threads(cores: set[int]) -> None:
    """Pin all threads of this process to the given cores, where the system can."""
    if not hasattr(os, "sched_setaffinity"):
        return
    for thread in os.listdir("/proc/self/task"):
        with suppress(OSError):  # the thread has ended
            os.sched_setaffinity(int(thread), cores)


def measure_memory() -> float:
    """Return the memory of this machine [bytes]."""
    if hasattr(os, "sysconf"):
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    import psutil  # only on systems without `sysconf`

    return psutil.virtual_memory().total


def read_load_average() -> float:
    """Return the mean number of busy processes in the last minute; NaN if unavailable."""
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")


def can_isolate_processes() -> bool:
    """Return whether worker processes can be supervised and limited, which needs Linux."""
    return resource is not None and all(hasattr(os, name) for name in ("fork", "pidfd_open", "setsid", "waitid"))


def get_signal(name: str) -> signal.Signals:
    """Return a signal by its name, or SIGTERM on a platform without it."""
    return getattr(signal, name, signal.SIGTERM)


def get_soft_limit(name: str) -> float:
    """Return the soft limit of a resource of this process, or infinity.

    Args:
        name: name of the resource, such as `RLIMIT_DATA`.
    """
    if resource is None:
        return inf
    soft = resource.getrlimit(getattr(resource, name))[0]
    return inf if soft == resource.RLIM_INFINITY else soft


def set_soft_limit(name: str, value: float) -> None:
    """Set the soft limit of a resource.

    The hard limit stays unchanged, so that the next call can use another value. Nothing is limited where worker
    processes cannot be isolated.

    Args:
        name: name of the resource, such as `RLIMIT_DATA`.
        value: limit in the unit of the resource, rounded up to whole units, or infinity.
    """
    if resource is None or not can_isolate_processes():
        return
    number = getattr(resource, name)
    hard = resource.getrlimit(number)[1]
    soft = hard if value == inf else ceil(value)  # a limit of 0 s would end the process at the next clock tick
    resource.setrlimit(number, (soft if hard == resource.RLIM_INFINITY else min(soft, hard), hard))


def disable_core_dumps() -> None:
    """Disable core dumps of this process and its children."""
    if resource is not None:
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
