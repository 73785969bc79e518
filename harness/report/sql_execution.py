"""Execution of an SQL query on files of rows, in the process of `springbench.harness.execution.sandbox`.

DuckDB reads the Parquet files. Read-only queries are answered from the files; for other statements (PIVOT, CREATE) all
rows are loaded into memory first.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import duckdb
import pyarrow as pa
from springbench.harness.errors import InputError
from springbench.harness.results import row_store, row_union
from springbench.harness.results.run_schema import RUN_SCHEMA

_FILE_ERRORS = (duckdb.IOException, duckdb.InvalidInputException)
"""Exceptions that damaged files raise; DuckDB also raises its base class of all errors for them."""
_MAX_ATTEMPTS = 2
"""Number of attempts: files that are packed while a query reads them are located again."""
_MAX_CHARACTERS = 50_000_000
"""Maximum number of characters of all texts of a result together."""

SelectedRows = tuple[list[str], list[tuple[Any, ...]], bool]
"""Names of the columns, the rows, and whether further rows were omitted."""


def execute_query(sql: str, folders: Mapping[str, Sequence[Path]], max_rows: int, memory_bytes: int) -> SelectedRows:
    """Execute a query on tables of rows.

    Args:
        sql: query.
        folders: folders of rows of each table.
        max_rows: maximum number of rows of the result.
        memory_bytes: memory limit of DuckDB [bytes].

    Raises:
        InputError: if the query is invalid or the rows cannot be read.
    """
    units = {table: [unit for one in found for unit in row_store.list_units(one)] for table, found in folders.items()}
    for _ in range(_MAX_ATTEMPTS):
        with suppress(row_union.SchemaMismatch):  # units were packed after they were listed
            return _select_rows(sql, units, max_rows, memory_bytes)
    try:  # units are damaged, or DuckDB interprets their paths as patterns
        return _select_rows(sql, units, max_rows, memory_bytes, in_memory=True)
    except row_union.SchemaMismatch as error:
        raise InputError(f"query: {str(error)[:2000]}") from error


def _select_rows(
    sql: str, units: Mapping[str, Sequence[Path]], max_rows: int, memory_bytes: int, *, in_memory: bool = False
) -> SelectedRows:
    with row_union.open_connection(memory_bytes) as connection:
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
        return names, values[:max_rows], len(values) > max_rows or characters >= _MAX_CHARACTERS


def _register_tables(
    connection: duckdb.DuckDBPyConnection, units: Mapping[str, Sequence[Path]], *, as_views: bool
) -> None:
    """Register the tables of rows and disable all other access.

    With `as_views`, rows are read from files on demand, and these files stay accessible, so that this mode is only for
    read-only statements. Otherwise the tables are in memory.
    """
    files: list[str] = []
    for table, paths in units.items():
        schema = RUN_SCHEMA if table == "rows" else pa.schema([])  # columns that exist even if no row has them
        if not paths and not len(schema):
            continue
        if as_views:
            whole = row_union.build_union(connection, table, paths, schema, "default")
            connection.execute(f"CREATE VIEW {table} AS {whole.build_query()}")
            files += whole.files
        else:
            from springbench.harness.results.parquet_rows import read_rows

            connection.register(table, read_rows(paths, schema))
    connection.execute("SET allowed_paths = $files", {"files": files})
    connection.execute("SET enable_external_access = false; SET lock_configuration = true")


def _plain_values(row: tuple[Any, ...]) -> tuple[Any, ...]:
    """Convert a row's DuckDB types to plain Python values."""
    return tuple(v if isinstance(v, (int, float, bool, str, type(None))) else str(v) for v in row)
