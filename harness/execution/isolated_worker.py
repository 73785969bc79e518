"""Isolated worker: runs user code in a process of its own.

The code may crash, hang or exhaust memory without affecting this process. A supervisor process between the two
(`springbench.harness.execution.worker_supervisor`) reads the worker's output and ends its processes. One worker runs
all tasks one after the other, so modules stay imported and kernels compiled. It is replaced after a failure, or if a
task left threads behind. It is a fork of this process, which repeats neither imports nor compilation, as long as
nothing was started here that does not survive a fork, such as OpenMP's threads. Otherwise it is spawned.

Files are read in a sandbox (`springbench.harness.execution.sandbox`), which shares nothing with this process.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Generator, Hashable, Iterator
from contextlib import suppress
from functools import partial
from multiprocessing import get_context, resource_tracker
from multiprocessing.connection import Connection, wait
from pathlib import Path
from pickle import UnpicklingError
from time import monotonic
from typing import Any

from springbench.harness.atomic_files import WriteError, atomic_write
from springbench.harness.errors import SpringbenchError
from springbench.harness.execution import interrupts
from springbench.harness.execution.error_location import format_error, locate_error, parse_fault_location
from springbench.harness.execution.progress_events import (
    POLL,
    WAITING,
    is_step_event,
    parse_activity_end,
    parse_activity_start,
)
from springbench.harness.execution.worker_process import (
    DUMP_SIGNAL,
    ProgressCallback,
    TaskFunction,
    TaskLimits,
    TaskOutcome,
)
from springbench.harness.execution.worker_supervisor import BUFFER_BYTES, supervise_worker
from springbench.solvers.platform_calls import can_isolate_processes

RunningTask = Generator[Connection, None, Any]
"""A running task: a generator that yields the connection to wait for, and returns the task's value."""

FORK_BLOCKERS: set[str] = set()
"""Components started in this process, besides Numba's threads, that do not survive a fork."""

_POLL_INTERVAL = 0.1
"""Seconds between two polls of a busy worker."""
_OUTPUT_WAIT_SECONDS = 1.0
"""Maximum seconds to wait for a task's last output if the task has closed or stopped the stream."""
_GRACE_SECONDS = 5.0
"""Seconds that a worker has for dumping its stack, or for ending, before it is killed."""
_MAX_TAIL_BYTES = 2**14
"""Number of the last output bytes that are stored."""
_MAX_PRINTED_BYTES = 2**13
"""Maximum number of output bytes of a task that are shown; longer output goes to a file, up to `BUFFER_BYTES`."""


class TaskFailure(Exception):
    """A task returned no result.

    Attributes:
        status: `time-limit` if it exceeded its wall time, `killed` if its worker was ended from outside, `failed` if it
            ended its process, exceeded its memory limit or raised an error that is not the project's own.
        reason: all that is known about the failure.
    """

    def __init__(self, status: str, reason: str) -> None:
        super().__init__(reason)
        self.status, self.reason = status, reason


