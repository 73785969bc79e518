"""Where the command line writes: tables to standard output; messages, and what the log tells, to standard error.

Rich is loaded when something is written: no command has to wait for it before.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from functools import cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

_LONGEST = 4_000
"""Characters of a line: names in foreign files may have millions."""
_PIPE = 240
"""Columns of a pipe or a file, which has no width of its own, and where no cell should be cut."""


@cache
def out() -> Console:
    """Standard output."""
    from rich.console import Console

    made = Console()
    if not made.is_terminal:
        made.width = _PIPE
    return made


@cache
def err() -> Console:
    """Standard error."""
    from rich.console import Console

    return Console(stderr=True)


def aligned(lines: Sequence[Sequence[str]]) -> Iterator[str]:
    """Lines of cells in columns, the first of them headings: plain, for tables of many thousand lines, of which Rich
    lays out a thousand a second."""
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    for number, line in enumerate(lines):
        yield "  ".join(map(str.ljust, line, widths)).rstrip()
        if number == 0:
            yield "  ".join("─" * width for width in widths)


def say(line: str) -> None:
    """Print a line to standard error, as it stands; no more of it than fits a screen."""
    from rich.markup import escape

    err().print(escape(line if len(line) <= _LONGEST else line[:_LONGEST] + " ..."), highlight=False, soft_wrap=True)


def show_log() -> None:
    """Show what the project's modules log, such as effects that were left out, each message once."""
    log = logging.getLogger("springbench")
    if not log.handlers:
        handler = _Saying()
        handler.addFilter(_Once())
        log.addHandler(handler)
        log.setLevel(logging.INFO)


def write_plainly() -> None:
    """In a copy of this process: write to its own standard error, whatever is drawn on this one's."""
    width = err().width
    err.cache_clear()
    err().width = width


class _Saying(logging.Handler):
    """Says each message."""

    def emit(self, record: logging.LogRecord) -> None:
        say(record.getMessage())


class _Once(logging.Filter):
    """Lets a message pass once: a command builds a scene several times."""

    def __init__(self) -> None:
        super().__init__()
        self._seen: set[str] = set()

    def filter(self, record: logging.LogRecord) -> bool:
        message = record.getMessage()
        fresh = message not in self._seen
        self._seen.add(message)
        return fresh
