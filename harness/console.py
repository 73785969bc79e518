"""Console output: tables on standard output, messages and log records on standard error.

Rich is imported on first output, so that no command waits for it earlier.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator, Sequence
from functools import cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console, Group
    from rich.table import Column, Table

_MAX_LINE_LENGTH = 4_000
"""Maximum number of characters of a line; names in untrusted files may have millions."""
CONSOLE_WIDTH = 100
"""Maximum width of the project's own tables, in columns."""
_PIPE_WIDTH = 240
"""Width of a pipe or a file, in columns. Neither has a width of its own, and no cell should be truncated there."""


_ACTIVITY_WIDTH = 40
"""Characters to which an activity is padded, so that nothing of an earlier one remains."""


@cache
def get_output_console() -> Console:
    """Return the console of standard output."""
    from rich.console import Console

    made = Console()
    if not made.is_terminal:
        made.width = _PIPE_WIDTH
    return made


@cache
def get_error_console() -> Console:
    """Return the console of standard error."""
    from rich.console import Console

    return Console(stderr=True)


def split_wide_table(table: Table, key_columns: int = 1, width: int = CONSOLE_WIDTH) -> Group:
    """Split a table into parts of at most `width` characters.

    Each part repeats the first key_columns columns and adds as many others as fit. Columns without values are omitted.
    A column that is too wide by itself is folded.

    Args:
        table: table to split.
        key_columns: number of leading columns that each part repeats.
        width: maximum width, in characters.

    Returns:
        The parts, followed by the caption.
    """
    from rich.console import Console, Group
    from rich.constrain import Constrain
    from rich.measure import Measurement
    from rich.text import Text

    first, wide = table.columns[:key_columns], Console(width=1000)
    groups: list[list[Column]] = [[]]
    for column in table.columns[key_columns:]:
        if table.row_count and all(cell in ("", "–") for cell in column.cells):
            continue
        natural = Measurement.get(wide, wide.options, _select_columns(table, [*first, *groups[-1], column])).maximum
        if groups[-1] and natural > width:
            groups.append([])
        groups[-1].append(column)
    parts = [_select_columns(table, [*first, *group]) for group in groups]
    for part in parts:
        part.width = min(Measurement.get(wide, wide.options, part).maximum, width)
    parts[0].title = table.title
    words = Text.from_markup(str(table.caption or ""), style="table.caption")
    return Group(*parts, *([Constrain(words, width)] if words else []))


def _select_columns(table: Table, columns: Sequence[Column]) -> Table:
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


def format_plain_table(lines: Sequence[Sequence[str]]) -> Iterator[str]:
    """Format lines of cells as a plain table whose first line has the headings.

    It is for tables of many thousand lines, because Rich formats only a thousand lines per second.
    """
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    for number, line in enumerate(lines):
        yield "  ".join(map(str.ljust, line, widths)).rstrip()
        if number == 0:
            yield "  ".join("-" * width for width in widths)


def print_message(line: str) -> None:
    """Print one line to standard error without markup, truncated to 4000 characters."""
    from rich.markup import escape

    get_error_console().print(
        escape(line if len(line) <= _MAX_LINE_LENGTH else line[:_MAX_LINE_LENGTH] + " ..."),
        highlight=False,
        emoji=False,
        soft_wrap=True,
    )


def show_activity(words: str) -> None:
    """Show an activity on a terminal until the next line of output replaces it."""
    if sys.stderr is not None and sys.stderr.isatty():
        sys.stderr.write(f"{words} ...".ljust(_ACTIVITY_WIDTH) + "\r")
        sys.stderr.flush()


def enable_logging() -> None:
    """Print the log messages of the project, such as omitted effects, each message once."""
    log = logging.getLogger("springbench")
    if not log.handlers:
        handler = _PrintHandler()
        handler.addFilter(_DuplicateFilter())
        log.addHandler(handler)
        log.setLevel(logging.INFO)


def reset_error_console() -> None:
    """Make a forked process write to its standard error with the parent's console width."""
    width = get_error_console().width
    get_error_console.cache_clear()
    get_error_console().width = width


class _PrintHandler(logging.Handler):
    """Prints each log message."""

    def emit(self, record: logging.LogRecord) -> None:
        print_message(record.getMessage())


class _DuplicateFilter(logging.Filter):
    """Drops repeated log messages, because a command builds a scene several times."""

    def __init__(self) -> None:
        super().__init__()
        self._seen: set[str] = set()

    def filter(self, record: logging.LogRecord) -> bool:
        message = record.getMessage()
        fresh = message not in self._seen
        self._seen.add(message)
        return fresh
