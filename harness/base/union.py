# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyarrow's stubs say little of columns, and of files that Parquet is read from.
"""The rows of many units at once, by DuckDB on their Parquet files; those of one schema are read together.

`union_by_name` would do as much for files of any schema, and takes 140 kB of memory a file. What does not fit together
raises `Unfit`: whoever reads then looks unit by unit, and can say which. So does a path that is a pattern to DuckDB.
"""

from __future__ import annotations

import os
import re
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from harness.base.shelf import FILE, Part, parts
from harness.base.shelf import schema as schema_of

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection

Promote = Literal["default", "permissive"]

MEMORY = 2**29
"""Bytes that DuckDB may take beside what it hands out."""


class Unfit(Exception):
    """The units cannot be read together; damaged: the numbers of those that are no files of rows."""

    def __init__(self, why: str, damaged: Sequence[int] = ()) -> None:
        super().__init__(why)
        self.damaged = frozenset(damaged)


@dataclass(frozen=True, slots=True)
class Union:
    """Parts of units, the schema of all of their rows, and the SQL of each part's rows."""

    parts: list[Part]
    schema: pa.Schema
    sources: list[str]
    """What each part is read from, as a table expression."""
    columns: list[str]
    """The columns of the schema, as they stand in each part."""

    none: str
    """The columns where there are no parts."""

    files: list[str]
    """The files of all parts, by the paths that DuckDB reads."""

    def select(self) -> str:
        """A query for all rows, in the columns of the schema."""
        parts = [f"SELECT {columns} FROM {source}" for columns, source in zip(self.columns, self.sources, strict=True)]
        return " UNION ALL ".join(parts or [f"SELECT {self.none} WHERE false"])


@contextmanager
def connected(memory: int = MEMORY) -> Generator[DuckDBPyConnection]:
    """A DuckDB that reads Parquet files and nothing else, on one thread: others may be timed."""
    import duckdb

    settings: Any = {"memory_limit": f"{memory}B", "threads": 1, "temp_directory": ""}
    try:
        with duckdb.connect(config=settings) as connection:
            connection.execute("SET enable_external_file_cache = false; SET disable_parquet_prefetching = true")
            yield connection
    except (duckdb.Error, pa.ArrowException, OSError, MemoryError) as error:
        raise Unfit(str(error)) from error


def union(
    connection: DuckDBPyConnection, name: str, asked: Sequence[Path], schema: pa.Schema, promote: Promote
) -> Union:
    """Units as DuckDB reads them, in variables of these names; the schema's columns come first.

    Values come from inside the files alone: a folder called `size=64` sets no column. Raises Unfit, and InputError for
    a packed file that is damaged.
    """
    found, damaged = parts(asked)
    if damaged:
        raise Unfit("not all are files of rows", damaged)
    try:
        schemas = [schema_of(part) for part in found]
        whole = pa.unify_schemas([schema, *schemas], promote_options=promote).remove_metadata()
    except (pa.ArrowException, OSError) as error:
        raise Unfit(str(error)) from error
    names = [name.casefold() for name in whole.names]
    if len({*names, *_RESERVED}) < len(names) + len(_RESERVED):
        raise Unfit("columns whose names DuckDB cannot tell apart")
    types = _types(connection, whole)
    sources: list[str] = []
    columns: list[str] = []
    files: list[str] = []
    for number, (part, own) in enumerate(zip(found, schemas, strict=True)):
        variable = f"{name}_{number}"
        literal = _literal(part.files)
        files += literal
        connection.execute(f"SET VARIABLE {variable} = $files", {"files": literal})
        source = f"read_parquet(getvariable('{variable}'), hive_partitioning = false)"
        if part.packed is not None:
            connection.execute(f"SET VARIABLE {variable}_units = $units", {"units": list(part.packed)})
            source += f" WHERE {FILE} IN (SELECT unnest(getvariable('{variable}_units')))"
        sources.append(source)
        columns.append(", ".join(_column(field, own, types[field.name]) for field in whole))
    none = ", ".join(_column(field, pa.schema([]), types[field.name]) for field in whole)
    return Union(found, whole, sources, columns, none, files)


_PATTERN = re.compile(r"[*?\[\\\ud800-\udfff]")
"""Characters by which DuckDB takes a path for a pattern of several files, and those that UTF-8 does not have."""


def _literal(files: Sequence[str]) -> list[str]:
    """Paths that DuckDB takes as they are: absolute, or `~` and `file:` at the start had a meaning. Raises Unfit."""
    found = [os.path.abspath(file) for file in files]
    if bad := next((file for file in found if _PATTERN.search(file)), None):
        raise Unfit(f"{bad!a} would be read as a pattern")
    return found