class IsolatedWorker:
    """Runs tasks in an isolated worker process.

    Args:
        initialiser: called first in each worker.
        fork: whether the worker may be a fork of this process, which is safe while no other thread runs here.
    """

    def __init__(self, initialiser: Callable[[], object] = int, *, fork: bool = True) -> None:
        self._ready, self._fork = initialiser, fork
        self._worker: _WorkerProcess | None = None
        self._own: frozenset[Hashable] = frozenset()

    def start_worker(self) -> None:
        """Start a worker if there is none; it initialises itself concurrently."""
        if not can_isolate_processes():
            return
        if self._worker is None or not self._worker.is_ready:
            self.stop_worker()
            with interrupts.block_interrupts():  # no Ctrl-C before a started worker is assigned, and none in the worker
                self._worker = _WorkerProcess(self._ready, fork=self._fork)

    def run_task(
        self,
        task: TaskFunction,
        tick: ProgressCallback,
        limits: TaskLimits,
        background_call: Callable[[], object] = int,
    ) -> Any:
        """Run a task and wait for its result.

        Args:
            task: function of the task.
            tick: progress callback.
            limits: wall time and memory.
            background_call: called once in this process after the task was submitted.

        Returns:
            The task's value.

        Raises:
            SpringbenchError: if the task raises it.
            TaskFailure: if the task returns no result.
        """
        going = self.start_task(task, tick, limits)
        while True:
            try:
                come = next(going)
            except StopIteration as done:
                return done.value
            background_call()
            background_call = int
            wait([come], _POLL_INTERVAL)

    def start_task(
        self,
        task: TaskFunction,
        tick: ProgressCallback,
        limits: TaskLimits,
        user_code: frozenset[Hashable] = frozenset(),
    ) -> RunningTask:
        """Start a task that runs concurrently with others.

        Args:
            task: function of the task.
            tick: progress callback, which also receives POLL each time the generator is resumed.
            limits: wall time and memory.
            user_code: user code that the task runs. A worker that has run user code is replaced before a task without
                that code.

        Returns:
            Generator that yields the connection to wait for, and returns the task's value.

        Raises:
            SpringbenchError, TaskFailure: as `run_task`.
        """
        if not can_isolate_processes():
            return _run_unlimited(task, tick)
        if not self._own <= user_code:
            self.stop_worker()
        self.start_worker()
        self._own = user_code
        assert self._worker
        try:
            answer = yield from self._worker.submit_task(task, tick, limits)
        except BaseException:  # the worker was lost, or the command was interrupted
            if self._worker:
                self._worker.kill_process()
            self.stop_worker()
            raise
        if not answer.is_clean:
            self.stop_worker()
        if isinstance(answer.error, str) and answer.error:
            raise TaskFailure("failed", answer.error)
        if answer.error:
            raise answer.error
        return answer.value

    def stop_worker(self) -> None:
        """Stop the worker and release its resources."""
        if self._worker:
            self._worker.stop_process()
            self._worker, self._own = None, frozenset[Hashable]()


def _run_unlimited(task: TaskFunction, tick: ProgressCallback) -> Any:
    """Run a task in this process, without limits, with the errors of a worker."""
    try:
        return task(tick)
    except SpringbenchError:
        raise
    except Exception as error:
        raise TaskFailure("failed", f"raised {format_error(error)} ({locate_error(error, ())})") from error


