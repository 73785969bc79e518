"""Run a function in a sandboxed subprocess that may hang, exhaust memory or crash.

It reads untrusted input. One subprocess serves all calls of a process, one after the other, and is restarted after a
failure. Before each call it limits its own processor time and memory, both counted from that moment. Function,
arguments and result are transferred as pickles.
"""

from __future__ import annotations

import atexit
import os
import pickle
import resource
import signal
import struct
import subprocess
import sys
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from threading import Timer
from typing import Any, BinaryIO

from harness.base.errors import InputError

_PATIENCE = 10.0
"""Wall seconds allowed per second of processor time, because other processes may occupy the cores."""

_LENGTH = struct.Struct("<Q")


@dataclass(frozen=True, slots=True)
class Allowance:
    """Limits of one call: processor time [s] and additional memory [bytes]."""

    seconds: float
    bytes: int


class NoAnswer(Exception):
    """The subprocess returned no result.

    The message gives the reason as the end of a sentence.
    """


def call(function: Callable[..., Any], *arguments: Any, limits: Allowance) -> Any:
    """Call a module-level function in the sandbox, within limits.

    Args:
        function: function of a module; it is pickled by reference.
        arguments: positional arguments, which must pickle.
        limits: processor time and memory of this call.
    Returns: the function's return value, which must pickle.
    Raises:
        InputError: if the function raises it.
        NoAnswer: if the function raises anything else, exceeds a limit, or crashes.
    """
    child = _Child.running()
    try:
        child.send((os.getcwd(), function, arguments, limits))
        kind, answer = child.receive(_PATIENCE * limits.seconds)
    except (EOFError, OSError):
        raise NoAnswer(_why(child.end(), limits)) from None
    if kind == "mistakes":
        raise InputError(answer)
    if kind == "error":
        raise NoAnswer(answer)
    return answer


def _why(code: int, limits: Allowance) -> str:
    if code in (-signal.SIGXCPU, -signal.SIGKILL):
        return f"reading it takes more than {limits.seconds:.3g} s"
    name = signal.Signals(-code).name if code < 0 else f"exit code {code}"
    return f"the library that reads it crashed ({name})"


class _Child:
    """A running subprocess that serves calls."""

    _one: _Child | None = None

    def __init__(self) -> None:
        paths = [path or os.getcwd() for path in sys.path]
        settings: dict[str, str] = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "RAYON_NUM_THREADS"), "1")
        settings["ARROW_DEFAULT_MEMORY_POOL"] = "system"  # others reserve a GiB at once, which counts as taken
        self._owner = os.getpid()
        self._process = subprocess.Popen(
            [sys.executable, "-c", f"from {__name__} import serve; serve()"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, **settings, "PYTHONPATH": os.pathsep.join(paths)},
            process_group=0,  # a terminal's Ctrl-C is for the parent alone
        )

    @classmethod
    def running(cls) -> _Child:
        """Return the subprocess of this process; a fork starts its own."""
        one = cls._one
        if one is None or one._owner != os.getpid() or one._process.poll() is not None:
            one = cls._one = cls()
            atexit.register(one.end)
        return one

    @classmethod
    def of_this_process(cls) -> int:
        """Return the id of the subprocess, or 0 if none was started here."""
        return cls._one._process.pid if cls._one and cls._one._owner == os.getpid() else 0

    def send(self, message: Any) -> None:
        assert self._process.stdin
        _write(self._process.stdin, message)

    def receive(self, seconds: float) -> Any:
        """Receive the next message.

        The subprocess is killed after the given number of seconds.

        Raises:
            EOFError: if the subprocess ends before the message.
        """
        assert self._process.stdout
        timer = Timer(seconds, self._process.kill)
        timer.start()
        try:
            return _read(self._process.stdout)
        finally:
            timer.cancel()

    def end(self) -> int:
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


def _write(pipe: BinaryIO | Any, message: Any) -> None:
    content = pickle.dumps(message, pickle.HIGHEST_PROTOCOL)
    pipe.write(_LENGTH.pack(len(content)))
    pipe.write(content)
    pipe.flush()


def _read(pipe: BinaryIO | Any) -> Any:
    head = pipe.read(_LENGTH.size)
    if len(head) < _LENGTH.size:
        raise EOFError
    content = pipe.read(_LENGTH.unpack(head)[0])
    return pickle.loads(content)


def serve() -> None:
    """Serve calls until the pipe is closed; this is the main loop of the subprocess.

    Output that the called functions print is discarded.
    """
    without_core_dumps()
    calls, answers = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    nowhere = os.open(os.devnull, os.O_RDWR)
    for standard in range(3):
        os.dup2(nowhere, standard)
    while True:
        try:
            here, function, arguments, limits = _read(calls)  # which imports the function's module, without limits
        except (EOFError, KeyboardInterrupt):
            return
        with suppress(OSError):  # relative paths mean what they mean to the caller
            os.chdir(here)
        _write(answers, _answer(function, arguments, limits))


def _answer(function: Callable[..., Any], arguments: tuple[Any, ...], limits: Allowance) -> tuple[str, Any]:
    used = resource.getrusage(resource.RUSAGE_SELF)
    limit(resource.RLIMIT_CPU, used.ru_utime + used.ru_stime + limits.seconds)
    limit(resource.RLIMIT_DATA, data() + limits.bytes)
    try:
        return "answer", function(*arguments)
    except InputError as error:
        return "mistakes", error.mistakes
    except MemoryError:
        return "error", f"reading it takes more than {limits.bytes / 2**30:.1f} GiB of memory"
    except BaseException as error:  # readers raise anything on a broken file; so do panics of compiled libraries
        said = " ".join(str(error).split())[:300]
        return "error", said or type(error).__name__
    finally:
        for what in (resource.RLIMIT_CPU, resource.RLIMIT_DATA):
            limit(what, resource.RLIM_INFINITY)


@contextmanager
def memory_limited(bytes: int) -> Generator[None]:
    """Limit the additional memory of this process inside the block.

    A larger allocation raises MemoryError, or the error of a library.

    Args:
        bytes: allowed bytes beyond those in use now.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    wanted = data() + bytes
    limit(resource.RLIMIT_DATA, wanted if soft == resource.RLIM_INFINITY else min(wanted, soft))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))


def reader() -> int:
    """Return the process id of this process's sandbox, or 0 without one."""
    return _Child.of_this_process()


def without_core_dumps() -> None:
    """Disable core dumps of this process and its children."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def limit(what: int, value: float) -> None:
    """Set a soft resource limit and leave the hard limit unchanged.

    The next call can therefore use another value.

    Args:
        what: constant `resource.RLIMIT_*`.
        value: limit in the unit of the resource, or RLIM_INFINITY.
    """
    hard = resource.getrlimit(what)[1]
    soft = int(value) if value != resource.RLIM_INFINITY else hard
    resource.setrlimit(what, (soft if hard == resource.RLIM_INFINITY else min(soft, hard), hard))


def data() -> int:
    """Return the data size of this process [bytes], or 0 if unavailable.

    RLIMIT_DATA limits this size.
    """
    with suppress(OSError), open("/proc/self/status") as file:
        return next((1024 * int(line.split()[1]) for line in file if line.startswith("VmData:")), 0)
    return 0
