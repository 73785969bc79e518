# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyarrow's stubs have incomplete types of columns, and of files that Parquet is read from.
"""Reader and writer of rows: one flat Parquet file per run, under `results/<sweep>/rows/`.

`harness.base.shelf` defines where rows are stored after packing.
"""

from __future__ import annotations

import io
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

from harness.base import child, shelf, union
from harness.base.columns import SCHEMA
from harness.base.errors import InputError, Mistake
from harness.base.files import replacing
from harness.base.row_validation import invalid

Row = Mapping[str, Any]


MOST = 2_000_000
"""Maximum number of rows of a file, because a few bytes can claim any number of them."""
_BYTES = 2**29
"""Maximum decompressed size of a file, in bytes."""
_MEMORY, _EXPANDS = 7 * 2**28, 100
"""Memory limit of reading units: a base in bytes, and a factor for the size of their files."""
_FEW = 8
"""Maximum number of units that are read one by one, without loading DuckDB."""


def write(path: Path, rows: Iterable[Row], schema: pa.Schema = SCHEMA) -> None:
    """Write the rows of one file durably; raise CannotWrite if that fails."""
    store(path, encoded(rows, schema))


def encoded(rows: Iterable[Row], schema: pa.Schema = SCHEMA) -> bytes:
    """Encode the rows of one file as Parquet.

    Args:
        rows: mappings of column names to values.
        schema: Arrow schema.
    Returns: content of the file.
    Raises:
        ValueError: if a row has a column that the schema lacks.
    """
    rows, file = list(rows), io.BytesIO()
    unknown = set[str]().union(*rows) - set(schema.names)
    if unknown:
        raise ValueError(f"rows have no columns {sorted(unknown)}")
    pq.write_table(pa.Table.from_pylist(rows, schema=schema), file)
    return file.getvalue()


def store(path: Path, content: bytes) -> None:
    """Write a file atomically: write a temporary file, flush it to disk, and rename it.

    After a kill or an error the file is complete or absent.

    Raises:
        CannotWrite: if the file cannot be written.
    """
    with replacing(path) as partial, partial.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def read(
    paths: Iterable[Path],
    schema: pa.Schema = SCHEMA,
    *,
    needed: Sequence[str] = (),
    promote: union.Promote = "default",
    named: bool = False,
    left_out: Callable[[Mistake], None] | None = None,
) -> pa.Table:
    """Read all rows of units, in the order of their paths.

    Rows of an older schema get nulls in new columns.

    Args:
        paths: row files of the units.
        schema: columns that the result has at least.
        needed: columns without which a row is invalid.
        promote: "permissive" allows columns of one name to differ in type.
        named: whether to append the column `row_store.FILE` with the names of the units.
        left_out: called for each unit with an invalid value (`row_validation`), which is then omitted.
    Returns: the rows.
    Raises:
        InputError: for all damaged, foreign or empty files; without left_out also for invalid values.
    """
    paths = list(paths)
    if len(paths) > _FEW:
        with suppress(union.Unfit):
            with memory_for(paths):
                table, number = union.table(paths, schema, needed, most=MOST, promote=promote)
            return _valid(paths, table, number, left_out, named=named)
    return _valid(paths, *_each(paths, schema, needed, promote), left_out, named=named)


@contextmanager
def memory_for(units: Sequence[Path]) -> Generator[None]:
    """Limit the memory for reading units inside the block.

    A file of some kB can claim any number of GB.

    Args:
        units: row files of the units; their sizes determine the limit.
    Raises:
        InputError: if reading exceeds the limit.
    """
    files = {*units, *(shelf.packed_file(folder) for folder in {unit.parent for unit in units})}
    most = _MEMORY + _EXPANDS * sum(file.stat().st_size for file in files if file.is_file())
    try:
        with child.memory_limited(most):
            yield
    except MemoryError as error:
        folder = units[0].parent if units else None
        why = f"rows take more than {most / 2**30:.1f} GiB of memory to read; take out what is not yours"
        raise InputError(Mistake(why, folder)) from error


def read_each(
    paths: Sequence[Path],
    schema: pa.Schema = SCHEMA,
    *,
    needed: Sequence[str] = (),
    promote: union.Promote = "default",
    named: bool = False,
) -> pa.Table:
    """Read rows by pyarrow, file by file.

    This is the reference for the verification of written rows.
    The parameters are those of `read_rows`.
    """
    return _valid(paths, *_each(paths, schema, needed, promote), None, named=named)


