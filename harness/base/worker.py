"""Worker process: runs tasks one after the other, each within limits, until its parent ends.

Its output, and its stack at a crash, are sent to the parent by pipes.
"""

from __future__ import annotations

import ctypes
import faulthandler
import gc
import os
import resource
import signal
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from time import monotonic
from typing import Any, NamedTuple

from harness.base.blame import said, where
from harness.base.child import data, limit, reader, without_core_dumps
from harness.base.console import write_plainly
from harness.base.errors import SpringbenchError
from solvers.device import broken

Tick = Callable[[str], None]
Piece = Callable[[Tick], Any]
"""Function of a task. Its argument is the progress callback, which receives the name of the phase after each step. The
function and its result must pickle.
"""

DUMP = signal.SIGUSR1
"""Signal that makes a worker dump its stack."""

_THOROUGH = 10.0
"""Seconds between two full garbage collections, which include objects of earlier tasks; a cache may have released
them."""

_PARENT_DIES, _SUBREAPER = 1, 36
"""`PR_SET_PDEATHSIG`: Linux sends a process a signal when its parent dies. `PR_SET_CHILD_SUBREAPER`: Linux makes it the
parent of orphaned descendants.
"""


class Limits(NamedTuple):
    """Limits of a task; None is unlimited.

    seconds: wall time [s].
    gib: memory of all its processes [GiB], beyond what a worker uses anyway.
    log: file for output that is too long to be shown.
    """

    seconds: float | None = None
    gib: float | None = None
    log: Path | None = None


class PieceOutcome(NamedTuple):
    """Result of a task.

    value: return value.
    error: its error, or a description of another failure.
    clean: whether no thread, process or broken device is left behind.
    """

    value: Any
    error: SpringbenchError | str = ""
    clean: bool = True


def serve(
    calls: Connection, ticks: Connection, output: int, dump: Connection, ready: Callable[[], object], parent: int
) -> None:
    """Run the tasks that arrive through `calls` until the pipe is closed.

    Args:
        calls: pipe of tasks and results.
        ticks: pipe of progress events.
        output: file descriptor that receives the worker's output.
        dump: pipe for stack dumps.
        ready: called first.
        parent: process id of the parent.
    """
    tie(parent)
    adopt_orphans()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's affair, which ends this
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    nowhere = os.open(os.devnull, os.O_RDONLY)
    for standard, to in enumerate((nowhere, output, output)):
        os.dup2(to, standard)
    for end in (nowhere, output):
        os.close(end)
    sys.stdout, sys.stderr = (
        os.fdopen(standard, "w", buffering=1, errors="backslashreplace", closefd=False) for standard in (1, 2)
    )
    write_plainly()
    faulthandler.enable(dump.fileno(), all_threads=False)
    faulthandler.register(DUMP, dump.fileno(), all_threads=True)
    without_core_dumps()
    ready()
    gc.freeze()  # what the parent had need not be looked through after each piece
    me, here = os.getpid(), os.getcwd()
    looked = monotonic()
    with suppress(EOFError, OSError):  # a piece may have closed what this is asked through
        while (asked := calls.recv()) is not None:
            piece, limits, end = asked
            answer = _answer(piece, limits, lambda phase: ticks.send_bytes(phase.encode()))
            if os.getpid() != me:  # a copy of this process that the piece has made
                os._exit(0)
            with suppress(OSError, ValueError, AttributeError):  # closed by the piece, or put away
                sys.stdout.flush()
            with suppress(OSError):
                os.write(1, end)
            with suppress(OSError):
                os.chdir(here)
            calls.send(answer)
            if monotonic() - looked > _THOROUGH:
                looked = monotonic()
                gc.unfreeze()
            gc.collect()  # now, and not while the next piece is timed
            gc.freeze()  # compiled kernels leave 10^5 objects, which take longer to look through than a short run


def tie(parent: int, how: signal.Signals = signal.SIGKILL) -> None:
    """End this child process by a signal when its parent ends.

    It is also the first to be killed when memory runs out.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PARENT_DIES, how)
        if os.getppid() != parent:
            os._exit(1)
        with suppress(OSError), open("/proc/self/oom_score_adj", "w") as file:
            file.write("1000")


def adopt_orphans() -> None:
    """Make this process the parent of its orphaned descendants."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_SUBREAPER, 1)


def _answer(piece: Piece, limits: Limits, tick: Tick) -> PieceOutcome:
    before = threading.active_count(), _processes()
    if limits.gib is not None:
        limit(resource.RLIMIT_DATA, data() + limits.gib * 2**30)
    try:
        value: Any = piece(tick)
    except SpringbenchError as error:
        return PieceOutcome(None, error, clean=_as(before) and not broken())
    except BaseException as error:  # SystemExit and GeneratorExit too: whoever called is not to leave
        why = f"raised {said(error)} ({where(error, ())})"
        return PieceOutcome(None, why, clean=isinstance(error, Exception) and _as(before) and not broken())
    finally:
        limit(resource.RLIMIT_DATA, resource.RLIM_INFINITY)
    return PieceOutcome(value, clean=_as(before) and not broken())


def _processes() -> set[int]:
    """List the children of this process without the sandbox that reads files."""
    if not has_children():
        return set()
    import psutil  # which takes longer to load than most pieces have

    return {child.pid for child in psutil.Process().children()} - {reader()}


def has_children() -> bool:
    """Return whether this process has children, by the cheapest system call that reports it."""
    try:
        os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT)
    except ChildProcessError:
        return False
    return True


def _as(before: tuple[int, set[int]]) -> bool:
    """Return whether a task left no threads and no processes behind."""
    return threading.active_count() <= before[0] and _processes() <= before[1]