class _WorkerProcess:
    """One worker process and its supervisor, as seen from the command."""

    def __init__(self, initialiser: Callable[[], object], *, fork: bool) -> None:
        fork = fork and can_fork()
        context: Any = get_context("fork" if fork else "spawn")
        self._calls, calls = context.Pipe()
        (self._ticks, ticks), (self._output, output), (self._dump, dump) = (
            context.Pipe(duplex=False) for _ in range(3)
        )
        theirs = calls, ticks, output, dump
        self._process = context.Process(target=supervise_worker, args=(*theirs, initialiser, os.getpid()))
        if not fork:
            resource_tracker.ensure_running()  # which unblocks Ctrl-C
        with interrupts.block_interrupts():
            self._process.start()
        for end in theirs:
            end.close()

    @property
    def is_ready(self) -> bool:
        """Whether a task can be submitted.

        The pipe of an idle worker has nothing to read, not even its end.
        """
        return self._process.is_alive() and not self._calls.poll()

    def submit_task(
        self, task: TaskFunction, tick: ProgressCallback, limits: TaskLimits
    ) -> Generator[Connection, None, TaskOutcome]:
        """Submit a task and return its result at the end; raise TaskFailure."""
        heard, began = _TaskOutput(self._ticks, self._output, tick, limits.log_path), monotonic()
        memory = ProcessTreeMemory(self._process.pid or 0, limits.memory_gib) if limits.memory_gib else None
        try:
            self._calls.send((task, limits, heard.end))
            while not self._calls.poll():
                yield self._calls
                heard.read_pending()
                if limits.wall_seconds is not None and monotonic() - began - heard.waited_seconds > limits.wall_seconds:
                    raise self._handle_timeout(limits.wall_seconds, heard)
                if memory and memory.is_exceeded:
                    self.kill_process(heard.read_pending)
                    raise TaskFailure(
                        "failed", f"took more than {limits.memory_gib:g} GiB with the processes it started, {heard}"
                    )
                if not self._process.is_alive() and not self._calls.poll():  # other processes may have the pipe open
                    raise EOFError
            answer = self._calls.recv()
            heard.read_to_end(_OUTPUT_WAIT_SECONDS)
            return answer
        except (EOFError, OSError, UnpicklingError):
            raise self._handle_exit(heard) from None
        finally:
            heard.close_output()

    def _handle_timeout(self, seconds: float, heard: _TaskOutput) -> TaskFailure:
        """Request the stack of a worker that exceeds its time limit, and kill it."""
        with suppress(OSError):
            os.kill(self._process.pid or 0, DUMP_SIGNAL)
        dump, more = b"", b""
        while wait([self._dump], _POLL_INTERVAL if dump else _GRACE_SECONDS) and (more := _read_available(self._dump)):
            dump += more
        self.kill_process(heard.read_pending)
        return TaskFailure("time-limit", f"did not end within {seconds:g} s; it was {_format_location(dump)}{heard}")

    def _handle_exit(self, heard: _TaskOutput) -> TaskFailure:
        """Describe why a worker ended without a result."""
        self._wait_for_exit(_GRACE_SECONDS, heard.read_pending)
        self.kill_process(heard.read_pending)
        code, at = self._process.exitcode or 0, _format_location(_read_available(self._dump))
        if code >= 0:
            return TaskFailure("failed", f"ended its process with exit code {code}, {heard}")
        name = signal.Signals(-code).name
        if -code == signal.SIGKILL:
            return TaskFailure("killed", f"was killed by SIGKILL, as the system does where memory runs out, {heard}")
        if -code == signal.SIGTERM:
            return TaskFailure("killed", f"was ended by SIGTERM, {heard}")
        return TaskFailure("failed", f"crashed by {name} {at}{heard}")

    def kill_process(self, listen: Callable[[], object] = int) -> None:
        """Kill the worker and all its processes at once.

        `listen` receives the output that the supervisor still relays.
        """
        if self._process.is_alive():
            self._process.terminate()
            with suppress(OSError):
                os.kill(self._process.pid or 0, signal.SIGCONT)  # a stopped process cannot handle SIGTERM
            self._wait_for_exit(_GRACE_SECONDS, listen)
        if self._process.is_alive():
            self._process.kill()
        self._process.join()
        listen()

    def _wait_for_exit(self, seconds: float, listen: Callable[[], object]) -> None:
        """Wait for the worker's exit, at most the given seconds."""
        until = monotonic() + seconds
        while (left := until - monotonic()) > 0 and not wait([self._process.sentinel], min(left, 0.01)):
            listen()

    def stop_process(self) -> None:
        """Request the worker's exit, and kill it if it does not end."""
        with suppress(OSError):
            self._calls.send(None)
        self._wait_for_exit(_GRACE_SECONDS, partial(_read_available, self._output))
        self.kill_process()
        for pipe in (self._calls, self._ticks, self._output, self._dump):
            pipe.close()
        self._process.close()


class _TaskOutput:
    """Progress events and output of a task while it runs."""

    def __init__(self, ticks: Connection, output: Connection, tick: ProgressCallback, log: Path | None) -> None:
        self._ticks, self._output, self._tick, self._log = ticks, output, tick, log
        self._phase, self._steps, self._tail, self._all = "", 0, b"", bytearray()
        self._count, self._pending, self._ended = 0, bytearray(), False
        self.end = os.urandom(16)  # end marker, which the worker writes after the task's last output
        self._waits_since: float | None = None
        self._waited = 0.0

    @property
    def waited_seconds(self) -> float:
        """Seconds that the task has waited for other processes, according to its events."""
        return self._waited + (0.0 if self._waits_since is None else monotonic() - self._waits_since)

    def read_pending(self) -> None:
        """Forward the events and the output received since the last call."""
        with suppress(EOFError, OSError):
            while self._ticks.poll():
                phase = self._ticks.recv_bytes().decode(errors="replace")
                if is_step_event(phase):
                    self._phase, self._steps = phase, 1 + (self._steps if phase == self._phase else 0)
                elif parse_activity_start(phase) == WAITING:
                    self._waits_since = monotonic()
                elif parse_activity_end(phase) == WAITING:
                    self._waited, self._waits_since = self.waited_seconds, None
                self._tick(phase)
        self._tick(POLL)
        self._add_output(_read_available(self._output))

    def read_to_end(self, seconds: float) -> None:
        """Forward the last output of a finished task, waiting at most the given seconds."""
        until = monotonic() + seconds
        self.read_pending()
        while not self._ended and (left := until - monotonic()) > 0:
            wait([self._output], left)
            self.read_pending()

    def _add_output(self, output: bytes) -> None:
        """Show and store output.

        Bytes that may be the start of the end marker are buffered until the next ones arrive.
        """
        self._pending += output
        at = self._pending.find(self.end)
        self._ended = self._ended or at >= 0
        upto = at if at >= 0 else max(0, len(self._pending) - len(self.end))
        self._show_output(bytes(self._pending[:upto]))
        self._pending = bytearray() if at >= 0 else self._pending[upto:]

    def _show_output(self, output: bytes) -> None:
        if shown := output[: max(0, _MAX_PRINTED_BYTES - self._count)]:
            sys.stderr.write(shown.decode(errors="replace"))
        self._count += len(output)
        self._all += output[: BUFFER_BYTES - len(self._all)] if self._log else b""
        self._tail = (self._tail + output)[-_MAX_TAIL_BYTES:]

    def close_output(self) -> None:
        """Show the remaining output, and write output above the display limit to the log."""
        self._show_output(bytes(self._pending))
        self._pending.clear()
        if self._count <= _MAX_PRINTED_BYTES:
            return
        where = ""
        if self._log:
            with suppress(OSError, WriteError):
                self._log.parent.mkdir(parents=True, exist_ok=True)
                with atomic_write(self._log) as partial_name:
                    partial_name.write_bytes(self._all)
                where = f"; {'all of it is' if len(self._all) == self._count else 'the beginning is'} in {self._log}"
        sys.stderr.write(f"\n[of {self._count} bytes of output the first {_MAX_PRINTED_BYTES} are shown{where}]\n")

    def __str__(self) -> str:
        steps = f"after {self._steps} steps of the {self._phase}" if self._steps else "before its first step"
        lines = [line for line in (self._tail + self._pending).decode(errors="replace").splitlines() if line.strip()]
        return f"{steps}; it said: {lines[-1].strip()[:300]}" if lines else steps


