"""Strangers' code may crash, hang, swell or leave; it is run in a worker process, which may die, and this one goes on.

Between the two is a process that reads what the worker writes and ends what it started (`harness.base.supervisor`).
One worker does all pieces of work, one after the other, so it stays warm: modules are imported, kernels compiled. It
is replaced where it was lost, or where a piece left threads behind. It is a fork of this process, which costs nothing
of that again, as long as nothing was begun here that does not survive a fork, as OpenMP's threads; then it is started
anew.

Files are read in a process of their own likewise (`harness.base.child`), which has nothing of this one's.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Generator, Hashable
from contextlib import suppress
from functools import partial
from multiprocessing import get_context, resource_tracker
from multiprocessing.connection import Connection, wait
from pathlib import Path
from pickle import UnpicklingError
from time import monotonic
from typing import Any

from harness.base import interrupts
from harness.base.asides import LOOK, WAITING, begun, ended, is_step
from harness.base.blame import place
from harness.base.files import CannotWrite, replacing
from harness.base.memory_of_tree import TreeMemory
from harness.base.supervisor import BUFFER, supervise
from harness.base.worker import DUMP, Limits, Piece, PieceOutcome, Tick

Going = Generator[Connection, None, Any]
"""A piece that is being done: yields whom to wait for, and returns its value."""

NO_FORK: set[str] = set()
"""What was begun in this process, besides Numba's threads, and does not survive a fork."""

_LOOK = 0.1
"""Seconds between two looks at a worker that is at work."""
_LATEST = 1.0
"""Seconds that the last output of a piece may take to come, where the piece has closed or stopped what passes it on."""
_GRACE = 5.0
"""Seconds that a worker has to say where it is, or to end, before it is killed."""
_KEPT = 2**14
"""So many of the last bytes that a worker said are kept."""
_SHOWN = 2**13
"""Bytes of what a piece writes that are shown; if there are more, all of them go to a file, `BUFFER` at most."""


class Lost(Exception):
    """A piece gave no answer.

    status: `time-limit` where it took too long, `killed` where others ended its worker, `failed` where it did so
    itself, or raised what no program should catch; reason: all that is known of it.
    """

    def __init__(self, status: str, reason: str) -> None:
        super().__init__(reason)
        self.status, self.reason = status, reason


class Workers:
    """Does pieces in a worker. ready: called in each before anything else; fork: whether that may be a fork of this
    process, as it may while no other thread runs here."""

    def __init__(self, ready: Callable[[], object] = int, *, fork: bool = True) -> None:
        self._ready, self._fork = ready, fork
        self._worker: _Worker | None = None
        self._own: frozenset[Hashable] = frozenset()

    def begin(self) -> None:
        """Start a worker where there is none; it gets ready while this process does something else."""
        if self._worker is None or not self._worker.alive:
            self.end()
            with interrupts.blocked():  # a worker that has started is known to this, and never receives Ctrl-C
                self._worker = _Worker(self._ready, fork=self._fork)

    def do(self, piece: Piece, tick: Tick, limits: Limits, meanwhile: Callable[[], object] = int) -> Any:
        """What the piece returns. meanwhile: done here once the worker has it. Raises the SpringbenchError that the
        piece raises, and Lost where it gives no answer."""
        going = self.doing(piece, tick, limits)
        while True:
            try:
                come = next(going)
            except StopIteration as done:
                return done.value
            meanwhile()
            meanwhile = int
            wait([come], _LOOK)

    def doing(self, piece: Piece, tick: Tick, limits: Limits, own: frozenset[Hashable] = frozenset()) -> Going:
        """Do a piece while others are done; see `do`. tick is told LOOK too, whenever this is asked to go on; own: the
        code of others that the piece runs, for which no piece that runs none of it shares its worker."""
        if not self._own <= own:
            self.end()
        self.begin()
        self._own = own
        assert self._worker
        try:
            answer = yield from self._worker.ask(piece, tick, limits)
        except BaseException:  # it was lost, or somebody wants to leave
            if self._worker:
                self._worker.kill()
            self.end()
            raise
        if not answer.clean:
            self.end()
        if isinstance(answer.error, str) and answer.error:
            raise Lost("failed", answer.error)
        if answer.error:
            raise answer.error
        return answer.value

    def end(self) -> None:
        """Let go of everything."""
        if self._worker:
            self._worker.end()
            self._worker, self._own = None, frozenset[Hashable]()


