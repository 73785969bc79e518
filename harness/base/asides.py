# pyright: reportUnknownMemberType=false
# Numba has no type stubs.
"""Progress events for activities that are not steps: compilation and waiting.

They use the callback that reports the steps. Estimates of the remaining time exclude both activities, and time limits
exclude the waiting time.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager

COMPILING, WAITING, LOOK = "compiling (once)", "waiting for the machine", ""
"""POLL is no activity. It reports that time has passed and that nothing else has happened."""

_BEGIN, _END = "\0begin ", "\0end "

Tick = Callable[[str], None]


@contextmanager
def aside(tick: Tick, what: str) -> Generator[None]:
    """Report an activity that is not a step while the block runs.

    Args:
        tick: progress callback.
        what: description, such as COMPILING or WAITING.
    """
    tick(_BEGIN + what)
    try:
        yield
    finally:
        tick(_END + what)


def begun(said: str) -> str | None:
    """Return the activity that a message starts, or None for any other message."""
    return said.removeprefix(_BEGIN) if said.startswith(_BEGIN) else None


def ended(said: str) -> str | None:
    """Return the activity that a message ends, or None for any other message."""
    return said.removeprefix(_END) if said.startswith(_END) else None


def is_step(said: str) -> bool:
    """Return whether a message reports a step, by the name of its phase."""
    return said != LOOK and not said.startswith("\0")


@contextmanager
def compiling_told(tick: Tick) -> Generator[None]:
    """Report the compilation of kernels inside the block.

    Kernels loaded from the cache are not reported.
    """
    from numba.core import event  # where nothing is compiled, nobody waits for it

    class Watch(event.Listener):
        depth = 0

        def on_start(self, event: object) -> None:
            if self.depth == 0:
                tick(_BEGIN + COMPILING)
            self.depth += 1

        def on_end(self, event: object) -> None:
            self.depth -= 1
            if self.depth == 0:
                tick(_END + COMPILING)

    with event.install_listener("numba:compile", Watch()):
        yield