def table(
    asked: Sequence[Path],
    schema: pa.Schema,
    needed: Sequence[str] = (),
    *,
    most: int,
    promote: Promote = "default",
) -> tuple[pa.Table, NDArray[np.int64]]:
    """All rows of units, in their order, and the number of each row's unit. needed: columns that no row lacks; most:
    rows of one unit.

    Raises Unfit where a unit is damaged, has no rows or more than that, or lacks what is needed.
    """
    with connected() as connection:
        whole = union(connection, "files", asked, schema, promote)
        if FILE in whole.schema.names:
            raise Unfit(f"a file has a column {FILE} of its own")
        tables = [whole.schema.empty_table()]
        numbers = [np.empty(0, np.int64)]
        count, checked = 0, False
        for part, columns, source in zip(whole.parts, whole.columns, whole.sources, strict=True):
            at = "file_index" if part.packed is None else FILE
            for batch in connection.sql(f"SELECT {columns}, {at} AS {_AT} FROM {source}").to_arrow_reader(100_000):
                read = pa.table(batch)
                numbers.append(_numbers(part, read[_AT]))
                tables.append(read.drop_columns([_AT]).cast(whole.schema))
                count += len(read)
                if not checked and count > most:  # only then can a file claim as many
                    _check_claims(whole.files, most)
                    checked = True
    number = np.concatenate(numbers)
    found = pa.concat_tables(tables)
    lacking = [name for name in needed if name not in found.column_names or found[name].null_count]
    if lacking or len(np.unique(number)) < len(asked):
        raise Unfit(f"no {lacking[0]}" if lacking else "not all have rows")
    if np.all(np.diff(number) >= 0):
        return found, number
    order = np.argsort(number, kind="stable")
    return found.take(order), number[order]


def _check_claims(files: Sequence[str], most: int) -> None:
    if any(pq.read_metadata(file).num_rows > most for file in files):
        raise Unfit("a file has too many rows")


def heads(
    asked: Sequence[Path], columns: Sequence[str], schema: pa.Schema, needed: Sequence[str] = ()
) -> dict[int, dict[str, Any]]:
    """Columns of the first row of each unit, by its number; none of those that have no rows, or lack what is needed.

    Raises Unfit.
    """
    with connected() as connection:
        whole = union(connection, "files", asked, schema, "default")
        found: dict[int, dict[str, Any]] = {}
        named = ", ".join(f"'{name}': {_quoted(name)}" for name in columns)
        full = " AND ".join([f"count({_quoted(name)}) = count(*)" for name in needed] or ["true"])
        for part, stated, source in zip(whole.parts, whole.columns, whole.sources, strict=True):
            at = "file_index" if part.packed is None else FILE
            rows = f"SELECT {stated}, {at} AS {_AT}, file_row_number AS {_ROW} FROM {source}"
            sql = f"SELECT {_AT}, arg_min({{{named}}}, {_ROW}) FROM ({rows}) GROUP BY {_AT} HAVING {full}"
            for which, head in connection.execute(sql).fetchall():
                found[part.numbers[which] if part.packed is None else part.packed[which]] = head
    return found


_AT, _ROW = "unit_asked_for", "row_of_the_unit"
_RESERVED = (_AT, _ROW, "file_index", "file_row_number", "filename")
"""Names that no column may have: ours, and those by which DuckDB states where a row comes from."""


def _numbers(part: Part, at: Any) -> np.ndarray[Any, np.dtype[np.int64]]:
    """The number of each row's unit."""
    if part.packed is None:
        return np.asarray(part.numbers, np.int64)[at.to_numpy()]
    coded = at.combine_chunks().dictionary_encode()
    return np.array([part.packed[name] for name in coded.dictionary.to_pylist()], np.int64)[coded.indices.to_numpy()]


def _types(connection: DuckDBPyConnection, schema: pa.Schema) -> dict[str, str]:
    """DuckDB's names of the columns' types."""
    connection.register("empty", schema.empty_table())
    types = connection.execute("SELECT column_name, column_type FROM (DESCRIBE empty)").fetchall()
    connection.unregister("empty")
    return dict(types)


def _column(field: pa.Field[Any], own: pa.Schema, type: str) -> str:
    """A column of the whole schema as it is read from a part."""
    name = _quoted(field.name)
    at = own.get_field_index(field.name)
    if at >= 0 and own.field(at).type == field.type:
        return name
    return f"CAST({'NULL' if at < 0 else name} AS {type}) AS {name}"


def _quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"'