class _Worker:
    """One worker process and its supervisor, seen from the command."""

    def __init__(self, ready: Callable[[], object], *, fork: bool) -> None:
        fork = fork and sys.platform == "linux" and not NO_FORK and not _threads_run()
        context: Any = get_context("fork" if fork else "spawn")
        self._calls, calls = context.Pipe()
        (self._ticks, ticks), (self._said, said), (self._dump, dump) = (context.Pipe(duplex=False) for _ in range(3))
        theirs = calls, ticks, said, dump
        self._process = context.Process(target=supervise, args=(*theirs, ready, os.getpid()))
        if not fork:
            resource_tracker.ensure_running()  # which unblocks Ctrl-C
        with interrupts.blocked():
            self._process.start()
        for end in theirs:
            end.close()

    @property
    def alive(self) -> bool:
        """Whether it can be asked: nothing is to be read from one that waits, not even the end of its pipe."""
        return self._process.is_alive() and not self._calls.poll()

    def ask(self, piece: Piece, tick: Tick, limits: Limits) -> Generator[Connection, None, PieceOutcome]:
        """The answer to a piece, in the end. Raises Lost."""
        heard, began = _Heard(self._ticks, self._said, tick, limits.log), monotonic()
        memory = TreeMemory(self._process.pid or 0, limits.gib) if limits.gib else None
        try:
            self._calls.send((piece, limits, heard.end))
            while not self._calls.poll():
                yield self._calls
                heard.listen()
                if limits.seconds is not None and monotonic() - began - heard.waited > limits.seconds:
                    raise self._late(limits.seconds, heard)
                if memory and memory.exceeded:
                    self.kill(heard.listen)
                    raise Lost("failed", f"took more than {limits.gib:g} GiB with the processes it started, {heard}")
                if not self._process.is_alive() and not self._calls.poll():  # others may hold the pipe open
                    raise EOFError
            answer = self._calls.recv()
            heard.listen_to_end(_LATEST)
            return answer
        except (EOFError, OSError, UnpicklingError):
            raise self._ended(heard) from None
        finally:
            heard.close()

    def _late(self, seconds: float, heard: _Heard) -> Lost:
        """Ask a worker that takes too long where it is, and kill it."""
        with suppress(OSError):
            os.kill(self._process.pid or 0, DUMP)
        dump, more = b"", b""
        while wait([self._dump], _LOOK if dump else _GRACE) and (more := _come(self._dump)):
            dump += more
        self.kill(heard.listen)
        return Lost("time-limit", f"did not end within {seconds:g} s; it was {_at(dump)}{heard}")

    def _ended(self, heard: _Heard) -> Lost:
        """What became of a worker that gave no answer."""
        self._wait(_GRACE, heard.listen)
        self.kill(heard.listen)
        code, at = self._process.exitcode or 0, _at(_come(self._dump))
        if code >= 0:
            return Lost("failed", f"ended its process with exit code {code}, {heard}")
        name = signal.Signals(-code).name
        if -code == signal.SIGKILL:
            return Lost("killed", f"was killed by SIGKILL, as the system does where memory runs out, {heard}")
        if -code == signal.SIGTERM:
            return Lost("killed", f"was ended by SIGTERM, {heard}")
        return Lost("failed", f"crashed by {name} {at}{heard}")

    def kill(self, listen: Callable[[], object] = int) -> None:
        """End it and all that it started, at once. listen: takes what it said, which the supervisor still passes on."""
        if self._process.is_alive():
            self._process.terminate()
            with suppress(OSError):
                os.kill(self._process.pid or 0, signal.SIGCONT)  # for one that was stopped
            self._wait(_GRACE, listen)
        if self._process.is_alive():
            self._process.kill()
        self._process.join()
        listen()

    def _wait(self, seconds: float, listen: Callable[[], object]) -> None:
        """Wait for its end, some seconds at most."""
        until = monotonic() + seconds
        while (left := until - monotonic()) > 0 and not wait([self._process.sentinel], min(left, 0.01)):
            listen()

    def end(self) -> None:
        """Let it end, and end it where it does not."""
        with suppress(OSError):
            self._calls.send(None)
        self._wait(_GRACE, partial(_come, self._said))
        self.kill()
        for pipe in (self._calls, self._ticks, self._said, self._dump):
            pipe.close()
        self._process.close()


