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
from time import monotonic
from typing import Any, NamedTuple

from harness.base.blame import where
from harness.base.child import data, limit
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

_PARENT_DIES = 1
"""`PR_SET_PDEATHSIG`: Linux sends a process a signal when its parent dies."""


class Limits(NamedTuple):
    """What a piece may take: wall seconds, and GiB of memory beyond what a worker has anyway; None is any amount."""

    seconds: float | None = None
    gib: float | None = None


class PieceOutcome(NamedTuple):
    """What a piece returned, or its error, or in words how it left; clean: whether it left nothing behind, a
    broken device among it."""

    value: Any
    error: SpringbenchError | str = ""
    clean: bool = True


def serve(
    calls: Connection, ticks: Connection, said: Connection, dump: Connection, ready: Callable[[], object], parent: int
) -> None:
    """Do what comes through `calls` until that ends. ready: called first; parent: whose child this is."""
    tie(parent)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's affair, which ends this
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    os.dup2(said.fileno(), 2)
    sys.stderr = os.fdopen(2, "w", buffering=1, errors="backslashreplace", closefd=False)
    write_plainly()
    faulthandler.enable(dump.fileno(), all_threads=False)
    faulthandler.register(DUMP, dump.fileno(), all_threads=True)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    ready()
    gc.freeze()  # what the parent had need not be looked through after each piece
    me = os.getpid()
    looked = monotonic()
    with suppress(EOFError, ConnectionError):
        while (asked := calls.recv()) is not None:
            piece, limits = asked
            answer = _answer(piece, limits, lambda phase: ticks.send_bytes(phase.encode()))
            if os.getpid() != me:  # a copy of this process that the piece has made
                os._exit(0)
            calls.send(answer)
            if monotonic() - looked > _THOROUGH:
                looked = monotonic()
                gc.unfreeze()
            gc.collect()  # now, and not while the next piece is timed
            gc.freeze()  # compiled kernels leave 10^5 objects, which take longer to look through than a short run


def tie(parent: int) -> None:
    """In a child: end when its parent does, and be the first to go where memory runs out."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PARENT_DIES, signal.SIGKILL)
        if os.getppid() != parent:
            os._exit(1)
        with suppress(OSError), open("/proc/self/oom_score_adj", "w") as file:
            file.write("1000")


def _answer(piece: Piece, limits: Limits, tick: Tick) -> PieceOutcome:
    before = threading.active_count()
    if limits.gib is not None:
        limit(resource.RLIMIT_DATA, data() + limits.gib * 2**30)
    try:
        value: Any = piece(tick)
    except SpringbenchError as error:
        return PieceOutcome(None, error, clean=not broken())
    except BaseException as error:  # SystemExit and GeneratorExit too: whoever called is not to leave
        said = " ".join(str(error).split())[:300]
        why = f"raised {type(error).__name__}{f': {said}' if said else ''} ({where(error, ())})"
        return PieceOutcome(None, why, clean=isinstance(error, Exception) and not broken())
    finally:
        limit(resource.RLIMIT_DATA, resource.RLIM_INFINITY)
    return PieceOutcome(value, clean=threading.active_count() <= before and not broken())
