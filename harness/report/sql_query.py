"""SQL over the rows of all sweeps, accuracy configs and ablations.

DuckDB reads the Parquet files. A query runs in the child process of `springbench.harness.execution.sandbox`, because it
may exceed the allowed time or memory. Read-only queries are answered from the files; for other statements (PIVOT,
CREATE) all rows are loaded into memory first.
"""

from __future__ import annotations

import csv
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, TextIO

import duckdb
import pyarrow as pa
from rich.table import Table
from rich.text import Text
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.execution import sandbox
from springbench.harness.results import parquet_rows, row_store, row_union, run_schema

_TABLE_SCHEMAS: dict[str, pa.Schema] = {
    "rows": run_schema.RUN_SCHEMA,
    "accuracy": pa.schema([]),
    "ablation": pa.schema([]),
}
"""The tables by the names of their folders, with the columns that exist even if no row has them."""

_SECONDS_PER_FILE = 1e-3
"""Additional processor time per file [s]; a file takes a third of it."""
_FILE_ERRORS = (duckdb.IOException, duckdb.InvalidInputException)
"""Exceptions that damaged files raise; DuckDB also raises its base class of all errors for them."""
_MAX_ATTEMPTS = 2
"""Number of attempts: files that are packed while a query reads them are located again."""

MANY_FILES = 500
"""Number of files from which on opening them takes most of a query's time."""
MAX_SHOWN_ROWS, MAX_CSV_ROWS = 1_000, 1_000_000
"""Maximum number of rows of a result in a table and in CSV; the rest is omitted."""
QUERY_MEMORY_BYTES = 2**30
"""Memory limit of a query, tables included [bytes]."""
_MAX_CELL_CHARACTERS, _MAX_TABLE_COLUMNS = 1_000, 200
"""Maximum number of characters per cell, and of columns, in a printed table; larger tables are unreadable."""
_MAX_CHARACTERS = 50_000_000
"""Maximum number of characters of all texts of a result together."""


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
    folders = {table: row_store.find_row_folders(results, table, "*/") for table in _TABLE_SCHEMAS}
    every = list(chain(*folders.values()))
    files = sum(len(row_store.list_unit_files(folder)) for folder in every)
    if not files and not any(row_store.build_packed_path(folder).exists() for folder in every):
        raise InputError(f"{results}: contains no rows; run a sweep first, or name its folder with --results")
    limits = sandbox.CallLimits(cpu_seconds + _SECONDS_PER_FILE * files, QUERY_MEMORY_BYTES)
    try:
        found = sandbox.call_in_sandbox(_run_with_retries, sql, folders, max_rows, limits=limits)
    except sandbox.SandboxError as error:
        raise InputError(f"query: {error}; request less, or raise --cpu-limit") from None
    return replace(found, num_files=files)


def _run_with_retries(sql: str, folders: dict[str, list[Path]], max_rows: int) -> QueryResult:
    units = {
        table: [unit for folder in folders[table] for unit in row_store.list_units(folder)] for table in _TABLE_SCHEMAS
    }
    for _ in range(_MAX_ATTEMPTS):
        with suppress(row_union.SchemaMismatch):  # units were packed after they were listed
            return _execute_query(sql, units, max_rows)
    try:  # units are damaged, or DuckDB interprets their paths as patterns
        return _execute_query(sql, units, max_rows, in_memory=True)
    except row_union.SchemaMismatch as error:
        raise InputError(f"query: {str(error)[:2000]}") from error


def _execute_query(sql: str, units: dict[str, list[Path]], max_rows: int, *, in_memory: bool = False) -> QueryResult:
    with row_union.open_connection(QUERY_MEMORY_BYTES // 2) as connection:
        try:
            reads = all(s.type == duckdb.StatementType.SELECT for s in connection.extract_statements(sql))
            _register_tables(connection, units, as_views=reads and not in_memory)
            found: Any = connection.execute(sql)
            if found is None or found.description is None:
                raise InputError("query: has no statement; expected one, such as SELECT count(*) FROM rows")
            values, characters = list[tuple[Any, ...]](), 0
            while len(values) <= max_rows and characters < _MAX_CHARACTERS and (row := found.fetchone()):
                values.append(_plain_values(row))
                characters += sum(len(value) for value in values[-1] if isinstance(value, str))
        except duckdb.Error as error:
            if isinstance(error, _FILE_ERRORS) or type(error) is duckdb.Error:
                raise  # `open_connection` converts it to SchemaMismatch
            raise InputError(f"query: {str(error)[:2000]}") from error
        except (ValueError, OverflowError) as error:  # dates and numbers that Python cannot represent
            raise InputError(f"query: {str(error)[:2000]}") from error
        names = [column[0] for column in found.description]
        return QueryResult(names, values[:max_rows], len(values) > max_rows or characters >= _MAX_CHARACTERS)


def _register_tables(connection: duckdb.DuckDBPyConnection, units: dict[str, list[Path]], *, as_views: bool) -> None:
    """Register the tables of rows and disable all other access.

    With `as_views`, rows are read from files on demand, and these files stay accessible, so that this mode is only for
    read-only statements. Otherwise the tables are in memory.
    """
    files: list[str] = []
    for table, schema in _TABLE_SCHEMAS.items():
        if not units[table] and not len(schema):
            continue
        if as_views:
            whole = row_union.build_union(connection, table, units[table], schema, "default")
            connection.execute(f"CREATE VIEW {table} AS {whole.build_query()}")
            files += whole.files
        else:
            connection.register(table, parquet_rows.read_rows(units[table], schema))
    connection.execute("SET allowed_paths = $files", {"files": files})
    connection.execute("SET enable_external_access = false; SET lock_configuration = true")


def _plain_values(row: tuple[Any, ...]) -> tuple[Any, ...]:
    """Convert a row's DuckDB types to plain Python values."""
    return tuple(v if isinstance(v, (int, float, bool, str, type(None))) else str(v) for v in row)
