"""Questions in SQL to a table of rows, all to one database in memory: opening one takes longer than most answers."""

from __future__ import annotations

from collections.abc import Generator, Mapping
from contextlib import contextmanager
from functools import cache
from typing import Any

import duckdb
import pyarrow as pa


def answer(question: str, table: pa.Table, known: Mapping[str, Any] | None = None) -> list[tuple[Any, ...]]:
    """The rows that SQL answers about `rows_of`, the table; known: the values of its parameters by name."""
    with _asked(table) as cursor:
        return cursor.execute(question, known).fetchall()


def answers(question: str, table: pa.Table) -> list[dict[str, Any]]:
    """The same with the names of the answer's columns."""
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
    # Of one thread: what is timed later in this process has no other one beside it.
    return duckdb.connect(config={"threads": 1})
