"""Run a function in a sandboxed subprocess that may hang, exhaust memory or crash.

The functions read untrusted input. One subprocess serves all calls of a process, one after the other, and is restarted
after a failure. Before each call it limits its own processor time and memory, both counted from that moment. Function,
arguments and result are transferred as pickles.
"""

from __future__ import annotations

import atexit
import os
import pickle
import signal
import struct
import subprocess
import sys
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from math import inf
from pkgutil import resolve_name
from threading import Timer
from time import process_time
from typing import Any, BinaryIO

from springbench.harness.errors import InputError
from springbench.harness.execution.pandas_deferral import request_deferral
from springbench.solvers.platform_calls import (
    can_isolate_processes,
    disable_core_dumps,
    get_soft_limit,
    set_soft_limit,
)

_TIMEOUT_FACTOR = 10.0
"""Wall seconds allowed per second of processor time, because other processes may occupy the cores."""

_LENGTH_HEADER = struct.Struct("<Q")


@dataclass(frozen=True, slots=True)
class CallLimits:
    """Limits of one call: processor time [s] and additional memory [bytes]."""

    cpu_seconds: float
    memory_bytes: int


class SandboxError(Exception):
    """The subprocess returned no result.

    The message gives the reason as the end of a sentence.
    """


def prepare_call(function: str) -> None:
    """Start the sandbox, and import a function there while this process continues.

    Args:
        function: "module:function".
    """
    if can_isolate_processes():
        with suppress(OSError):  # the process has ended, which the call reports
            _SandboxProcess.get_running().send_message(function)


def call_in_sandbox(function: Callable[..., Any] | str, *arguments: Any, limits: CallLimits) -> Any:
    """Call a module-level function in the sandbox, within limits.

    Args:
        function: function of a module, which is pickled by reference; or "module:function", which this process does
            not import.
        arguments: positional arguments, which must pickle.
        limits: processor time and memory of this call.

    Returns:
        The function's return value, which must pickle.

    Raises:
        InputError: if the function raises it.
        SandboxError: if the function raises anything else, exceeds a limit, or crashes.
    """
    if not can_isolate_processes():
        return _call_unlimited(_resolve_function(function), arguments)
    child = _SandboxProcess.get_running()
    try:
        child.send_message((os.getcwd(), function, arguments, limits))
        kind, answer = child.receive_message(_TIMEOUT_FACTOR * limits.cpu_seconds)
    except (EOFError, OSError):
        raise SandboxError(_describe_exit(child.stop_process(), limits, timed_out=child.timed_out)) from None
    if kind == "mistakes":
        raise InputError(answer)
    if kind == "error":
        raise SandboxError(answer)
    return answer


def _resolve_function(function: Callable[..., Any] | str) -> Callable[..., Any]:
    return resolve_name(function) if isinstance(function, str) else function


