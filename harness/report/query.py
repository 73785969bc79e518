"""SQL over the rows of all sweeps, accuracy configs and ablations (DuckDB on the Parquet files).

A query runs in the child that `harness.base.child` keeps: it may ask for more time or memory than there is. What only
reads is answered from the files; for other statements (PIVOT, CREATE) all rows are read into memory first.
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
"""The tables by the names of their folders, with the columns that they have even where no row has them."""

_OPENING = 1e-3
"""Seconds of processor time more for each file: a file takes a third of that."""
_OF_FILES = (duckdb.IOException, duckdb.InvalidInputException)
"""What damaged files raise; and the base of all errors, as it is."""
_TRIES = 2
"""Files that are packed while a query reads them are looked for again."""

SHOWN, PRINTED = 1_000, 1_000_000
"""Rows of an answer in a table and in CSV; the rest of them is left out."""
MEMORY = 2**30
"""Bytes that a query may take, the tables included."""
_CELL, _COLUMNS = 1_000, 200
"""Characters of a cell in a table, and its columns: who prints more has lost the table."""
_CHARACTERS = 50_000_000
"""Of all texts of an answer together."""


@dataclass(frozen=True, slots=True)
class QueryResult:
    """Names of columns and the rows of values that a query gave; more: whether there are more than these."""

    columns: list[str]
    values: list[tuple[Any, ...]]
    more: bool = False

    def table(self) -> Table:
        """The answer as a table to print; what cells hold is text and no markup."""
        table = Table()
        for name in self.columns[:_COLUMNS]:
            table.add_column(Text(_shown(name)))
        for row in self.values:
            table.add_row(*(Text(_shown(value)) for value in row[:_COLUMNS]))
        return table

    def write_csv(self, file: TextIO) -> None:
        """Write the answer as CSV with all digits."""
        writer = csv.writer(file)
        writer.writerow(self.columns)
        writer.writerows(self.values)


def _shown(value: Any) -> str:
    text = "" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)
    return "".join(c if c.isprintable() else " " for c in text[:_CELL])


def answer(sql: str, results: Path, *, most: int = SHOWN, seconds: float = 15.0) -> QueryResult:
    """What a query says of the tables `rows`, `accuracy` and `ablation`; it can read nothing else and write nothing.

    most: rows of the answer; seconds: of processor time that it may take. Raises InputError where there are no rows,
    where the query takes too much, or with DuckDB's message where it is wrong.
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
    """The tables of rows, and no way to anything else. lazily: read while they are asked for, from files that are then
    within reach, so this is for statements that only read; else the tables are in memory."""
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
    """A row without DuckDB's own types."""
    return tuple(v if isinstance(v, (int, float, bool, str, type(None))) else str(v) for v in row)
