# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyarrow's stubs have incomplete types of columns, and of files that Parquet is read from.
"""Queries over the rows of many units, by DuckDB on Parquet files.

Files of one schema are read together. DuckDB's `union_by_name` would do the same for files of any schema, but takes 140
kB of memory per file. Units that cannot be read together raise `Unfit`. The caller then reads unit by unit and
can name the invalid one. A path that DuckDB would interpret as a pattern raises it too.
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
"""Memory limit of DuckDB, beyond its results, in bytes."""


class Unfit(Exception):
    """The units cannot be read together.

    damaged: indices of units that are not files of rows.
    """

    def __init__(self, why: str, damaged: Sequence[int] = ()) -> None:
        super().__init__(why)
        self.damaged = frozenset(damaged)


@dataclass(frozen=True, slots=True)
class Union:
    """Groups of units, with their common schema and the SQL of their rows."""

    parts: list[Part]
    schema: pa.Schema
    sources: list[str]
    """Table expression of each group."""
    columns: list[str]
    """Select list of each group, in the order of the schema."""

    none: str
    """Select list without any group."""

    files: list[str]
    """Paths of all groups' files, as DuckDB reads them."""

    def select(self) -> str:
        """Build a query for all rows, in the columns of the schema."""
        parts = [f"SELECT {columns} FROM {source}" for columns, source in zip(self.columns, self.sources, strict=True)]
        return " UNION ALL ".join(parts or [f"SELECT {self.none} WHERE false"])


@contextmanager
def connected(memory: int = MEMORY) -> Generator[DuckDBPyConnection]:
    """Open a DuckDB connection that reads only Parquet files.

    It uses one thread because other runs may be timed.

    Raises:
        Unfit: for an error of DuckDB, Arrow or the system inside the block.
    """
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
    """Build the union of units for DuckDB; the schema's columns come first.

    Values come only from inside the files: a folder called `size=64` sets no column.

    Args:
        connection: open connection, in which variables of the given name are set.
        name: prefix of the variables.
        asked: row files of the units.
        schema: columns that the union has at least.
        promote: mode of Arrow's schema unification.
    Raises:
        Unfit: if the units cannot be read together.
        InputError: for a damaged packed file.
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
"""Characters that DuckDB interprets as a pattern of several files, and those that UTF-8 lacks."""


def _literal(files: Sequence[str]) -> list[str]:
    """Return absolute paths, because DuckDB interprets `~` and `file:` at the start.

    Raises:
        Unfit: for a pattern.
    """
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
    """Read all rows of units, in their order.

    Args:
        asked: row files of the units.
        schema: columns that the table has at least.
        needed: columns that no row may lack.
        most: maximum number of rows of one unit.
        promote: mode of Arrow's schema unification.
    Returns: the rows, and the index of each row's unit (n,).
    Raises:
        Unfit: if a unit is damaged, empty or too long, or lacks a required column.
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
    """Query columns of the first row of each unit.

    Units without rows, or without a required column, are omitted.

    Args:
        asked: row files of the units.
        columns: columns to return.
        schema: columns that the union has at least.
        needed: columns that no row may lack.
    Returns: values by the index of the unit.
    Raises:
        Unfit: if the units cannot be read together.
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
"""Reserved column names: the module's own, and those by which DuckDB reports the source of a row."""


def _numbers(part: Part, at: Any) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Compute the index of each row's unit."""
    if part.packed is None:
        return np.asarray(part.numbers, np.int64)[at.to_numpy()]
    coded = at.combine_chunks().dictionary_encode()
    return np.array([part.packed[name] for name in coded.dictionary.to_pylist()], np.int64)[coded.indices.to_numpy()]


def _types(connection: DuckDBPyConnection, schema: pa.Schema) -> dict[str, str]:
    """Read DuckDB's names of the column types."""
    connection.register("empty", schema.empty_table())
    types = connection.execute("SELECT column_name, column_type FROM (DESCRIBE empty)").fetchall()
    connection.unregister("empty")
    return dict(types)


def _column(field: pa.Field[Any], own: pa.Schema, type: str) -> str:
    """Format the select expression of a column for one group.

    The group may lack the column, or have another type.
    """
    name = _quoted(field.name)
    at = own.get_field_index(field.name)
    if at >= 0 and own.field(at).type == field.type:
        return name
    return f"CAST({'NULL' if at < 0 else name} AS {type}) AS {name}"


def _quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"'
