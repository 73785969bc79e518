# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyarrow's stubs have incomplete types of columns, and of files that Parquet is read from.
"""Queries over the rows of many units, by DuckDB on Parquet files.

Files of one schema are read together. DuckDB's `union_by_name` would do the same for files of any schema, but takes 140
kB of memory per file. Units that cannot be read together raise `SchemaMismatch`. The caller then reads unit by unit and
can name the invalid one. A path that DuckDB would interpret as a pattern raises `SchemaMismatch` too.
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
from springbench.harness.results.row_store import FILE_COLUMN, UnitGroup, group_units
from springbench.harness.results.row_store import read_group_schema as schema_of

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection

PromoteMode = Literal["default", "permissive"]

MEMORY_LIMIT = 2**29
"""Memory limit of DuckDB, beyond its results, in bytes."""


class SchemaMismatch(Exception):
    """The units cannot be read together.

    Attributes:
        damaged_units: indices of units that are not files of rows.
    """

    def __init__(self, why: str, damaged: Sequence[int] = ()) -> None:
        super().__init__(why)
        self.damaged_units = frozenset(damaged)


@dataclass(frozen=True, slots=True)
class RowUnion:
    """Groups of units, with their common schema and the SQL that reads their rows."""

    groups: list[UnitGroup]
    schema: pa.Schema
    sources: list[str]
    """Table expression of each group."""
    columns: list[str]
    """Select list of each group, in the order of the schema."""

    empty_query: str
    """Select list without any group."""

    files: list[str]
    """Paths of all groups' files, as DuckDB reads them."""

    def build_query(self) -> str:
        """Build a query for all rows, in the columns of the schema."""
        parts = [f"SELECT {columns} FROM {source}" for columns, source in zip(self.columns, self.sources, strict=True)]
        return " UNION ALL ".join(parts or [f"SELECT {self.empty_query} WHERE false"])


@contextmanager
def open_connection(memory: int = MEMORY_LIMIT) -> Generator[DuckDBPyConnection]:
    """Open a DuckDB connection that reads only Parquet files.

    It uses one thread because other runs may be timed.

    Raises:
        SchemaMismatch: for an error of DuckDB, Arrow or the system inside the block.
    """
    import duckdb

    settings: Any = {"memory_limit": f"{memory}B", "threads": 1, "temp_directory": ""}
    try:
        with duckdb.connect(config=settings) as connection:
            connection.execute("SET enable_external_file_cache = false; SET disable_parquet_prefetching = true")
            yield connection
    except (duckdb.Error, pa.ArrowException, OSError, MemoryError) as error:
        raise SchemaMismatch(str(error)) from error


def build_union(
    connection: DuckDBPyConnection, name: str, paths: Sequence[Path], schema: pa.Schema, promote: PromoteMode
) -> RowUnion:
    """Build the union of units for DuckDB; the schema's columns come first.

    Values come only from inside the files: a folder called `size=64` sets no column.

    Args:
        connection: open connection, in which variables of the given name are set.
        name: prefix of the variables.
        paths: row files of the units.
        schema: columns that the union has at least.
        promote: mode of Arrow's schema unification.

    Raises:
        SchemaMismatch: if the units cannot be read together.
        InputError: for a damaged packed file.
    """
    found, damaged = group_units(paths)
    if damaged:
        raise SchemaMismatch("not all are files of rows", damaged)
    try:
        schemas = [schema_of(part) for part in found]
        whole = pa.unify_schemas([schema, *schemas], promote_options=promote).remove_metadata()
    except (pa.ArrowException, OSError) as error:
        raise SchemaMismatch(str(error)) from error
    names = [name.casefold() for name in whole.names]
    if len({*names, *_RESERVED_COLUMNS}) < len(names) + len(_RESERVED_COLUMNS):
        raise SchemaMismatch("columns whose names DuckDB cannot distinguish")
    types = _read_column_types(connection, whole)
    sources: list[str] = []
    columns: list[str] = []
    files: list[str] = []
    for number, (part, own) in enumerate(zip(found, schemas, strict=True)):
        variable = f"{name}_{number}"
        literal = _check_literal_paths(part.files)
        files += literal
        connection.execute(f"SET VARIABLE {variable} = $files", {"files": literal})
        source = f"read_parquet(getvariable('{variable}'), hive_partitioning = false)"
        if part.packed_numbers is not None:
            connection.execute(f"SET VARIABLE {variable}_units = $units", {"units": list(part.packed_numbers)})
            source += f" WHERE {FILE_COLUMN} IN (SELECT unnest(getvariable('{variable}_units')))"
        sources.append(source)
        columns.append(", ".join(_format_column(field, own, types[field.name]) for field in whole))
    none = ", ".join(_format_column(field, pa.schema([]), types[field.name]) for field in whole)
    return RowUnion(found, whole, sources, columns, none, files)


_GLOB_PATTERN = re.compile(r"[*?\[\\\ud800-\udfff]")
"""Characters that DuckDB interprets as a pattern of several files, and surrogates, which UTF-8 cannot encode."""


def _check_literal_paths(files: Sequence[str]) -> list[str]:
    """Return absolute paths, because DuckDB interprets `~` and `file:` at the start.

    Raises:
        SchemaMismatch: for a pattern.
    """
    found = [os.path.abspath(file) for file in files]
    if bad := next((file for file in found if _GLOB_PATTERN.search(file)), None):
        raise SchemaMismatch(f"{bad!a} would be read as a pattern")
    return found


