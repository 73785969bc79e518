# pyright: reportUnknownMemberType=false
# Numba has no type stubs.
"""Progress events for activities that are not steps: compilation and waiting.

They use the callback that reports the steps. Estimates of the remaining time exclude both activities, and time limits
exclude the waiting time.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager

COMPILING, WAITING, POLL = "compiling (once)", "waiting for the machine", ""
"""POLL is no activity. It reports that time has passed and that nothing else has happened."""

_BEGIN_PREFIX, _END_PREFIX = "\0begin ", "\0end "

ProgressCallback = Callable[[str], None]


@contextmanager
def report_activity(tick: ProgressCallback, activity: str) -> Generator[None]:
    """Report an activity that is not a step while the block runs.

    Args:
        tick: progress callback.
        activity: description, such as COMPILING or WAITING.
    """
    tick(_BEGIN_PREFIX + activity)
    try:
        yield
    finally:
        tick(_END_PREFIX + activity)


def parse_activity_start(message: str) -> str | None:
    """Return the activity that a message starts, or None for any other message."""
    return message.removeprefix(_BEGIN_PREFIX) if message.startswith(_BEGIN_PREFIX) else None


def parse_activity_end(message: str) -> str | None:
    """Return the activity that a message ends, or None for any other message."""
    return message.removeprefix(_END_PREFIX) if message.startswith(_END_PREFIX) else None


def is_step_event(message: str) -> bool:
    """Return whether a message reports a step, by the name of its phase."""
    return message != POLL and not message.startswith("\0")


@contextmanager
def report_compilation(tick: ProgressCallback) -> Generator[None]:
    """Report the compilation of kernels inside the block.

    Kernels loaded from the cache are not reported.
    """
    from numba.core import event  # imported only where kernels are compiled

    class Watch(event.Listener):
        depth = 0

        def on_start(self, event: object) -> None:
            if self.depth == 0:
                tick(_BEGIN_PREFIX + COMPILING)
            self.depth += 1

        def on_end(self, event: object) -> None:
            self.depth -= 1
            if self.depth == 0:
                tick(_END_PREFIX + COMPILING)

    with event.install_listener("numba:compile", Watch()):
        yield


def ignore_progress(event: object) -> None:
    """Do nothing; a progress callback, and a task that ends at once."""
