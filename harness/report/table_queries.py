"""SQL queries on a table of rows, in one shared in-memory database.

Opening a database takes longer than most queries.
"""

from __future__ import annotations

from collections.abc import Generator, Mapping
from contextlib import contextmanager
from functools import cache
from typing import Any

import duckdb
import pyarrow as pa


def query_table(sql: str, table: pa.Table, parameters: Mapping[str, Any] | None = None) -> list[tuple[Any, ...]]:
    """Return the rows that a query selects from `rows_of`, the table.

    Args:
        sql: query.
        table: table that the query calls `rows_of`.
        parameters: values of the query's parameters by name.
    """
    with _register_table(table) as cursor:
        return cursor.execute(sql, parameters).fetchall()


def query_records(sql: str, table: pa.Table) -> list[dict[str, Any]]:
    """Return the rows that a query selects as dictionaries by column name.

    Args:
        sql: query, in which the table is named `rows_of`.
        table: rows that are queried.
    """
    with _register_table(table) as cursor:
        done = cursor.execute(sql)
        names = [column[0] for column in done.description or ()]
        return [dict(zip(names, row, strict=True)) for row in done.fetchall()]


@contextmanager
def _register_table(table: pa.Table) -> Generator[duckdb.DuckDBPyConnection]:
    with _shared_connection().cursor() as cursor:
        cursor.register("rows_of", table)
        try:
            yield cursor
        finally:
            cursor.unregister("rows_of")


@cache
def _shared_connection() -> duckdb.DuckDBPyConnection:
    # One thread only, so that no other thread disturbs later timings in this process.
    return duckdb.connect(config={"threads": 1})