def _call_unlimited(function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    """Call a function in this process, with the errors that the sandbox reports."""
    try:
        return function(*arguments)
    except InputError:
        raise
    except Exception as error:  # readers raise anything on a broken file
        raise SandboxError(" ".join(str(error).split())[:300] or type(error).__name__) from error


def _describe_exit(code: int, limits: CallLimits, *, timed_out: bool) -> str:
    """Describe why the subprocess ended.

    Args:
        code: exit code, negative for a signal.
        limits: limits of the call.
        timed_out: whether it was killed at the limit of wall time.
    """
    if code == -signal.SIGXCPU:
        return f"reading it takes more than {limits.cpu_seconds:.3g} s of processor time"
    if timed_out:
        return f"reading it takes more than {_TIMEOUT_FACTOR * limits.cpu_seconds:.3g} s"
    if code == -signal.SIGKILL:
        return "the process that reads it was killed, as the system does when its memory runs out"
    name = signal.Signals(-code).name if code < 0 else f"exit code {code}"
    return f"the library that reads it crashed ({name})"


class _SandboxProcess:
    """A running subprocess that serves calls.

    `timed_out`: whether it was killed at the limit of wall time.
    """

    _instance: _SandboxProcess | None = None

    def __init__(self) -> None:
        paths = [path or os.getcwd() for path in sys.path]
        settings: dict[str, str] = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "RAYON_NUM_THREADS"), "1")
        settings["ARROW_DEFAULT_MEMORY_POOL"] = "system"  # others reserve a GiB at once, which counts as taken
        self._owner, self.timed_out = os.getpid(), False
        self._process = subprocess.Popen(
            [sys.executable, "-c", f"from {__name__} import serve_calls; serve_calls()"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, **settings, "PYTHONPATH": os.pathsep.join(paths)},
            process_group=0,  # a terminal's Ctrl-C is for the parent alone
        )

    @classmethod
    def get_running(cls) -> _SandboxProcess:
        """Return the subprocess of this process; a fork starts its own."""
        one = cls._instance
        if one is None or one._owner != os.getpid() or one._process.poll() is not None:
            one = cls._instance = cls()
            atexit.register(one.kill_process)
        return one

    @classmethod
    def current_pid(cls) -> int:
        """Return the id of the subprocess, or 0 if none was started here."""
        return cls._instance._process.pid if cls._instance and cls._instance._owner == os.getpid() else 0

    def send_message(self, message: Any) -> None:
        assert self._process.stdin
        _write_message(self._process.stdin, message)

    def receive_message(self, seconds: float) -> Any:
        """Receive the next message.

        The subprocess is killed after the given number of seconds.

        Raises:
            EOFError: if the subprocess ends before the message.
        """
        assert self._process.stdout
        timer = Timer(seconds, self._end_at_time_limit)
        timer.start()
        try:
            return _read_message(self._process.stdout)
        finally:
            timer.cancel()

    def _end_at_time_limit(self) -> None:
        self.timed_out = True
        self._process.kill()

    def kill_process(self) -> None:
        """Kill the subprocess; no call remains to complete."""
        if self._owner == os.getpid():
            self._process.kill()
            self.stop_process()

    def stop_process(self) -> int:
        """Stop the subprocess if needed, and return its exit code, negative for a signal."""
        if self._owner != os.getpid():
            return 0
        for pipe in (self._process.stdin, self._process.stdout):
            with suppress(OSError):
                if pipe:
                    pipe.close()
        try:
            return self._process.wait(timeout=5.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            return self._process.wait()


def _write_message(pipe: BinaryIO | Any, message: Any) -> None:
    content = pickle.dumps(message, pickle.HIGHEST_PROTOCOL)
    pipe.write(_LENGTH_HEADER.pack(len(content)))
    pipe.write(content)
    pipe.flush()


def _read_message(pipe: BinaryIO | Any) -> Any:
    head = pipe.read(_LENGTH_HEADER.size)
    if len(head) < _LENGTH_HEADER.size:
        raise EOFError
    content = pipe.read(_LENGTH_HEADER.unpack(head)[0])
    return pickle.loads(content)


def serve_calls() -> None:
    """Serve calls until the pipe is closed; this is the main loop of the subprocess.

    Output that the called functions print is discarded.
    """
    disable_core_dumps()
    request_deferral()
    calls, answers = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    nowhere = os.open(os.devnull, os.O_RDWR)
    for standard in range(3):
        os.dup2(nowhere, standard)
    while True:
        try:
            message = _read_message(calls)  # which imports the function's module, without limits
        except (EOFError, KeyboardInterrupt):
            return
        if isinstance(message, str):
            _resolve_function(message)
            continue
        here, function, arguments, limits = message
        function = _resolve_function(function)
        with suppress(OSError):  # relative paths mean what they mean to the caller
            os.chdir(here)
        _write_message(answers, _run_call(function, arguments, limits))


def _run_call(function: Callable[..., Any], arguments: tuple[Any, ...], limits: CallLimits) -> tuple[str, Any]:
    set_soft_limit("RLIMIT_CPU", process_time() + limits.cpu_seconds)
    set_soft_limit("RLIMIT_DATA", read_data_bytes() + limits.memory_bytes)
    try:
        return "answer", function(*arguments)
    except InputError as error:
        return "mistakes", error.mistakes
    except MemoryError:
        return "error", f"reading it takes more than {limits.memory_bytes / 2**30:.1f} GiB of memory"
    except BaseException as error:  # readers raise anything on a broken file; so do panics of compiled libraries
        message = " ".join(str(error).split())[:300]
        return "error", message or type(error).__name__
    finally:
        for what in ("RLIMIT_CPU", "RLIMIT_DATA"):
            set_soft_limit(what, inf)


@contextmanager
def limit_memory(memory_bytes: int) -> Generator[None]:
    """Limit the additional memory of this process inside the block.

    A larger allocation raises MemoryError, or the error of a library.

    Args:
        memory_bytes: allowed bytes beyond those in use now.
    """
    before = get_soft_limit("RLIMIT_DATA")
    set_soft_limit("RLIMIT_DATA", min(read_data_bytes() + memory_bytes, before))
    try:
        yield
    finally:
        set_soft_limit("RLIMIT_DATA", before)


def get_sandbox_pid() -> int:
    """Return the process id of this process's sandbox, or 0 without one."""
    return _SandboxProcess.current_pid()


def read_data_bytes() -> int:
    """Return the data size of this process [bytes], or 0 if unavailable.

    RLIMIT_DATA limits this size.
    """
    with suppress(OSError), open("/proc/self/status") as file:
        return next((1024 * int(line.split()[1]) for line in file if line.startswith("VmData:")), 0)
    return 0
