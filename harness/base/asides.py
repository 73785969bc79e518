# pyright: reportUnknownMemberType=false
# Numba tells no types.
"""What a piece of work does beside its steps, said on the way that its steps are told: compiling, and waiting.

The time of it is no measure of the work, so whoever foretells an end leaves it out; and whoever limits a piece leaves
out what it waited.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager

COMPILING, WAITING, LOOK = "compiling (once)", "waiting for the machine", ""
"""LOOK is no aside: it says that time goes by and nothing else has happened."""

_BEGIN, _END = "\0begin ", "\0end "

Tick = Callable[[str], None]


@contextmanager
def aside(tick: Tick, what: str) -> Generator[None]:
    """Say that something else than a step goes on, as long as it does."""
    tick(_BEGIN + what)
    try:
        yield
    finally:
        tick(_END + what)


def begun(said: str) -> str | None:
    """What begins, if that was said."""
    return said.removeprefix(_BEGIN) if said.startswith(_BEGIN) else None


def ended(said: str) -> str | None:
    """What ends, if that was said."""
    return said.removeprefix(_END) if said.startswith(_END) else None


def is_step(said: str) -> bool:
    """Whether it tells of a step, by the name of its phase."""
    return said != LOOK and not said.startswith("\0")


@contextmanager
def compiling_told(tick: Tick) -> Generator[None]:
    """Say of kernels when they are compiled within this; those that are found on disk are not."""
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
