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


def answer(question: str, table: pa.Table, known: Mapping[str, Any] | None = None) -> list[tuple[Any, ...]]:
    """Return the rows that a query selects from `rows_of`, the table.

    Args:
        question: query.
        table: table that the query calls `rows_of`.
        known: values of the query's parameters by name.
    """
    with _asked(table) as cursor:
        return cursor.execute(question, known).fetchall()


def answers(question: str, table: pa.Table) -> list[dict[str, Any]]:
    """Return the rows that a query selects from `rows_of` as dictionaries by column name."""
    with _asked(table) as cursor:
        done = cursor.execute(question)
        names = [column[0] for column in done.description or ()]
        return [dict(zip(names, row, strict=True)) for row in done.fetchall()]


@contextmanager
def _asked(table: pa.Table) -> Generator[duckdb.DuckDBPyConnection]:
    with _database().cursor() as cursor:
        cursor.register("rows_of", table)
        try:
            yield cursor
        finally:
            cursor.unregister("rows_of")


@cache
def _database() -> duckdb.DuckDBPyConnection:
    # One thread only, so that no other thread disturbs later timings in this process.
    return duckdb.connect(config={"threads": 1})
