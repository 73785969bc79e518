"""Where the command line writes: tables to standard output; messages, and what the log tells, to standard error.

Rich is loaded when something is written: no command has to wait for it before.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from functools import cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console, Group
    from rich.table import Column, Table

_LONGEST = 4_000
"""Characters of a line: names in foreign files may have millions."""
WIDTH = 100
"""Columns that tables of our own take at most, wherever they are printed."""
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


def narrow(table: Table, beside: int = 1, width: int = WIDTH) -> Group:
    """A table in parts of `width` characters at most: as many of its columns as fit, beside the first of them, without
    those that say nothing. What is wider alone is folded."""
    from rich.console import Console, Group
    from rich.constrain import Constrain
    from rich.measure import Measurement
    from rich.text import Text

    first, wide = table.columns[:beside], Console(width=1000)
    groups: list[list[Column]] = [[]]
    for column in table.columns[beside:]:
        if table.row_count and all(cell in ("", "–") for cell in column.cells):
            continue
        natural = Measurement.get(wide, wide.options, _with(table, [*first, *groups[-1], column])).maximum
        if groups[-1] and natural > width:
            groups.append([])
        groups[-1].append(column)
    parts = [_with(table, [*first, *group]) for group in groups]
    for part in parts:
        part.width = min(Measurement.get(wide, wide.options, part).maximum, width)
    parts[0].title = table.title
    words = Text.from_markup(str(table.caption or ""), style="table.caption")
    return Group(*parts, *([Constrain(words, width)] if words else []))


def _with(table: Table, columns: Sequence[Column]) -> Table:
    """These columns of a table, without its title and caption."""
    from rich.table import Table

    part = Table(box=table.box, padding=table.padding, pad_edge=table.pad_edge, title_justify="left")
    part.collapse_padding = table.collapse_padding
    for one in columns:
        part.add_column(
            one.header, justify=one.justify, vertical=one.vertical, no_wrap=one.no_wrap, overflow=one.overflow
        )
    for cells, row in zip(zip(*(one.cells for one in columns), strict=True), table.rows, strict=True):
        part.add_row(*cells, end_section=row.end_section)
    return part


def aligned(lines: Sequence[Sequence[str]]) -> Iterator[str]:
    """Lines of cells in columns, the first of them headings: plain, for tables of many thousand lines, of which Rich
    lays out a thousand a second."""
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    for number, line in enumerate(lines):
        yield "  ".join(map(str.ljust, line, widths)).rstrip()
        if number == 0:
            yield "  ".join("-" * width for width in widths)


def say(line: str) -> None:
    """Print a line to standard error, as it stands; no more of it than fits a screen."""
    from rich.markup import escape

    err().print(
        escape(line if len(line) <= _LONGEST else line[:_LONGEST] + " ..."),
        highlight=False,
        emoji=False,
        soft_wrap=True,
    )


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
