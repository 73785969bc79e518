"""Worker process: runs tasks one after the other, each within limits, until its parent ends.

Its output, and its stack at a crash, are sent to the parent by pipes.
"""

from __future__ import annotations

import ctypes
import faulthandler
import gc
import os
import signal
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from math import inf
from multiprocessing.connection import Connection
from pathlib import Path
from time import monotonic
from typing import Any, NamedTuple

from springbench.harness.console import reset_error_console
from springbench.harness.errors import SpringbenchError
from springbench.harness.execution.error_location import format_error, locate_error
from springbench.harness.execution.sandbox import get_sandbox_pid, read_data_bytes
from springbench.solvers.iteration.device_interface import is_device_lost
from springbench.solvers.platform_calls import disable_core_dumps, get_signal, set_soft_limit

ProgressCallback = Callable[[str], None]
TaskFunction = Callable[[ProgressCallback], Any]
"""Function of a task.

Its argument is the progress callback, which receives the name of the phase after each step. The function and its result
must be picklable.
"""

DUMP_SIGNAL = get_signal("SIGUSR1")
"""Signal that makes a worker dump its stack."""

KILL_SIGNAL = get_signal("SIGKILL")
"""Signal that ends a process at once."""

_FULL_CHECK_SECONDS = 10.0
"""Seconds between two full garbage collections, which include objects of earlier tasks; a cache may have released
them."""

_PR_SET_PDEATHSIG, _PR_SET_CHILD_SUBREAPER = 1, 36
"""Numbers of two options of `prctl`.

`PR_SET_PDEATHSIG`: Linux sends a process a signal when its parent dies. `PR_SET_CHILD_SUBREAPER`: Linux makes it the
parent of orphaned descendants.
"""


class TaskLimits(NamedTuple):
    """Limits of a task; None is unlimited.

    Attributes:
        wall_seconds: wall time [s].
        memory_gib: memory of all its processes [GiB], beyond what the worker uses before the task.
        log_path: file for output that is too long to be shown.
    """

    wall_seconds: float | None = None
    memory_gib: float | None = None
    log_path: Path | None = None


class TaskOutcome(NamedTuple):
    """Result of a task.

    Attributes:
        value: return value.
        error: its error, or a description of another failure.
        is_clean: whether no thread, process or broken device is left behind.
    """

    value: Any
    error: SpringbenchError | str = ""
    is_clean: bool = True


def serve_tasks(
    calls: Connection, ticks: Connection, output: int, dump: Connection, initialiser: Callable[[], object], parent: int
) -> None:
    """Run the tasks that arrive through `calls` until the pipe is closed.

    Args:
        calls: pipe of tasks and results.
        ticks: pipe of progress events.
        output: file descriptor that receives the worker's output.
        dump: pipe for stack dumps.
        initialiser: called first.
        parent: process id of the parent.
    """
    tie_to_parent(parent)
    adopt_orphans()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C and ends this process
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    nowhere = os.open(os.devnull, os.O_RDONLY)
    for standard, to in enumerate((nowhere, output, output)):
        os.dup2(to, standard)
    for end in (nowhere, output):
        os.close(end)
    sys.stdout, sys.stderr = (
        os.fdopen(standard, "w", buffering=1, errors="backslashreplace", closefd=False) for standard in (1, 2)
    )
    reset_error_console()
    faulthandler.enable(dump.fileno(), all_threads=False)
    faulthandler.register(DUMP_SIGNAL, dump.fileno(), all_threads=True)
    disable_core_dumps()
    initialiser()
    gc.freeze()  # excludes objects inherited from the parent from each collection
    me, here = os.getpid(), os.getcwd()
    looked = monotonic()
    with suppress(EOFError, OSError):  # the task may have closed the connection
        while (request := calls.recv()) is not None:
            task, limits, end = request
            answer = _run_task(task, limits, lambda phase: ticks.send_bytes(phase.encode()))
            if os.getpid() != me:  # a fork of this process, made by the task
                os._exit(0)
            with suppress(OSError, ValueError, AttributeError):  # closed or replaced by the task
                sys.stdout.flush()
            with suppress(OSError):
                os.write(1, end)
            with suppress(OSError):
                os.chdir(here)
            calls.send(answer)
            if monotonic() - looked > _FULL_CHECK_SECONDS:
                looked = monotonic()
                gc.unfreeze()
            gc.collect()  # now, and not while the next task is timed
            gc.freeze()  # compiled kernels leave 10^5 objects, whose collection takes longer than a short run


def tie_to_parent(parent: int, death_signal: signal.Signals = KILL_SIGNAL) -> None:
    """End this child process by a signal when its parent ends.

    It is also the first to be killed when memory runs out. Systems other than Linux do neither.

    Args:
        parent: process id of the parent; if it has ended already, so does this process.
        death_signal: signal that the system sends when the parent ends.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, death_signal)
        if os.getppid() != parent:
            os._exit(1)
        with suppress(OSError), open("/proc/self/oom_score_adj", "w") as file:
            file.write("1000")


def adopt_orphans() -> None:
    """Make this process the parent of its orphaned descendants."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1)


def _run_task(task: TaskFunction, limits: TaskLimits, tick: ProgressCallback) -> TaskOutcome:
    before = threading.active_count(), _list_children()
    if limits.memory_gib is not None:
        set_soft_limit("RLIMIT_DATA", read_data_bytes() + limits.memory_gib * 2**30)
    try:
        value: Any = task(tick)
    except SpringbenchError as error:
        return TaskOutcome(None, error, is_clean=_is_clean_after(before) and not is_device_lost())
    except BaseException as error:  # also SystemExit and GeneratorExit, which must not end the worker
        why = f"raised {format_error(error)} ({locate_error(error, ())})"
        return TaskOutcome(
            None, why, is_clean=isinstance(error, Exception) and _is_clean_after(before) and not is_device_lost()
        )
    finally:
        set_soft_limit("RLIMIT_DATA", inf)
    return TaskOutcome(value, is_clean=_is_clean_after(before) and not is_device_lost())


def _list_children() -> set[int]:
    """List the children of this process without the sandbox that reads files."""
    if not has_children():
        return set()
    import psutil  # only here: its import takes longer than most tasks

    return {child.pid for child in psutil.Process().children()} - {get_sandbox_pid()}


def has_children() -> bool:
    """Return whether this process has children, by the cheapest system call that reports it."""
    try:
        os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT)
    except ChildProcessError:
        return False
    return True


def _is_clean_after(before: tuple[int, set[int]]) -> bool:
    """Return whether a task left no threads and no processes behind."""
    return threading.active_count() <= before[0] and _list_children() <= before[1]