def _valid(
    paths: Sequence[Path],
    table: pa.Table,
    number: NDArray[np.int64],
    left_out: Callable[[Mistake], None] | None,
    *,
    named: bool,
) -> pa.Table:
    """Remove the rows of units with invalid values.

    Number (n,) is the index of each row's unit.
    """
    bad: dict[int, Mistake] = {}
    what = "it is left out" if left_out else "take it out of the results"
    for one in invalid(table):
        unit = int(number[one.row])
        if unit not in bad:
            bad[unit] = Mistake(f"{one}; {what}", paths[unit], key=one.column)
    if bad and not left_out:
        raise InputError(list(bad.values()))
    if bad and left_out:
        for mistake in bad.values():
            left_out(mistake)
        valid = ~np.isin(number, list(bad))
        fitting: Any = pa.array(np.flatnonzero(valid))
        table, number = table.take(fitting), number[valid]
    if named:
        names, of_rows = pa.array([path.stem for path in paths], pa.string()), cast(Any, pa.array(number))
        table = table.append_column(shelf.FILE, names.take(of_rows))
    return table


def _each(
    paths: Sequence[Path], schema: pa.Schema, needed: Sequence[str], promote: union.Promote
) -> tuple[pa.Table, NDArray[np.int64]]:
    """Read all rows by pyarrow, with the index of each row's unit; raise InputError."""
    with memory_for(paths):
        return _joined(paths, schema, needed, promote)


def _joined(
    paths: Sequence[Path], schema: pa.Schema, needed: Sequence[str], promote: union.Promote
) -> tuple[pa.Table, NDArray[np.int64]]:
    tables, mistakes = list[pa.Table](), list[Mistake]()
    packed = _packed(paths)
    for path in paths:
        try:
            tables.append(_one(path, schema, needed, packed))
        except InputError as error:
            mistakes += error.mistakes
    if mistakes:
        raise InputError(mistakes)
    number = np.repeat(np.arange(len(tables)), [len(table) for table in tables])
    try:
        return pa.concat_tables([schema.empty_table(), *tables], promote_options=promote), number
    except pa.ArrowException as error:  # two foreign columns of one name
        raise InputError(f"rows do not fit together ({error}); take the foreign files out of the results") from error


def _packed(paths: Sequence[Path]) -> dict[Path, pa.Table]:
    """Read the rows of packed units, each packed file once.

    Raises:
        InputError: for a damaged one.
    """
    names: dict[Path, list[str]] = {}
    for path in paths:
        if not os.path.lexists(path) and path.stem in shelf.packed_units(path.parent):
            names.setdefault(path.parent, []).append(path.stem)
    found: dict[Path, pa.Table] = {}
    for folder, units in names.items():
        chosen: Any = [(shelf.FILE, "in", units)]
        file = shelf.packed_file(folder)
        try:
            with file.open("rb") as content:
                table = pq.read_table(content, filters=chosen, partitioning=None)
        except (pa.ArrowException, OSError) as error:
            raise InputError(Mistake(f"holds no packed rows ({error}); take it out of the results", file)) from error
        names_of_rows: Any = table[shelf.FILE].combine_chunks()
        of_row = names_of_rows.dictionary_encode()
        order = np.argsort(of_row.indices.to_numpy(), kind="stable")
        rows = table.drop_columns([shelf.FILE]).take(order)
        at = 0
        for name, count in zip(of_row.dictionary.to_pylist(), np.bincount(of_row.indices.to_numpy()), strict=True):
            found[folder / f"{name}.parquet"] = rows.slice(at, count)
            at += count
    return found


def heads(
    paths: Iterable[Path], columns: Sequence[str], schema: pa.Schema = SCHEMA, *, needed: Sequence[str] = ()
) -> dict[Path, dict[str, Any] | str]:
    """Read columns of the first row of each existing unit.

    Args:
        paths: row files of the units.
        columns: columns to return, which the schema has.
        schema: columns that the result has at least.
        needed: columns of the schema without which a row is invalid.
    Returns: by path, the values of the first row, or a description of what is wrong with the unit.
    Raises:
        InputError: for a damaged packed file.
    """
    paths = [path for path in paths if shelf.there(path)]
    found: dict[int, dict[str, Any]] = {}
    if len(paths) > _FEW:
        try:
            with memory_for(paths):
                found = union.heads(paths, columns, schema, needed)
        except union.Unfit as unfit:
            if unfit.damaged and len(unfit.damaged) < len(paths):
                whole = [path for number, path in enumerate(paths) if number not in unfit.damaged]
                bad = {paths[number]: first(paths[number], schema, needed=needed) for number in unfit.damaged}
                found_of = heads(whole, columns, schema, needed=needed) | bad
                return {path: found_of[path] for path in paths}
    with memory_for(paths):
        packed = _packed([path for number, path in enumerate(paths) if number not in found])
        return {path: found.get(k) or _first(path, schema, needed, packed) for k, path in enumerate(paths)}


