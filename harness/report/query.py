"""SQL over the rows of all sweeps, accuracy configs and ablations.

DuckDB reads the Parquet files. A query runs in the child process of `harness.base.child`, because it may exceed
the allowed time or memory. Read-only queries are answered from the files; for other statements (PIVOT, CREATE) all rows
are loaded into memory first.
"""

from __future__ import annotations

import csv
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, TextIO

import duckdb
import pyarrow as pa
from rich.table import Table
from rich.text import Text

from harness.base import child, columns, rows, shelf, union
from harness.base.errors import InputError, Mistake

_TABLES: dict[str, pa.Schema] = {"rows": columns.SCHEMA, "accuracy": pa.schema([]), "ablation": pa.schema([])}
"""The tables by the names of their folders, with the columns that exist even if no row has them."""

_OPENING = 1e-3
"""Additional processor time per file [s]; a file takes a third of it."""
_OF_FILES = (duckdb.IOException, duckdb.InvalidInputException)
"""Exceptions that damaged files raise; DuckDB also raises its base class of all errors for them."""
_TRIES = 2
"""Number of attempts: files that are packed while a query reads them are located again."""

SHOWN, PRINTED = 1_000, 1_000_000
"""Maximum number of rows of a result in a table and in CSV; the rest is omitted."""
MEMORY = 2**30
"""Memory limit of a query, tables included [bytes]."""
_CELL, _COLUMNS = 1_000, 200
"""Maximum number of characters per cell, and of columns, in a printed table; larger tables are unreadable."""
_CHARACTERS = 50_000_000
"""Maximum number of characters of all texts of a result together."""


@dataclass(frozen=True, slots=True)
class QueryResult:
    """Column names and rows of a query result; `more` states whether further rows were omitted."""

    columns: list[str]
    values: list[tuple[Any, ...]]
    more: bool = False

    def table(self) -> Table:
        """Build a printable table of the result; cell contents are plain text, not markup."""
        table = Table()
        for name in self.columns[:_COLUMNS]:
            table.add_column(Text(_shown(name)))
        for row in self.values:
            table.add_row(*(Text(_shown(value)) for value in row[:_COLUMNS]))
        return table

    def write_csv(self, file: TextIO) -> None:
        """Write the result as CSV with all digits."""
        writer = csv.writer(file)
        writer.writerow(self.columns)
        writer.writerows(self.values)


def _shown(value: Any) -> str:
    text = "" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)
    return "".join(c if c.isprintable() else " " for c in text[:_CELL])


def answer(sql: str, results: Path, *, most: int = SHOWN, seconds: float = 15.0) -> QueryResult:
    """Run a query on the tables `rows`, `accuracy` and `ablation`.

    The query has no other read access and cannot write.

    Args:
        sql: query.
        results: folder of results.
        most: maximum number of rows of the result.
        seconds: limit of the processor time [s].
    Raises:
        InputError: if there are no rows, if the query exceeds a limit, or, with DuckDB's message, if it is invalid.
    """
    if not 0.0 < seconds <= 1e6:
        raise InputError(Mistake(f"came {seconds:g}; wanted a number of seconds above 0", key="--seconds"))
    folders = {table: shelf.folders(results, table, "*/") for table in _TABLES}
    every = list(chain(*folders.values()))
    files = sum(len(shelf.own_files(folder)) for folder in every)
    if not files and not any(shelf.packed_file(folder).exists() for folder in every):
        raise InputError(f"{results}: holds no rows; run a sweep first, or name its folder with --results")
    limits = child.Allowance(seconds + _OPENING * files, MEMORY)
    try:
        return child.call(_answered, sql, folders, most, limits=limits)
    except child.NoAnswer as error:
        raise InputError(f"query: {error}; ask for less, or give it more with --seconds") from None


def _answered(sql: str, folders: dict[str, list[Path]], most: int) -> QueryResult:
    units = {table: [unit for folder in folders[table] for unit in shelf.units(folder)] for table in _TABLES}
    for _ in range(_TRIES):
        with suppress(union.Unfit):  # units were packed since they were looked for
            return _found(sql, units, most)
    try:  # else units are damaged, or their paths are patterns to DuckDB
        return _found(sql, units, most, in_memory=True)
    except union.Unfit as error:
        raise InputError(f"query: {str(error)[:2000]}") from error


def _found(sql: str, units: dict[str, list[Path]], most: int, *, in_memory: bool = False) -> QueryResult:
    with union.connected(MEMORY // 2) as connection:
        try:
            reads = all(s.type == duckdb.StatementType.SELECT for s in connection.extract_statements(sql))
            _offer(connection, units, lazily=reads and not in_memory)
            found: Any = connection.execute(sql)
            if found is None or found.description is None:
                raise InputError("query: came without a statement; wanted one, such as SELECT count(*) FROM rows")
            values, characters = list[tuple[Any, ...]](), 0
            while len(values) <= most and characters < _CHARACTERS and (row := found.fetchone()):
                values.append(_plain(row))
                characters += sum(len(value) for value in values[-1] if isinstance(value, str))
        except duckdb.Error as error:
            if isinstance(error, _OF_FILES) or type(error) is duckdb.Error:
                raise
            raise InputError(f"query: {str(error)[:2000]}") from error
        except (ValueError, OverflowError) as error:  # dates and numbers that Python does not have
            raise InputError(f"query: {str(error)[:2000]}") from error
        names = [column[0] for column in found.description]
        return QueryResult(names, values[:most], len(values) > most or characters >= _CHARACTERS)


def _offer(connection: duckdb.DuckDBPyConnection, units: dict[str, list[Path]], *, lazily: bool) -> None:
    """Register the tables of rows and disable all other access.

    With `lazily`, rows are read from files on demand, and these files stay accessible, so that this mode is only for
    read-only statements. Otherwise the tables are in memory.
    """
    files: list[str] = []
    for table, schema in _TABLES.items():
        if not units[table] and not len(schema):
            continue
        if lazily:
            whole = union.union(connection, table, units[table], schema, "default")
            connection.execute(f"CREATE VIEW {table} AS {whole.select()}")
            files += whole.files
        else:
            connection.register(table, rows.read(units[table], schema))
    connection.execute("SET allowed_paths = $files", {"files": files})
    connection.execute("SET enable_external_access = false; SET lock_configuration = true")


def _plain(row: tuple[Any, ...]) -> tuple[Any, ...]:
    """Convert a row's DuckDB types to plain Python values."""
    return tuple(v if isinstance(v, (int, float, bool, str, type(None))) else str(v) for v in row)
