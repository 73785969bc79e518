"""Isolated worker: runs user code in a process of its own.

The code may crash, hang or exhaust memory without affecting this process. Between both is a supervisor
(`harness.base.supervisor`), which reads the worker's output and ends its processes. One worker runs all
tasks one after the other, so modules stay imported and kernels compiled. It is replaced after a failure, or if a task
left threads behind. It is a fork of this process, which repeats none of that cost, as long as nothing was started here
that does not survive a fork, such as OpenMP's threads. Otherwise it is spawned.

Files are read in a sandbox likewise (`harness.base.child`), which shares nothing with this process.
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
"""A running task: a generator that yields the connection to wait for, and returns the task's value."""

NO_FORK: set[str] = set()
"""Components started in this process, besides Numba's threads, that do not survive a fork."""

_LOOK = 0.1
"""Seconds between two polls of a busy worker."""
_LATEST = 1.0
"""Maximum seconds to wait for a task's last output if the task has closed or stopped the stream."""
_GRACE = 5.0
"""Seconds that a worker has for dumping its stack, or for ending, before it is killed."""
_KEPT = 2**14
"""Number of the last output bytes that are stored."""
_SHOWN = 2**13
"""Maximum number of output bytes of a task that are shown; longer output goes to a file, up to `BUFFER`."""


class Lost(Exception):
    """A task returned no result.

    status: `time-limit` after too long a time, `killed` if its worker was ended from outside, `failed` if it ended its
    process or raised an error that no program should catch.
    reason: all that is known about the failure.
    """

    def __init__(self, status: str, reason: str) -> None:
        super().__init__(reason)
        self.status, self.reason = status, reason


class Workers:
    """Runs tasks in an isolated worker process.

    initialiser: called first in each worker.
    fork: whether the worker may be a fork of this process, which is safe while no other thread runs here.
    """

    def __init__(self, ready: Callable[[], object] = int, *, fork: bool = True) -> None:
        self._ready, self._fork = ready, fork
        self._worker: _Worker | None = None
        self._own: frozenset[Hashable] = frozenset()

    def begin(self) -> None:
        """Start a worker if there is none; it initialises itself concurrently."""
        if self._worker is None or not self._worker.alive:
            self.end()
            with interrupts.blocked():  # a worker that has started is known to this, and never receives Ctrl-C
                self._worker = _Worker(self._ready, fork=self._fork)

    def do(self, piece: Piece, tick: Tick, limits: Limits, meanwhile: Callable[[], object] = int) -> Any:
        """Run a task and wait for its result.

        Args:
            piece: function of the task.
            tick: progress callback.
            limits: wall time and memory.
            meanwhile: called once in this process after the task was submitted.
        Returns: the task's value.
        Raises:
            SpringbenchError: if the task raises it.
            Lost: if the task returns no result.
        """
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
        """Start a task that runs concurrently with others.

        Args:
            piece: function of the task.
            tick: progress callback, which also receives POLL each time the generator is resumed.
            limits: wall time and memory.
            own: user code that the task runs. A worker that has run user code is replaced before a task without
                that code.
        Returns: generator that yields the connection to wait for, and returns the task's value.
        Raises: as `do`.
        """
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
        """Stop the worker and release its resources."""
        if self._worker:
            self._worker.end()
            self._worker, self._own = None, frozenset[Hashable]()


class _Worker:
    """One worker process and its supervisor, as seen from the command."""

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
        """Whether a task can be submitted.

        The pipe of an idle worker has nothing to read, not even its end.
        """
        return self._process.is_alive() and not self._calls.poll()

    def ask(self, piece: Piece, tick: Tick, limits: Limits) -> Generator[Connection, None, PieceOutcome]:
        """Submit a task and return its result at the end; raise Lost."""
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
        """Request the stack of a worker that exceeds its time limit, and kill it."""
        with suppress(OSError):
            os.kill(self._process.pid or 0, DUMP)
        dump, more = b"", b""
        while wait([self._dump], _LOOK if dump else _GRACE) and (more := _come(self._dump)):
            dump += more
        self.kill(heard.listen)
        return Lost("time-limit", f"did not end within {seconds:g} s; it was {_at(dump)}{heard}")

    def _ended(self, heard: _Heard) -> Lost:
        """Describe why a worker ended without a result."""
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
        """Kill the worker and all its processes at once.

        `listen` receives the output that the supervisor still relays.
        """
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
        """Wait for the worker's exit, at most the given seconds."""
        until = monotonic() + seconds
        while (left := until - monotonic()) > 0 and not wait([self._process.sentinel], min(left, 0.01)):
            listen()

    def end(self) -> None:
        """Request the worker's exit, and kill it if it does not end."""
        with suppress(OSError):
            self._calls.send(None)
        self._wait(_GRACE, partial(_come, self._said))
        self.kill()
        for pipe in (self._calls, self._ticks, self._said, self._dump):
            pipe.close()
        self._process.close()


class _Heard:
    """Progress events and output of a task while it runs."""

    def __init__(self, ticks: Connection, said: Connection, tick: Tick, log: Path | None) -> None:
        self._ticks, self._said, self._tick, self._log = ticks, said, tick, log
        self._phase, self._steps, self._kept, self._all = "", 0, b"", bytearray()
        self._count, self._held, self._ended = 0, bytearray(), False
        self.end = os.urandom(16)  # what the worker writes behind the last that a piece said
        self._waits_since: float | None = None
        self._waited = 0.0

    @property
    def waited(self) -> float:
        """Seconds that the task has waited for other processes, according to its events."""
        return self._waited + (0.0 if self._waits_since is None else monotonic() - self._waits_since)

    def listen(self) -> None:
        """Forward the events and the output received since the last call."""
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
        """Forward the last output of a finished task, waiting at most the given seconds."""
        until = monotonic() + seconds
        self.listen()
        while not self._ended and (left := until - monotonic()) > 0:
            wait([self._said], left)
            self.listen()

    def _take(self, said: bytes) -> None:
        """Show and store output.

        Bytes that may be the start of the end marker are held back until the next ones arrive.
        """
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
        """Show the rest of the output. Write output that was too long to the log, and report that."""
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
    """Read the bytes that are in a pipe now, at most BUFFER."""
    found = b""
    with suppress(OSError):
        while len(found) < BUFFER and pipe.poll() and (more := os.read(pipe.fileno(), 2**16)):
            found += more
    return found


def _at(dump: bytes) -> str:
    """Format the location of a worker from its dump: `at file:line in function, `."""
    found = place(dump.decode(errors="replace"))
    return found and f"at {found}, "


def _threads_run() -> bool:
    """Return whether Numba's threads were started in this process."""
    numba: Any = sys.modules.get("numba")
    if numba is None:
        return False
    try:
        numba.threading_layer()
    except ValueError:
        return False
    return True
