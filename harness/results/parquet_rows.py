# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyarrow's stubs have incomplete types of columns, and of files that Parquet is read from.
"""Reader and writer of rows: one flat Parquet file per run, under `results/<sweep>/rows/`.

`springbench.harness.results.row_store` defines where rows are stored after packing.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray
from springbench.harness.atomic_files import atomic_write, explain_unreadable_file
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.execution import sandbox
from springbench.harness.results import row_store, row_union
from springbench.harness.results.row_validation import find_invalid_values
from springbench.harness.results.run_schema import RUN_SCHEMA

RowValues = Mapping[str, Any]


MAX_ROWS = 2_000_000
"""Maximum number of rows of a file, because a few bytes can claim any number of them."""
_MAX_FILE_BYTES = 2**29
"""Maximum decompressed size of a file, in bytes."""
_BASE_MEMORY, _EXPANSION_FACTOR = 7 * 2**28, 100
"""Memory limit of reading units: a base in bytes, and a factor for the size of their files."""
_MAX_SINGLE_READS = 8
"""Maximum number of units that are read one by one, without loading DuckDB."""


def write_rows(path: Path, rows: Iterable[RowValues], schema: pa.Schema = RUN_SCHEMA) -> None:
    """Write the rows of one file durably.

    Args:
        path: target file.
        rows: mappings of column names to values.
        schema: Arrow schema of the file; columns that a row lacks are null.

    Raises:
        ValueError: if a row has a column that the schema lacks.
        WriteError: if the file cannot be written.
    """
    write_durably(path, encode_rows(rows, schema))


def encode_rows(rows: Iterable[RowValues], schema: pa.Schema = RUN_SCHEMA) -> bytes:
    """Encode the rows of one file as Parquet.

    Args:
        rows: mappings of column names to values.
        schema: Arrow schema.

    Returns:
        Content of the file.

    Raises:
        ValueError: if a row has a column that the schema lacks.
    """
    rows, content = list(rows), pa.BufferOutputStream()  # a file object of Python takes half as long again
    unknown = set[str]().union(*rows) - set(schema.names)
    if unknown:
        raise ValueError(f"rows have no columns {sorted(unknown)}")
    pq.write_table(pa.Table.from_pylist(rows, schema=schema), content)
    return content.getvalue().to_pybytes()


def write_durably(path: Path, content: bytes) -> None:
    """Write a file atomically: write a temporary file, flush it to disk, and rename it.

    After a kill or an error the file is complete or absent.

    Args:
        path: target file, replaced if it exists.
        content: bytes of the whole file.

    Raises:
        WriteError: if the file cannot be written.
    """
    with atomic_write(path) as partial, partial.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def read_rows(
    paths: Iterable[Path],
    schema: pa.Schema = RUN_SCHEMA,
    *,
    required_columns: Sequence[str] = (),
    promote: row_union.PromoteMode = "default",
    with_unit_names: bool = False,
    on_invalid: Callable[[InputMistake], None] | None = None,
) -> pa.Table:
    """Read all rows of units, in the order of their paths.

    Rows of an older schema get nulls in new columns.

    Args:
        paths: row files of the units.
        schema: columns that the result has at least.
        required_columns: columns without which a row is invalid.
        promote: "permissive" allows columns of one name to differ in type.
        with_unit_names: whether to append the column `row_store.FILE_COLUMN` with the names of the units.
        on_invalid: called for each unit with an invalid value (`row_validation`), which is then omitted.

    Returns:
        The rows.

    Raises:
        InputError: for all damaged, foreign or empty files; without on_invalid also for invalid values.
    """
    paths = list(paths)
    if len(paths) > _MAX_SINGLE_READS:
        with suppress(row_union.SchemaMismatch):
            with limit_read_memory(paths):
                table, number = row_union.read_table(
                    paths, schema, required_columns, max_rows=MAX_ROWS, promote=promote
                )
            return _drop_invalid_units(paths, table, number, on_invalid, with_unit_names=with_unit_names)
    return _drop_invalid_units(
        paths, *_read_by_file(paths, schema, required_columns, promote), on_invalid, with_unit_names=with_unit_names
    )


def group_result_rows(rows: Iterable[Mapping[str, Any]]) -> dict[str, list[Mapping[str, Any]]]:
    """Group the rows that state the results of runs by `run_id`, in their order.

    These are the rows of the first round of each step, or the single row of a failed run.
    """
    runs: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        if row["phase"] == "run" or (row["phase"] == "step" and row["round"] == 0):
            runs.setdefault(row["run_id"], []).append(row)
    return runs


@contextmanager
def limit_read_memory(units: Sequence[Path]) -> Generator[None]:
    """Limit the memory for reading units inside the block.

    A file of some kB can claim any number of GB.

    Args:
        units: row files of the units; their sizes determine the limit.

    Raises:
        InputError: if reading exceeds the limit.
    """
    files = {*units, *(row_store.build_packed_path(folder) for folder in {unit.parent for unit in units})}
    most = _BASE_MEMORY + _EXPANSION_FACTOR * sum(file.stat().st_size for file in files if file.is_file())
    try:
        with sandbox.limit_memory(most):
            yield
    except MemoryError as error:
        folder = units[0].parent if units else None
        why = f"reading the rows takes more than {most / 2**30:.1f} GiB of memory; remove files of other programs"
        raise InputError(InputMistake(why, folder)) from error


def read_rows_by_file(
    paths: Sequence[Path],
    schema: pa.Schema = RUN_SCHEMA,
    *,
    required_columns: Sequence[str] = (),
    promote: row_union.PromoteMode = "default",
    with_unit_names: bool = False,
) -> pa.Table:
    """Read rows by pyarrow, file by file.

    This is the reference for the verification of written rows.

    Args:
        paths: row files of the units.
        schema: columns that the result has at least.
        required_columns: columns without which a row is invalid.
        promote: "permissive" allows columns of one name to differ in type.
        with_unit_names: whether to append the column `row_store.FILE_COLUMN` with the names of the units.

    Raises:
        InputError: for all damaged, foreign or empty files, and for invalid values.
    """
    return _drop_invalid_units(
        paths, *_read_by_file(paths, schema, required_columns, promote), None, with_unit_names=with_unit_names
    )


def _drop_invalid_units(
    paths: Sequence[Path],
    table: pa.Table,
    number: NDArray[np.int64],
    on_invalid: Callable[[InputMistake], None] | None,
    *,
    with_unit_names: bool,
) -> pa.Table:
    """Remove the rows of units with invalid values.

    `number` (n,) is the index of each row's unit.
    """
    bad: dict[int, InputMistake] = {}
    what = "it is left out" if on_invalid else "take it out of the results"
    for one in find_invalid_values(table):
        unit = int(number[one.row])
        if unit not in bad:
            bad[unit] = InputMistake(f"{one}; {what}", paths[unit], key=one.column)
    if bad and not on_invalid:
        raise InputError(list(bad.values()))
    if bad and on_invalid:
        for mistake in bad.values():
            on_invalid(mistake)
        valid = ~np.isin(number, list(bad))
        fitting: Any = pa.array(np.flatnonzero(valid))
        table, number = table.take(fitting), number[valid]
    if with_unit_names:
        names, of_rows = pa.array([path.stem for path in paths], pa.string()), cast(Any, pa.array(number))
        table = table.append_column(row_store.FILE_COLUMN, names.take(of_rows))
    return table


def _read_by_file(
    paths: Sequence[Path], schema: pa.Schema, required_columns: Sequence[str], promote: row_union.PromoteMode
) -> tuple[pa.Table, NDArray[np.int64]]:
    """Read all rows by pyarrow, with the index of each row's unit; raise InputError."""
    with limit_read_memory(paths):
        return _concatenate_units(paths, schema, required_columns, promote)