def first(path: Path, schema: pa.Schema = SCHEMA, *, needed: Sequence[str] = ()) -> dict[str, Any] | str:
    """Read the first row of a unit, or describe what is wrong with its rows."""
    with memory_for([path]):
        return _first(path, schema, needed, _packed([path]))


def _first(
    path: Path, schema: pa.Schema, needed: Sequence[str], packed: Mapping[Path, pa.Table]
) -> dict[str, Any] | str:
    try:
        return _one(path, schema, needed, packed).slice(0, 1).to_pylist()[0]
    except InputError as error:
        return error.mistakes[0].problem


def _one(path: Path, schema: pa.Schema, needed: Sequence[str], packed: Mapping[Path, pa.Table]) -> pa.Table:
    try:
        found = packed.get(path) or _file(path)
        table = pa.concat_tables([schema.empty_table(), found], promote_options="default")
        table.validate(full=True)  # text is UTF-8
    except (pa.ArrowException, OSError) as error:
        raise InputError(Mistake(f"holds no rows ({error}); take it out of the results", path)) from error
    lacking = [name for name in needed if name not in table.column_names or table[name].null_count]
    if lacking or not len(table):
        why = f"no {lacking[0]}" if lacking else "it is empty"
        raise InputError(Mistake(f"holds no rows of a run ({why}); take it out of the results", path))
    return table


def _file(path: Path) -> pa.Table:
    if not path.is_file() and path.exists():  # a pipe would be waited for
        raise OSError("it is no plain file")
    try:
        with path.open("rb") as content:
            return _within_limits(content)
    except FileNotFoundError:  # it was packed a moment ago
        if found := _packed([path]).get(path):
            return found
        raise OSError("it is no plain file") from None


def _within_limits(content: BinaryIO) -> pa.Table:
    """Read the rows of a file.

    Raises:
        OSError: if it exceeds the maximum number of rows or bytes.
    """
    with pq.ParquetFile(content) as file:
        told, fields = file.metadata, list[Any](file.schema_arrow)
    names = [field.name for field in fields]
    if len(set(names)) < len(names) or shelf.FILE in names:
        raise OSError("its columns have the names of others")
    if told.num_rows > MOST:
        raise OSError(f"it claims {told.num_rows:,} rows, and at most {MOST:,} are read")
    size = sum(told.row_group(k).total_byte_size for k in range(told.num_row_groups))
    if size > _BYTES:
        raise OSError(f"it claims {size:,} bytes, and at most {_BYTES:,} are read")
    texts = [field.name for field in fields if pa.types.is_string(field.type)]
    with pq.ParquetFile(content, read_dictionary=texts) as file:  # the same text many times takes no more memory
        table = file.read()
    size = sum(map(_bytes_as_text, table.itercolumns()))
    if size > _BYTES:
        raise OSError(f"its text takes {size:,} bytes, and at most {_BYTES:,} are read")
    return table.cast(pa.schema(fields))


def _bytes_as_text(column: Any) -> int:
    """Compute the bytes of a dictionary-encoded text column after decoding."""
    if not pa.types.is_dictionary(column.type):
        return 0
    return sum(pc.sum(pc.binary_length(chunk.dictionary).take(chunk.indices)).as_py() or 0 for chunk in column.chunks)


def same(one: pa.Table, other: pa.Table) -> bool:
    """Return whether two tables are bitwise equal; a NaN equals itself."""
    return one.schema.equals(other.schema) and all(
        _same(a.combine_chunks(), b.combine_chunks())
        for a, b in zip(one.itercolumns(), other.itercolumns(), strict=True)
    )


def _same(one: Any, other: Any) -> bool:
    if pa.types.is_list(one.type):
        return one.value_lengths().equals(other.value_lengths()) and _same(one.flatten(), other.flatten())
    if pa.types.is_float64(one.type):
        one, other = one.view(pa.int64()), other.view(pa.int64())
    return one.equals(other)