def _read_available(pipe: Connection) -> bytes:
    """Read the bytes that are in a pipe now, at most BUFFER_BYTES."""
    found = b""
    with suppress(OSError):
        while len(found) < BUFFER_BYTES and pipe.poll() and (more := os.read(pipe.fileno(), 2**16)):
            found += more
    return found


def _format_location(dump: bytes) -> str:
    """Format the location of a worker from its dump: `at file:line in function, `."""
    found = parse_fault_location(dump.decode(errors="replace"))
    return found and f"at {found}, "


def can_fork() -> bool:
    """Return whether all that was started in this process survives a fork."""
    return sys.platform == "linux" and not FORK_BLOCKERS and not _has_numba_threads()


def _has_numba_threads() -> bool:
    """Return whether Numba's threads were started in this process."""
    numba: Any = sys.modules.get("numba")
    if numba is None:
        return False
    try:
        numba.threading_layer()
    except ValueError:
        return False
    return True


class ProcessTreeMemory:
    """Monitor of the additional memory of all descendants of a process, from Linux's /proc.

    Args:
        root: id of the process.
        gib: limit of the additional memory of all descendants [GiB].
    """

    def __init__(self, root: int, gib: float) -> None:
        self._root, self._most = root, gib * 2**30
        self._before = {
            process: _read_proc_bytes(process, "status", ("VmData:",)) for process in _iterate_descendants(root)
        }

    @property
    def is_exceeded(self) -> bool:
        """Whether new processes, and the growth of earlier ones, exceed the limit.

        False without new processes, because the earlier ones have limits of their own.
        """
        new = set(found := list(_iterate_descendants(self._root))) - self._before.keys()
        if not new:
            return False
        taken = sum(_read_proc_bytes(process, "smaps_rollup", ("Private_Dirty:", "Pss_Shmem:")) for process in new)
        others = [process for process in self._before if process in found]
        return (
            taken + sum(_read_proc_bytes(one, "status", ("VmData:",)) - self._before[one] for one in others)
            > self._most
        )


def _iterate_descendants(process: int) -> Iterator[int]:
    with suppress(OSError):
        for thread in os.listdir(f"/proc/{process}/task"):
            with suppress(OSError), open(f"/proc/{process}/task/{thread}/children") as file:
                for child in map(int, file.read().split()):
                    yield child
                    yield from _iterate_descendants(child)


def _read_proc_bytes(process: int, file: str, names: tuple[str, ...]) -> int:
    """Sum the lines `name: ... kB` of a /proc file [bytes]; 0 if the process has ended."""
    with suppress(OSError), open(f"/proc/{process}/{file}") as lines:
        return sum(1024 * int(line.split()[1]) for line in lines if line.startswith(names))
    return 0