def _concatenate_units(
    paths: Sequence[Path], schema: pa.Schema, required_columns: Sequence[str], promote: row_union.PromoteMode
) -> tuple[pa.Table, NDArray[np.int64]]:
    tables, mistakes = list[pa.Table](), list[InputMistake]()
    packed = read_packed_rows(paths)
    for path in paths:
        try:
            tables.append(_read_unit(path, schema, required_columns, packed))
        except InputError as error:
            mistakes += error.mistakes
    if mistakes:
        raise InputError(mistakes)
    number = np.repeat(np.arange(len(tables)), [len(table) for table in tables])
    try:
        return pa.concat_tables([schema.empty_table(), *tables], promote_options=promote), number
    except pa.ArrowException as error:  # two foreign columns of one name
        raise InputError(f"rows do not fit together ({error}); take the foreign files out of the results") from error


def read_packed_rows(paths: Sequence[Path]) -> dict[Path, pa.Table]:
    """Read the rows of the units that are packed, each packed file once.

    Args:
        paths: row files of the units; those with a file of their own are omitted.

    Raises:
        InputError: for a damaged packed file.
    """
    names: dict[Path, list[str]] = {}
    for path in paths:
        if not os.path.lexists(path) and path.stem in row_store.list_packed_units(path.parent):
            names.setdefault(path.parent, []).append(path.stem)
    found: dict[Path, pa.Table] = {}
    for folder, units in names.items():
        chosen: Any = [(row_store.FILE_COLUMN, "in", units)]
        file = row_store.build_packed_path(folder)
        try:
            with file.open("rb") as content:
                table = pq.read_table(content, filters=chosen, partitioning=None)
        except (pa.ArrowException, OSError) as error:
            problem = explain_unreadable_file(file) or f"contains no packed rows ({error}); take it out of the results"
            raise InputError(InputMistake(problem, file)) from error
        names_of_rows: Any = table[row_store.FILE_COLUMN].combine_chunks()
        of_row = names_of_rows.dictionary_encode()
        order = np.argsort(of_row.indices.to_numpy(), kind="stable")
        rows = table.drop_columns([row_store.FILE_COLUMN]).take(order)
        at = 0
        for name, count in zip(of_row.dictionary.to_pylist(), np.bincount(of_row.indices.to_numpy()), strict=True):
            found[folder / f"{name}.parquet"] = rows.slice(at, count)
            at += count
    return found