def read_table(
    paths: Sequence[Path],
    schema: pa.Schema,
    required_columns: Sequence[str] = (),
    *,
    max_rows: int,
    promote: PromoteMode = "default",
) -> tuple[pa.Table, NDArray[np.int64]]:
    """Read all rows of units, in their order.

    Args:
        paths: row files of the units.
        schema: columns that the table has at least.
        required_columns: columns that no row may lack.
        max_rows: maximum number of rows of one unit.
        promote: mode of Arrow's schema unification.

    Returns:
        The rows, and the index of each row's unit (n,).

    Raises:
        SchemaMismatch: if a unit is damaged, empty or too long, or lacks a required column.
    """
    with open_connection() as connection:
        whole = build_union(connection, "files", paths, schema, promote)
        if FILE_COLUMN in whole.schema.names:
            raise SchemaMismatch(f"a file has a column {FILE_COLUMN} of its own")
        tables = [whole.schema.empty_table()]
        numbers = [np.empty(0, np.int64)]
        count, checked = 0, False
        for part, columns, source in zip(whole.groups, whole.columns, whole.sources, strict=True):
            at = "file_index" if part.packed_numbers is None else FILE_COLUMN
            for batch in connection.sql(f"SELECT {columns}, {at} AS {_UNIT_COLUMN} FROM {source}").to_arrow_reader(
                100_000
            ):
                read = pa.table(batch)
                numbers.append(_compute_unit_numbers(part, read[_UNIT_COLUMN]))
                tables.append(read.drop_columns([_UNIT_COLUMN]).cast(whole.schema))
                count += len(read)
                if not checked and count > max_rows:  # before that no single file can exceed it
                    _check_row_counts(whole.files, max_rows)
                    checked = True
    number = np.concatenate(numbers)
    found = pa.concat_tables(tables)
    lacking = [name for name in required_columns if name not in found.column_names or found[name].null_count]
    if lacking or len(np.unique(number)) < len(paths):
        raise SchemaMismatch(f"no {lacking[0]}" if lacking else "not all have rows")
    if np.all(np.diff(number) >= 0):
        return found, number
    order = np.argsort(number, kind="stable")
    return found.take(order), number[order]


def _check_row_counts(files: Sequence[str], most: int) -> None:
    if any(pq.read_metadata(file).num_rows > most for file in files):
        raise SchemaMismatch("a file has too many rows")


def query_first_rows(
    paths: Sequence[Path], columns: Sequence[str], schema: pa.Schema, required_columns: Sequence[str] = ()
) -> dict[int, dict[str, Any]]:
    """Query columns of the first row of each unit.

    Units without rows, or without a required column, are omitted.

    Args:
        paths: row files of the units.
        columns: columns to return.
        schema: columns that the union has at least.
        required_columns: columns that no row may lack.

    Returns:
        Values by the index of the unit.

    Raises:
        SchemaMismatch: if the units cannot be read together.
    """
    with open_connection() as connection:
        whole = build_union(connection, "files", paths, schema, "default")
        found: dict[int, dict[str, Any]] = {}
        named = ", ".join(f"'{name}': {_quote_identifier(name)}" for name in columns)
        full = " AND ".join([f"count({_quote_identifier(name)}) = count(*)" for name in required_columns] or ["true"])
        for part, stated, source in zip(whole.groups, whole.columns, whole.sources, strict=True):
            at = "file_index" if part.packed_numbers is None else FILE_COLUMN
            rows = f"SELECT {stated}, {at} AS {_UNIT_COLUMN}, file_row_number AS {_ROW_COLUMN} FROM {source}"
            sql = (
                f"SELECT {_UNIT_COLUMN}, arg_min({{{named}}}, {_ROW_COLUMN}) FROM "
                f"({rows}) GROUP BY {_UNIT_COLUMN} HAVING {full}"
            )
            for which, head in connection.execute(sql).fetchall():
                found[part.unit_numbers[which] if part.packed_numbers is None else part.packed_numbers[which]] = head
    return found


_UNIT_COLUMN, _ROW_COLUMN = "unit_number", "unit_row"
_RESERVED_COLUMNS = (_UNIT_COLUMN, _ROW_COLUMN, "file_index", "file_row_number", "filename")
"""Reserved column names: the module's own, and those by which DuckDB reports the source of a row."""


def _compute_unit_numbers(part: UnitGroup, at: Any) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Compute the index of each row's unit."""
    if part.packed_numbers is None:
        return np.asarray(part.unit_numbers, np.int64)[at.to_numpy()]
    coded = at.combine_chunks().dictionary_encode()
    return np.array([part.packed_numbers[name] for name in coded.dictionary.to_pylist()], np.int64)[
        coded.indices.to_numpy()
    ]


def _read_column_types(connection: DuckDBPyConnection, schema: pa.Schema) -> dict[str, str]:
    """Read DuckDB's names of the column types."""
    connection.register("empty", schema.empty_table())
    types = connection.execute("SELECT column_name, column_type FROM (DESCRIBE empty)").fetchall()
    connection.unregister("empty")
    return dict(types)


def _format_column(field: pa.Field[Any], own: pa.Schema, type: str) -> str:
    """Format the select expression of a column for one group.

    The group may lack the column, or have another type.
    """
    name = _quote_identifier(field.name)
    at = own.get_field_index(field.name)
    if at >= 0 and own.field(at).type == field.type:
        return name
    return f"CAST({'NULL' if at < 0 else name} AS {type}) AS {name}"


def _quote_identifier(name: str) -> str:
    return '"' + name.replace('"', '""') + '"'
