"""Supervisor process between a command and its worker; it runs no user code.

It reads the worker's output as soon as it is written. Writing therefore costs a worker almost nothing, however rarely
the command polls. Linux also makes it the parent of orphaned descendants (subreaper). It kills all processes of a
worker when the worker ends, when the command requests it (SIGTERM), and when the command has ended.
"""

from __future__ import annotations

import os
import select
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import NoReturn

from springbench.harness.execution.worker_process import (
    DUMP_SIGNAL,
    adopt_orphans,
    has_children,
    serve_tasks,
    tie_to_parent,
)
from springbench.solvers.platform_calls import disable_core_dumps

BUFFER_BYTES = 2**25
"""Maximum number of output bytes that wait for the command; further output is dropped."""
_GRACE_SECONDS = 2.0
"""Maximum seconds for killing a worker's processes, and for its last output to reach the command."""
_REAP_SECONDS = 1.0
"""Seconds between two searches for ended orphaned processes."""


def supervise_worker(
    calls: Connection,
    ticks: Connection,
    output_pipe: Connection,
    dump: Connection,
    initialiser: Callable[[], object],
    parent: int,
) -> None:
    """Start a worker (`springbench.harness.execution.worker_process.serve_tasks`), and end as it ends.

    It is the main function of the supervisor, a child of the command.

    Args:
        calls: pipe of tasks and results.
        ticks: pipe of progress events.
        output_pipe: pipe for the worker's output.
        dump: pipe for the worker's stack dumps.
        initialiser: called first in the worker.
        parent: process id of the command.
    """
    tie_to_parent(parent, signal.SIGTERM)
    os.setsid()
    adopt_orphans()
    disable_core_dumps()
    output, theirs = os.pipe()
    me = os.getpid()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the command handles Ctrl-C and ends this process
    signals = {signal.SIGTERM, DUMP_SIGNAL}
    signal.pthread_sigmask(signal.SIG_BLOCK, signals)
    worker = os.fork()
    if worker == 0:
        os.setsid()
        os.close(output)
        output_pipe.close()
        signal.pthread_sigmask(signal.SIG_UNBLOCK, signals)
        serve_tasks(calls, ticks, theirs, dump, initialiser, me)
        return
    for end in (calls, ticks, dump):
        end.close()
    os.close(theirs)
    _Supervisor(worker, output, output_pipe.fileno()).run_until_exit(signals)


class _Supervisor:
    """Relays the output of a worker, and ends its processes.

    worker: process id.
    output: pipe that the worker writes to.
    command: pipe to the command.
    """

    def __init__(self, worker: int, output: int, command: int) -> None:
        self._worker, self._output, self._command = worker, output, command
        self._waiting = bytearray()
        self._left_out = 0

    def run_until_exit(self, signals: set[signal.Signals]) -> NoReturn:
        """Relay the worker's output until it ends, then end likewise.

        The exit code or the signal is the same.
        """
        signal.signal(signal.SIGTERM, self._handle_stop)
        signal.signal(DUMP_SIGNAL, lambda number, frame: os.kill(self._worker, DUMP_SIGNAL))
        ended = os.pidfd_open(self._worker)
        for pipe in (self._output, self._command):
            os.set_blocking(pipe, False)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, signals)
        while not self._relay_pending(ended, _REAP_SECONDS):
            self._reap_children(sparing=self._worker)
        _, status = os.waitpid(self._worker, 0)
        self._kill_descendants()
        self._flush_output()
        if os.WIFSIGNALED(status):
            signal.signal(os.WTERMSIG(status), signal.SIG_DFL) if os.WTERMSIG(status) != signal.SIGKILL else None
            os.kill(os.getpid(), os.WTERMSIG(status))
        os._exit(os.waitstatus_to_exitcode(status) & 0xFF)

    def _handle_stop(self, number: int, frame: object) -> NoReturn:
        self._kill_descendants()
        self._flush_output()
        os._exit(0)

    def _relay_pending(self, ended: int | None, seconds: float) -> bool:
        """Relay pending output, and return whether the worker has ended.

        The call waits at most the given seconds.
        """
        poll = select.poll()
        poll.register(self._output, select.POLLIN)
        if ended is not None:
            poll.register(ended, select.POLLIN)
        if self._waiting:
            poll.register(self._command, select.POLLOUT)
        ready = dict(poll.poll(1e3 * seconds))
        if self._output in ready:
            self._read_output()
        if self._waiting:
            self._write_output()
        return ended in ready

    def _read_output(self) -> bool:
        """Read the worker's pipe, and return whether it had any content."""
        try:
            found = os.read(self._output, 2**20)
        except OSError:
            return False
        room = max(0, BUFFER_BYTES - len(self._waiting))
        if self._left_out and room > len(found):
            self._waiting += f"\n[{self._left_out} bytes are left out]\n".encode()
            self._left_out = 0
        self._waiting += found[:room]
        self._left_out += len(found) - len(found[:room])
        return bool(found)

    def _write_output(self) -> None:
        try:
            del self._waiting[: os.write(self._command, self._waiting[: 2**20])]
        except BlockingIOError:
            pass
        except OSError:  # the command is gone
            self._waiting.clear()

    def _flush_output(self) -> None:
        until = time.monotonic() + _GRACE_SECONDS
        while self._read_output():
            pass
        while self._waiting and time.monotonic() < until:
            select.select([], [self._command], [], 0.1)
            self._write_output()

    def _reap_children(self, sparing: int = 0) -> None:
        """Reap ended child processes."""
        with suppress(OSError):
            while found := os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT):
                if found.si_pid == sparing:
                    return
                os.waitpid(found.si_pid, os.WNOHANG)

    def _kill_descendants(self) -> None:
        """Kill all descendants, including those started meanwhile."""
        if not has_children():
            return
        # Imported only if descendants are left. SIGTERM is blocked, because its handler needs the complete module.
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
        import psutil

        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
        until = time.monotonic() + _GRACE_SECONDS
        while time.monotonic() < until and has_children():
            for process in psutil.Process().children(recursive=True):
                with suppress(psutil.Error, OSError):
                    process.kill()
            self._reap_children()
            time.sleep(0.001)