def read_first_rows(
    paths: Iterable[Path],
    columns: Sequence[str],
    schema: pa.Schema = RUN_SCHEMA,
    *,
    required_columns: Sequence[str] = (),
) -> dict[Path, dict[str, Any] | str]:
    """Read columns of the first row of each existing unit.

    Args:
        paths: row files of the units.
        columns: columns to return, which the schema has.
        schema: columns that the result has at least.
        required_columns: columns of the schema without which a row is invalid.

    Returns:
        By path, the values of the first row, or a description of what is wrong with the unit.

    Raises:
        InputError: for a damaged packed file.
    """
    paths = [path for path in paths if row_store.has_rows(path)]
    found: dict[int, dict[str, Any]] = {}
    if len(paths) > _MAX_SINGLE_READS:
        try:
            with limit_read_memory(paths):
                found = row_union.query_first_rows(paths, columns, schema, required_columns)
        except row_union.SchemaMismatch as unfit:
            if unfit.damaged_units and len(unfit.damaged_units) < len(paths):
                whole = [path for number, path in enumerate(paths) if number not in unfit.damaged_units]
                bad = {
                    paths[number]: read_first_row(paths[number], schema, required_columns=required_columns)
                    for number in unfit.damaged_units
                }
                found_of = read_first_rows(whole, columns, schema, required_columns=required_columns) | bad
                return {path: found_of[path] for path in paths}
    with limit_read_memory(paths):
        packed = read_packed_rows([path for number, path in enumerate(paths) if number not in found])
        return {
            path: found.get(k) or _read_first(path, schema, required_columns, packed) for k, path in enumerate(paths)
        }


def read_first_row(
    path: Path, schema: pa.Schema = RUN_SCHEMA, *, required_columns: Sequence[str] = ()
) -> dict[str, Any] | str:
    """Read the first row of a unit, or describe what is wrong with its rows.

    Args:
        path: row file of the unit, which may be packed.
        schema: columns that the row has at least.
        required_columns: columns of the schema without which a row is invalid.

    Returns:
        The values by column name, or the description.

    Raises:
        InputError: for a damaged packed file, or if reading exceeds the memory limit.
    """
    with limit_read_memory([path]):
        return _read_first(path, schema, required_columns, read_packed_rows([path]))


