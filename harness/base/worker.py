"""What a worker process does: one piece of work after the other, each within limits, until its parent is gone.

What it prints to standard error, and where it was when it crashed, goes to the parent by pipes.
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
"""A piece of work, which is given whom to tell the name of its phase after each step; it pickles, and so does what it
returns."""

DUMP = signal.SIGUSR1
"""Makes a worker say where it is."""

_THOROUGH = 10.0
"""After so many seconds what earlier pieces left is looked through too: a cache may have let go of it since."""

_PARENT_DIES, _SUBREAPER = 1, 36
"""`PR_SET_PDEATHSIG`: Linux sends a process a signal when its parent dies. `PR_SET_CHILD_SUBREAPER`: Linux makes it the
parent of all processes below it whose parents end."""


class Limits(NamedTuple):
    """What a piece may take: wall seconds, and GiB of memory beyond what a worker has anyway, in all its processes;
    None is any amount. log: the file for what it writes where that is too long to be shown."""

    seconds: float | None = None
    gib: float | None = None
    log: Path | None = None


class PieceOutcome(NamedTuple):
    """What a piece returned, or its error, or in words how it left; clean: whether it left nothing behind, a
    broken device among it."""

    value: Any
    error: SpringbenchError | str = ""
    clean: bool = True


def serve(
    calls: Connection, ticks: Connection, output: int, dump: Connection, ready: Callable[[], object], parent: int
) -> None:
    """Do what comes through `calls` until that ends. output: where what it writes goes; ready: called first; parent:
    whose child this is."""
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
    """In a child: end by a signal when its parent does, and be the first to go where memory runs out."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PARENT_DIES, how)
        if os.getppid() != parent:
            os._exit(1)
        with suppress(OSError), open("/proc/self/oom_score_adj", "w") as file:
            file.write("1000")


def adopt_orphans() -> None:
    """Be the parent of all processes below this one whose parents end."""
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
    """The children of this process, less the one that reads files for it."""
    if not has_children():
        return set()
    import psutil  # which takes longer to load than most pieces have

    return {child.pid for child in psutil.Process().children()} - {reader()}


def has_children() -> bool:
    """Whether this process has children; of the calls that tell, the one that costs next to nothing."""
    try:
        os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT)
    except ChildProcessError:
        return False
    return True


def _as(before: tuple[int, set[int]]) -> bool:
    """Whether a piece left no threads and no processes behind."""
    return threading.active_count() <= before[0] and _processes() <= before[1]
