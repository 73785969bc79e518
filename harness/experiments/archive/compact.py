# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyarrow's stubs are incomplete for columns, and for file objects that Parquet is read from.
"""Pack the rows of many units into one file next to their folder.

Readers get the same rows before and after.

The packed file is written under a partial name, including the rows that were packed before. It is compared with the
originals, which an independent reader reads file by file, and renamed. Then the units' own files are removed. Readers
prefer a unit's own file to its packed rows (`harness.base.shelf`). An interruption therefore leaves, at any
moment, all rows visible exactly once, and the next call completes the work.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from time import time
from typing import BinaryIO

import pyarrow as pa
import pyarrow.parquet as pq

from harness.base import columns, holding, rows, shelf
from harness.base.errors import InputError, Mistake
from harness.base.files import replacing

TABLES = ("rows", "accuracy", "ablation")
"""Folders of rows in a folder of results."""

_BATCH = 2_000
"""Number of units that are in memory at a time."""
_DAY = 86_400.0
_ANY = pa.schema([])
_NAME = pa.field(shelf.FILE, pa.string())
_STARTED = pa.schema([columns.SCHEMA.field("started")])


def compact(results: Path, say: Callable[[str], None], *, days: float = 0.0) -> int:
    """Pack the old units of all folders of rows, and return their number.

    Args:
        results: folder of results, or of one sweep.
        say: called with a remark on each folder.
        days: smallest age of a unit's file [days].

    Raises:
        InputError: there are no rows, a sweep is running, or the schemas of rows do not match.
    """
    folders = [folder for table in TABLES for folder in shelf.folders(results, table)]
    if not folders:
        raise InputError(Mistake("holds no rows; wanted a folder of results, or that of a sweep", results))
    count = 0
    for folder in folders:
        with holding.alone(folder.parent):
            count += _compact(folder, time() - _DAY * days, say)
    return count


def _compact(folder: Path, before: float, say: Callable[[str], None]) -> int:
    for left in folder.parent.glob(f".{folder.name}.*.partial.parquet"):
        left.unlink()
    packed = shelf.packed_file(folder)
    names = sorted(shelf.own_files(folder))
    old = [unit for name in names if (unit := folder / f"{name}.parquet").is_file() and unit.stat().st_mtime <= before]
    heads = rows.heads(old, ["started"], _STARTED)
    whole = [unit for unit in old if isinstance(heads.get(unit), dict) and _is_text(unit.stem)]
    if damaged := len(old) - len(whole):
        say(f"{folder}: {damaged} damaged file{'s' * (damaged > 1)} left as {'they are' if damaged > 1 else 'it is'}")
    if not whole:
        say(f"{folder}: nothing to pack; {len(shelf.packed_units(folder))} units are packed")
        return 0
    stays = sorted(shelf.packed_units(folder) - {unit.stem for unit in whole})
    asked = sorted([*whole, *(folder / f"{name}.parquet" for name in stays)])
    schema = fitting_schema(asked)
    if shelf.FILE in schema.names:
        raise InputError(Mistake(f"rows have a column {shelf.FILE!r} of their own; they cannot be packed", packed))
    with replacing(packed) as partial:
        with partial.open("wb") as into, pq.ParquetWriter(into, schema.append(_NAME)) as writer:
            for batch in _batches(asked):
                table = rows.read(batch, schema, named=True)
                writer.write_table(table, row_group_size=len(table))
        with partial.open("rb") as written:
            os.fsync(written.fileno())
            _compare(written, asked, schema)
    _sync(packed.parent)
    for unit in whole:
        unit.unlink()
    say(f"{folder}: {len(whole)} units packed into {packed.name}, which holds {len(asked)}")
    return len(whole)


def _is_text(name: str) -> bool:
    """Return whether a name is valid UTF-8, which the names of packed units must be."""
    try:
        name.encode()
    except UnicodeEncodeError:
        return False
    return True


def fitting_schema(units: Sequence[Path], schema: pa.Schema = _ANY) -> pa.Schema:
    """Return the common schema of all units; columns of `schema` come first.

    Raises:
        InputError: a file has columns of other types; the message names it.
    """
    found, _ = shelf.parts(units)
    for part in found:
        try:
            schema = pa.unify_schemas([schema, shelf.schema(part)]).remove_metadata()
        except (pa.ArrowException, OSError) as error:
            why = f"rows do not fit those of other files ({error}); take it out of the results"
            raise InputError(Mistake(why, Path(part.files[0]))) from error
    return schema


def _batches(units: Sequence[Path]) -> Iterator[Sequence[Path]]:
    return (units[start : start + _BATCH] for start in range(0, len(units), _BATCH))


def _compare(written: BinaryIO, units: Sequence[Path], schema: pa.Schema) -> None:
    """Compare the packed rows with the originals.

    Raises InputError if they differ; nothing is removed then.
    """
    with pq.ParquetFile(written) as file:
        for group, batch in enumerate(_batches(units)):
            if not rows.same(file.read_row_group(group), rows.read_each(batch, schema, named=True)):
                why = f"the packed rows differ from those in the {len(batch)} files from here on; nothing was removed"
                raise InputError(Mistake(why, batch[0]))


def _sync(folder: Path) -> None:
    """Flush a folder to the disk.

    A rename is then durable before the replaced files are removed.
    """
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