class _Heard:
    """What is heard of a piece while it is done: the phases of its steps, and what it writes."""

    def __init__(self, ticks: Connection, said: Connection, tick: Tick, log: Path | None) -> None:
        self._ticks, self._said, self._tick, self._log = ticks, said, tick, log
        self._phase, self._steps, self._kept, self._all = "", 0, b"", bytearray()
        self._count, self._held, self._ended = 0, bytearray(), False
        self.end = os.urandom(16)  # what the worker writes behind the last that a piece said
        self._waits_since: float | None = None
        self._waited = 0.0

    @property
    def waited(self) -> float:
        """For how many seconds it has waited for others, by what it told."""
        return self._waited + (0.0 if self._waits_since is None else monotonic() - self._waits_since)

    def listen(self) -> None:
        """Pass on what came meanwhile."""
        with suppress(EOFError, OSError):
            while self._ticks.poll():
                phase = self._ticks.recv_bytes().decode(errors="replace")
                if is_step(phase):
                    self._phase, self._steps = phase, 1 + (self._steps if phase == self._phase else 0)
                elif begun(phase) == WAITING:
                    self._waits_since = monotonic()
                elif ended(phase) == WAITING:
                    self._waited, self._waits_since = self.waited, None
                self._tick(phase)
        self._tick(LOOK)
        self._take(_come(self._said))

    def listen_to_end(self, seconds: float) -> None:
        """Pass on what a piece that has ended said, for which to come these seconds should do."""
        until = monotonic() + seconds
        self.listen()
        while not self._ended and (left := until - monotonic()) > 0:
            wait([self._said], left)
            self.listen()

    def _take(self, said: bytes) -> None:
        """Show and keep what was written; bytes that may be the beginning of `end` stay until the next ones come."""
        self._held += said
        at = self._held.find(self.end)
        self._ended = self._ended or at >= 0
        upto = at if at >= 0 else max(0, len(self._held) - len(self.end))
        self._pass_on(bytes(self._held[:upto]))
        self._held = bytearray() if at >= 0 else self._held[upto:]

    def _pass_on(self, said: bytes) -> None:
        if shown := said[: max(0, _SHOWN - self._count)]:
            sys.stderr.write(shown.decode(errors="replace"))
        self._count += len(said)
        self._all += said[: BUFFER - len(self._all)] if self._log else b""
        self._kept = (self._kept + said)[-_KEPT:]

    def close(self) -> None:
        """Show the rest; write what was too long to be shown to the log, and say so."""
        self._pass_on(bytes(self._held))
        self._held.clear()
        if self._count <= _SHOWN:
            return
        where = ""
        if self._log:
            with suppress(OSError, CannotWrite):
                self._log.parent.mkdir(parents=True, exist_ok=True)
                with replacing(self._log) as partial_name:
                    partial_name.write_bytes(self._all)
                where = f"; {'all of it is' if len(self._all) == self._count else 'the beginning is'} in {self._log}"
        sys.stderr.write(f"\n[of {self._count} bytes of output the first {_SHOWN} are shown{where}]\n")

    def __str__(self) -> str:
        steps = f"after {self._steps} steps of the {self._phase}" if self._steps else "before its first step"
        lines = [line for line in (self._kept + self._held).decode(errors="replace").splitlines() if line.strip()]
        return f"{steps}; it said: {lines[-1].strip()[:300]}" if lines else steps


def _come(pipe: Connection) -> bytes:
    """The bytes that are in a pipe now, as many as may be waiting for it."""
    found = b""
    with suppress(OSError):
        while len(found) < BUFFER and pipe.poll() and (more := os.read(pipe.fileno(), 2**16)):
            found += more
    return found


def _at(dump: bytes) -> str:
    """Where a worker was, as it has written down: `at file:line in function, `."""
    found = place(dump.decode(errors="replace"))
    return found and f"at {found}, "


def _threads_run() -> bool:
    """Whether Numba's threads were started in this process."""
    numba: Any = sys.modules.get("numba")
    if numba is None:
        return False
    try:
        numba.threading_layer()
    except ValueError:
        return False
    return True