def _read_first(
    path: Path, schema: pa.Schema, required_columns: Sequence[str], packed: Mapping[Path, pa.Table]
) -> dict[str, Any] | str:
    try:
        return _read_unit(path, schema, required_columns, packed).slice(0, 1).to_pylist()[0]
    except InputError as error:
        return error.mistakes[0].problem


def _read_unit(
    path: Path, schema: pa.Schema, required_columns: Sequence[str], packed: Mapping[Path, pa.Table]
) -> pa.Table:
    try:
        found = packed.get(path) or _read_file(path)
        table = pa.concat_tables([schema.empty_table(), found], promote_options="default")
        table.validate(full=True)  # text is UTF-8
    except (pa.ArrowException, OSError) as error:
        problem = explain_unreadable_file(path) or f"contains no rows ({error}); take it out of the results"
        raise InputError(InputMistake(problem, path)) from error
    lacking = [name for name in required_columns if name not in table.column_names or table[name].null_count]
    if lacking or not len(table):
        why = f"no {lacking[0]}" if lacking else "it is empty"
        raise InputError(InputMistake(f"contains no rows of a run ({why}); take it out of the results", path))
    return table


def _read_file(path: Path) -> pa.Table:
    if not path.is_file() and path.exists():  # reading a pipe would block
        raise OSError("it is no plain file")
    try:
        with path.open("rb") as content:
            return _read_within_limits(content)
    except FileNotFoundError:  # another process may have packed it meanwhile
        if found := read_packed_rows([path]).get(path):
            return found
        raise OSError("it is no plain file") from None


def _read_within_limits(content: BinaryIO) -> pa.Table:
    """Read the rows of a file.

    Raises:
        OSError: if it exceeds the maximum number of rows or bytes.
    """
    with pq.ParquetFile(content) as file:
        metadata, fields = file.metadata, list[Any](file.schema_arrow)
    names = [field.name for field in fields]
    if len(set(names)) < len(names) or row_store.FILE_COLUMN in names:
        raise OSError("its columns have the names of others")
    if metadata.num_rows > MAX_ROWS:
        raise OSError(f"it claims {metadata.num_rows:,} rows, and at most {MAX_ROWS:,} are read")
    size = sum(metadata.row_group(k).total_byte_size for k in range(metadata.num_row_groups))
    if size > _MAX_FILE_BYTES:
        raise OSError(f"it claims {size:,} bytes, and at most {_MAX_FILE_BYTES:,} are read")
    texts = [field.name for field in fields if pa.types.is_string(field.type)]
    with pq.ParquetFile(content, read_dictionary=texts) as file:  # repeated texts are stored once
        table = file.read()
    size = sum(map(_count_text_bytes, table.itercolumns()))
    if size > _MAX_FILE_BYTES:
        raise OSError(f"its text takes {size:,} bytes, and at most {_MAX_FILE_BYTES:,} are read")
    return table.cast(pa.schema(fields))


def _count_text_bytes(column: Any) -> int:
    """Compute the bytes of a dictionary-encoded text column after decoding; 0 for other columns."""
    if not pa.types.is_dictionary(column.type):
        return 0
    return sum(pc.sum(pc.binary_length(chunk.dictionary).take(chunk.indices)).as_py() or 0 for chunk in column.chunks)


def is_bitwise_equal(one: pa.Table, other: pa.Table) -> bool:
    """Return whether two tables are bitwise equal; a NaN equals itself.

    Args:
        one, other: tables of rows; different schemas or orders of columns make them unequal.
    """
    return one.schema.equals(other.schema) and all(
        _is_column_equal(a.combine_chunks(), b.combine_chunks())
        for a, b in zip(one.itercolumns(), other.itercolumns(), strict=True)
    )


def _is_column_equal(one: Any, other: Any) -> bool:
    if pa.types.is_list(one.type):
        return one.value_lengths().equals(other.value_lengths()) and _is_column_equal(one.flatten(), other.flatten())
    if pa.types.is_float64(one.type):
        one, other = one.view(pa.int64()), other.view(pa.int64())
    return one.equals(other)
