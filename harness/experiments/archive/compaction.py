# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyarrow's stubs are incomplete for columns, and for file objects that Parquet is read from.
"""Pack the rows of many units into one file next to their folder.

Readers get the same rows before and after. The packed file is written under a partial name, including the rows that
were packed before. It is compared with the originals, which an independent reader reads file by file, and renamed. Then
the units' own files are removed. Readers prefer a unit's own file to its packed rows
(`springbench.harness.results.row_store`). After an interruption at any moment, all rows are therefore visible exactly
once, and the next call completes the work.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from math import inf
from pathlib import Path
from time import time
from typing import BinaryIO

import pyarrow as pa
import pyarrow.parquet as pq
from springbench.harness.atomic_files import atomic_write
from springbench.harness.errors import InputError, InputMistake, SpringbenchError
from springbench.harness.execution import folder_locks
from springbench.harness.results import parquet_rows, row_store, run_schema

_BATCH_SIZE = 100
"""Number of units that are in memory at a time."""
_SECONDS_PER_DAY = 86_400.0
_EMPTY_SCHEMA = pa.schema([])
_FILE_FIELD = pa.field(row_store.FILE_COLUMN, pa.string())
_STARTED_SCHEMA = pa.schema([run_schema.RUN_SCHEMA.field("started_at")])


def compact_results(results: Path, print_message: Callable[[str], None], *, min_age_days: float = 0.0) -> int:
    """Pack the old units of all folders of rows, and return their number.

    Args:
        results: folder of results, or of one sweep.
        print_message: called with a remark on each folder.
        min_age_days: smallest age of a unit's file [days].

    Raises:
        InputError: there are no rows, a sweep is running, or the schemas of rows do not match.
    """
    folders = [folder for table in row_store.TABLE_FOLDERS for folder in row_store.find_row_folders(results, table)]
    if not folders:
        raise InputError(InputMistake("contains no rows; expected a folder of results, or that of a sweep", results))
    count = 0
    for folder in folders:
        with folder_locks.lock_folder_exclusive(folder.parent):
            count += _compact_folder(folder, time() - _SECONDS_PER_DAY * min_age_days, print_message)
    return count


def compact_sweep(folder: Path, print_message: Callable[[str], None]) -> None:
    """Pack the rows of a sweep that has ended.

    The files stay if another process uses the folder, which packs them when it ends, or if they cannot be packed.

    Args:
        folder: folder of the sweep.
        print_message: called with a remark.
    """
    try:
        with folder_locks.lock_folder_exclusive(folder):
            print_message("packing the rows of all runs into one file, which is faster to read")
            _compact_folder(folder / "rows", inf, print_message)
    except (SpringbenchError, OSError) as error:
        print_message(f"rows stay in one file per run: {error}")


def _compact_folder(folder: Path, max_modified_time: float, print_message: Callable[[str], None]) -> int:
    for left in folder.parent.glob(f".{folder.name}.*.partial.parquet"):
        left.unlink()
    packed = row_store.build_packed_path(folder)
    names = sorted(row_store.list_unit_files(folder))
    old = [
        unit
        for name in names
        if (unit := folder / f"{name}.parquet").is_file() and unit.stat().st_mtime <= max_modified_time
    ]
    heads = parquet_rows.read_first_rows(old, ["started_at"], _STARTED_SCHEMA)
    whole = [unit for unit in old if isinstance(heads.get(unit), dict) and _is_utf8(unit.stem)]
    if damaged := len(old) - len(whole):
        print_message(
            f"{folder}: {damaged} damaged file{'s' * (damaged > 1)} left as {'they are' if damaged > 1 else 'it is'}"
        )
    if not whole:
        print_message(f"{folder}: nothing to pack; {len(row_store.list_packed_units(folder))} units are packed")
        return 0
    stays = sorted(row_store.list_packed_units(folder) - {unit.stem for unit in whole})
    file_paths = sorted([*whole, *(folder / f"{name}.parquet" for name in stays)])
    schema = unify_schemas(file_paths)
    if row_store.FILE_COLUMN in schema.names:
        raise InputError(
            InputMistake(f"rows have a column {row_store.FILE_COLUMN!r} of their own; they cannot be packed", packed)
        )
    with atomic_write(packed) as partial:
        with partial.open("wb") as into, pq.ParquetWriter(into, schema.append(_FILE_FIELD)) as writer:
            for batch in _iterate_batches(file_paths):
                table = parquet_rows.read_rows(batch, schema, with_unit_names=True)
                writer.write_table(table, row_group_size=len(table))
        with partial.open("rb") as written:
            os.fsync(written.fileno())
            _check_compacted_rows(written, file_paths, schema)
    _sync_folder(packed.parent)
    for unit in whole:
        unit.unlink()
    print_message(f"{folder}: {len(whole)} units packed into {packed.name}, which contains {len(file_paths)}")
    return len(whole)


def _is_utf8(name: str) -> bool:
    """Return whether a name is valid UTF-8, which the names of packed units must be."""
    try:
        name.encode()
    except UnicodeEncodeError:
        return False
    return True


def unify_schemas(units: Sequence[Path], schema: pa.Schema = _EMPTY_SCHEMA) -> pa.Schema:
    """Return the common schema of all units.

    Args:
        units: row files, packed or not.
        schema: columns that come first.

    Raises:
        InputError: a file has columns of other types; the message names it.
    """
    found, _ = row_store.group_units(units)
    for part in found:
        try:
            schema = pa.unify_schemas([schema, row_store.read_group_schema(part)]).remove_metadata()
        except (pa.ArrowException, OSError) as error:
            why = f"rows do not fit those of other files ({error}); take it out of the results"
            raise InputError(InputMistake(why, Path(part.files[0]))) from error
    return schema


def _iterate_batches(units: Sequence[Path]) -> Iterator[Sequence[Path]]:
    return (units[start : start + _BATCH_SIZE] for start in range(0, len(units), _BATCH_SIZE))


def _check_compacted_rows(written: BinaryIO, units: Sequence[Path], schema: pa.Schema) -> None:
    """Compare the packed rows with the originals.

    Raises InputError if they differ; nothing is removed then.
    """
    with pq.ParquetFile(written) as file:
        for group, batch in enumerate(_iterate_batches(units)):
            if not parquet_rows.is_bitwise_equal(file.read_row_group(group), _read_by_file(batch, schema)):
                why = f"the packed rows differ from those in the {len(batch)} files from here on; nothing was removed"
                raise InputError(InputMistake(why, batch[0]))


def _read_by_file(units: Sequence[Path], schema: pa.Schema) -> pa.Table:
    """Read the rows of units by pyarrow, file by file, with their names.

    Limits of size are not checked again, which would take most of the time of packing.
    """
    packed = parquet_rows.read_packed_rows(units)
    tables = [schema.append(_FILE_FIELD).empty_table()]
    for unit in units:
        if (table := packed.get(unit)) is None:
            with unit.open("rb") as content, pq.ParquetFile(content) as file:
                table = file.read(use_threads=False)
        tables.append(table.append_column(_FILE_FIELD, pa.repeat(unit.stem, len(table))))
    return pa.concat_tables(tables, promote_options="default")


def _sync_folder(folder: Path) -> None:
    """Flush a folder to the disk.

    A rename is then durable before the replaced files are removed.
    """
    if not hasattr(os, "O_DIRECTORY"):  # Windows cannot open folders
        return
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
