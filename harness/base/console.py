"""Console output: tables on standard output, messages and log records on standard error.

Rich is imported on first output, so that no command waits for it earlier.
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
"""Maximum number of characters of a line; names in untrusted files may have millions."""
WIDTH = 100
"""Maximum width of the project's own tables, in columns."""
_PIPE = 240
"""Width of a pipe or a file, in columns. Neither has a width of its own, and no cell should be truncated there."""


@cache
def out() -> Console:
    """Return the console of standard output."""
    from rich.console import Console

    made = Console()
    if not made.is_terminal:
        made.width = _PIPE
    return made


@cache
def err() -> Console:
    """Return the console of standard error."""
    from rich.console import Console

    return Console(stderr=True)


def narrow(table: Table, beside: int = 1, width: int = WIDTH) -> Group:
    """Split a table into parts of at most `width` characters.

    Each part repeats the first beside columns and adds as many others as fit. Columns without values are omitted.
    A column that is too wide by itself is folded.

    Args:
        table: table to split.
        beside: number of leading columns that each part repeats.
        width: maximum width, in characters.
    Returns: the parts, followed by the caption.
    """
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
    """Return a table with the given columns only, without title and caption."""
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
    """Format lines of cells as a plain table whose first line has the headings.

    It is for tables of many thousand lines, of which Rich lays out a thousand per second.
    """
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    for number, line in enumerate(lines):
        yield "  ".join(map(str.ljust, line, widths)).rstrip()
        if number == 0:
            yield "  ".join("-" * width for width in widths)


def say(line: str) -> None:
    """Print one line to standard error without markup, truncated to 4000 characters."""
    from rich.markup import escape

    err().print(
        escape(line if len(line) <= _LONGEST else line[:_LONGEST] + " ..."),
        highlight=False,
        emoji=False,
        soft_wrap=True,
    )


def show_log() -> None:
    """Print the log messages of the project, such as omitted effects, each message once."""
    log = logging.getLogger("springbench")
    if not log.handlers:
        handler = _Saying()
        handler.addFilter(_Once())
        log.addHandler(handler)
        log.setLevel(logging.INFO)


def write_plainly() -> None:
    """In a forked process, write to its own standard error with the parent's console width."""
    width = err().width
    err.cache_clear()
    err().width = width


class _Saying(logging.Handler):
    """Prints each log message."""

    def emit(self, record: logging.LogRecord) -> None:
        say(record.getMessage())


class _Once(logging.Filter):
    """Drops repeated log messages, because a command builds a scene several times."""

    def __init__(self) -> None:
        super().__init__()
        self._seen: set[str] = set()

    def filter(self, record: logging.LogRecord) -> bool:
        message = record.getMessage()
        fresh = message not in self._seen
        self._seen.add(message)
        return fresh
