# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyarrow's stubs say little of columns, and of files that Parquet is read from.
"""Packs the rows of many units into one file beside their folder; whoever reads rows sees the same before and after.

The packed file is written anew under a partial name, with what was packed before; it is compared with the originals,
which another reader reads for that, file by file, and takes its place by a rename; then the units' own files go. A
unit's own file goes before its packed rows (`harness.base.shelf`): so a kill leaves, at any moment, all rows where they
are seen once, and the next start does the rest.
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
"""The folders of rows in a folder of results."""

_BATCH = 2_000
"""So many units are in memory at once."""
_DAY = 86_400.0
_ANY = pa.schema([])
_NAME = pa.field(shelf.FILE, pa.string())
_STARTED = pa.schema([columns.SCHEMA.field("started")])


def compact(results: Path, say: Callable[[str], None], *, days: float = 0.0) -> int:
    """Pack the units of all folders of rows in a folder of results, those that were written so many days ago or more.

    Returns how many units were packed; say: is told of each folder. Raises InputError where there are no rows, where a
    sweep is being run, or where rows do not fit together.
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
    """Whether a name is UTF-8, which those of packed units have to be."""
    try:
        name.encode()
    except UnicodeEncodeError:
        return False
    return True


def fitting_schema(units: Sequence[Path], schema: pa.Schema = _ANY) -> pa.Schema:
    """The schema of all units, those columns first that they have to have if at all. Raises InputError that names a
    file whose columns are of other types."""
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
    """Compare what was written with the originals. Raises InputError where rows differ: nothing is removed then."""
    with pq.ParquetFile(written) as file:
        for group, batch in enumerate(_batches(units)):
            if not rows.same(file.read_row_group(group), rows.read_each(batch, schema, named=True)):
                why = f"the packed rows differ from those in the {len(batch)} files from here on; nothing was removed"
                raise InputError(Mistake(why, batch[0]))


def _sync(folder: Path) -> None:
    """See that a rename is on the disk before what it replaces goes."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
