"""SQL over the rows of all sweeps, accuracy configs and ablations.

A query runs in the child process of `springbench.harness.execution.sandbox`, because it may exceed the allowed time or
memory. Only that process imports DuckDB and PyArrow.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from springbench.harness.errors import InputError, InputMistake
from springbench.harness.execution import sandbox
from springbench.harness.results import row_store

if TYPE_CHECKING:
    from rich.table import Table

EXECUTE_QUERY = "springbench.harness.report.sql_execution:execute_query"
"""Function that executes a query; only the sandbox imports it."""

_SECONDS_PER_FILE = 1e-3
"""Additional processor time per file [s]; a file takes a third of it."""
MAX_SHOWN_ROWS, MAX_CSV_ROWS = 1_000, 1_000_000
"""Maximum number of rows of a result in a table and in CSV; the rest is omitted."""
QUERY_MEMORY_BYTES = 2**30
"""Memory limit of a query, tables included [bytes]."""
_MAX_CELL_CHARACTERS, _MAX_TABLE_COLUMNS = 1_000, 200
"""Maximum number of characters per cell, and of columns, in a printed table; larger tables are unreadable."""


@dataclass(frozen=True, slots=True)
class QueryResult:
    """Result of a query.

    Attributes:
        columns: names of the columns.
        values: the rows.
        is_truncated: whether further rows were omitted.
        num_files: number of files of rows that the tables consist of, without packed ones.
    """

    columns: list[str]
    values: list[tuple[Any, ...]]
    is_truncated: bool = False
    num_files: int = 0

    def build_table(self) -> Table:
        """Build a printable table of the result; cell contents are plain text, not markup."""
        from rich.table import Table
        from rich.text import Text

        table = Table()
        for name in self.columns[:_MAX_TABLE_COLUMNS]:
            table.add_column(Text(_format_cell(name)))
        for row in self.values:
            table.add_row(*(Text(_format_cell(value)) for value in row[:_MAX_TABLE_COLUMNS]))
        return table

    def write_csv(self, file: TextIO) -> None:
        """Write the result as CSV with all digits."""
        writer = csv.writer(file)
        writer.writerow(self.columns)
        writer.writerows(self.values)


def _format_cell(value: Any) -> str:
    text = "" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)
    return "".join(c if c.isprintable() else " " for c in text[:_MAX_CELL_CHARACTERS])


def run_query(sql: str, results: Path, *, max_rows: int = MAX_SHOWN_ROWS, cpu_seconds: float = 15.0) -> QueryResult:
    """Run a query on the tables `rows`, `accuracy` and `ablation`.

    The query has no other read access and cannot write.

    Args:
        sql: query.
        results: folder of results.
        max_rows: maximum number of rows of the result.
        cpu_seconds: limit of the processor time [s].

    Raises:
        InputError: if there are no rows, if the query exceeds a limit, or, with DuckDB's message, if it is invalid.
    """
    if not 0.0 < cpu_seconds <= 1e6:
        raise InputError(InputMistake(f"got {cpu_seconds:g}; expected a number of seconds above 0", key="--cpu-limit"))
    folders = {table: row_store.find_row_folders(results, table, "*/") for table in row_store.TABLE_FOLDERS}
    every = list(chain(*folders.values()))
    files = sum(len(row_store.list_unit_files(folder)) for folder in every)
    if not files and not any(row_store.build_packed_path(folder).exists() for folder in every):
        raise InputError(f"{results}: contains no rows; run a sweep first, or name its folder with --results")
    limits = sandbox.CallLimits(cpu_seconds + _SECONDS_PER_FILE * files, QUERY_MEMORY_BYTES)
    try:
        columns, values, is_truncated = sandbox.call_in_sandbox(
            EXECUTE_QUERY, sql, folders, max_rows, QUERY_MEMORY_BYTES // 2, limits=limits
        )
    except sandbox.SandboxError as error:
        raise InputError(f"query: {error}; request less, or raise --cpu-limit") from None
    return QueryResult(columns, values, is_truncated, files)
