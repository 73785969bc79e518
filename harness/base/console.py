"""Where the command line writes: tables to standard output; messages, and what the log tells, to standard error."""

from __future__ import annotations

import logging

from rich.console import Console
from rich.logging import RichHandler
from rich.markup import escape

out, err = Console(), Console(stderr=True)
if not out.is_terminal:
    out.width = 240  # a pipe or a file has no width of its own, and no cell should be cut there


_LONGEST = 4_000
"""Characters of a line: names in foreign files may have millions."""


def say(line: str) -> None:
    """Print a line to standard error, as it stands; no more of it than fits a screen."""
    err.print(escape(line if len(line) <= _LONGEST else line[:_LONGEST] + " ..."), highlight=False, soft_wrap=True)


def show_log() -> None:
    """Show what the project's modules log, such as effects that were left out, each message once."""
    log = logging.getLogger("springbench")
    if not log.handlers:
        handler = RichHandler(console=err, show_time=False, show_path=False, show_level=False, markup=False)
        handler.addFilter(_Once())
        log.addHandler(handler)
        log.setLevel(logging.INFO)


def log_plainly() -> None:
    """In a copy of this process: show the log on its own standard error, whatever is drawn on this one's."""
    for handler in logging.getLogger("springbench").handlers:
        if isinstance(handler, RichHandler):
            handler.console = Console(stderr=True, width=err.width)


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
