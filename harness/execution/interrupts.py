"""Interrupt handling: Ctrl-C ends a command with one message and exit code 130.

This applies from the first import to the last picture.
* During an import the interrupt is deferred, because extension modules turn a KeyboardInterrupt into an ImportError and
  print it.
* If a callback or a destructor swallows the KeyboardInterrupt, it is raised again.
* Once the command is ending, further interrupts are ignored.
"""

from __future__ import annotations

import atexit
import os
import signal
import sys
from collections.abc import Generator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import NoReturn

INTERRUPT_EXIT_CODE = 130
"""Exit code of a command that Ctrl-C stopped, by shell convention."""

INTERRUPT_MESSAGE = "springbench: stopped; completed results remain, and the same command resumes from there"

_RETRY_SECONDS = 0.02
"""Seconds until a deferred interrupt is tried again."""
_MAX_DEFERRALS = 250
"""Maximum number of retries; an import of more than 5 s is interrupted."""

_IMPORT_MODULES = ("importlib._bootstrap", "_frozen_importlib")

_deferrals = 0
_interrupted = False


def install_handler() -> None:
    """Install the handler of Ctrl-C in this process.

    A shell makes a background command ignore Ctrl-C; that setting is left unchanged.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _handle_interrupt)
        sys.unraisablehook = _reraise_interrupt
        if sys.platform != "win32":
            signal.signal(signal.SIGALRM, _handle_interrupt)


def ignore_interrupts() -> None:
    """Ignore Ctrl-C from here on, deferred interrupts included."""
    if signal.getsignal(signal.SIGINT) is _handle_interrupt:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        if sys.platform != "win32":
            signal.setitimer(signal.ITIMER_REAL, 0.0)


@contextmanager
def block_interrupts() -> Generator[None]:
    """Defer Ctrl-C inside the block; processes started there never receive it.

    A process that multiprocessing spawns needs its resource tracker, whose start unblocks Ctrl-C: start that before.
    """
    if sys.platform == "win32":
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def is_interrupted() -> bool:
    """Return whether Ctrl-C was received, also if it is still deferred."""
    return _interrupted or _deferrals > 0


def exit_process() -> NoReturn:
    """Print that the command was stopped, and exit.

    The interpreter's regular exit ends by a signal if Ctrl-C was pressed during `exec`.
    """
    ignore_interrupts()
    _kill_workers()
    with suppress(OSError, ValueError):
        print(INTERRUPT_MESSAGE, file=sys.stderr, flush=True)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # errors from here on are consequences of the interrupt
    atexit._run_exitfuncs()  # pyright: ignore[reportPrivateUsage]
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            stream.flush()
    os._exit(INTERRUPT_EXIT_CODE)


def _handle_interrupt(number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt as soon as no module is being imported."""
    global _deferrals, _interrupted
    while frame and sys.platform != "win32" and _deferrals < _MAX_DEFERRALS:
        if frame.f_globals.get("__name__") in _IMPORT_MODULES:
            _deferrals += 1
            signal.setitimer(signal.ITIMER_REAL, _RETRY_SECONDS)
            return
        frame = frame.f_back
    _deferrals, _interrupted = 0, True
    if logging := sys.modules.get("logging"):
        logging.disable()  # threads of libraries would log the loss of their workers
    _kill_workers()
    raise KeyboardInterrupt


def _kill_workers() -> None:
    """Kill the worker processes instead of waiting for their work."""
    if multiprocessing := sys.modules.get("multiprocessing"):
        for child in multiprocessing.active_children():
            child.kill()


def _reraise_interrupt(unraisable: sys.UnraisableHookArgs) -> None:
    """Interrupt again if a KeyboardInterrupt could not be propagated."""
    if unraisable.exc_type is KeyboardInterrupt and sys.platform != "win32":
        signal.setitimer(signal.ITIMER_REAL, _RETRY_SECONDS)
    else:
        sys.__unraisablehook__(unraisable)
