# pyright: reportUnknownMemberType=false
# pyarrow's stubs say little of columns, and of files that Parquet is read from.
"""Where rows are kept: a unit's in a file of its own, `rows/<unit>.parquet`, or those of many in one file beside the
folder, `rows.parquet`, whose column `file` names the unit (`springbench compact`).

A path under `rows/` names a unit wherever its rows lie. Its own file goes before what was packed of it: so nothing is
seen twice, or missing, at any moment of packing, and a run that is done again takes the place of its packed rows.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from harness.base.errors import InputError, Mistake
from harness.base.files import is_file_name

if TYPE_CHECKING:
    import pyarrow as pa

FILE = "file"
"""The column of a packed file that names the unit."""

_END = 2**15
"""Bytes at the end of a file in which its schema is looked for."""


def packed_file(folder: Path) -> Path:
    """The file that holds packed units of a folder of rows, if there is one."""
    return folder.with_name(f"{folder.name}.parquet")


def folders(above: Path, name: str, depth: str = "**/") -> list[Path]:
    """The folders of rows of this name somewhere in a folder, those included of which all is packed."""
    packed = (path.with_suffix("") for path in above.glob(f"{depth}{name}.parquet"))
    return sorted({*above.glob(f"{depth}{name}/"), *packed})


def own_files(folder: Path) -> set[str]:
    """The units of a folder that have files of their own, or something else in the place of one."""
    try:
        with os.scandir(folder) as entries:
            return {e.name[:-8] for e in entries if e.name.endswith(".parquet") and not e.name.startswith(".")}
    except (FileNotFoundError, NotADirectoryError):
        return set()


def packed_units(folder: Path) -> frozenset[str]:
    """The units in the packed file of a folder. Raises InputError where that is damaged."""
    path = packed_file(folder)
    try:
        there = path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return frozenset()
    return _packed(path, there.st_ino, there.st_mtime_ns, there.st_size)


@lru_cache(maxsize=16)
def _packed(path: Path, *state: int) -> frozenset[str]:
    import pyarrow as pa  # for those who have packed rows
    import pyarrow.parquet as pq

    try:
        if not path.is_file():
            raise OSError("it is no plain file")
        with path.open("rb") as file:  # pyarrow takes some paths for URLs, and none that is no UTF-8
            names = pq.read_table(file, columns=[FILE], partitioning=None)[FILE]
        if names.null_count:
            raise OSError(f"rows without a {FILE}")
        found = frozenset(map(str, names.cast(pa.string()).unique().to_pylist()))
        if foreign := [name for name in found if not is_file_name(name) or name.startswith(".")]:
            raise OSError(f"{foreign[0]!r} is the name of no unit")
        return found
    except (pa.ArrowException, OSError, KeyError) as error:
        raise InputError(Mistake(f"holds no packed rows ({error}); take it out of the results", path)) from error


def units(folder: Path) -> list[Path]:
    """All units of a folder of rows, as paths in it, by their names. Raises InputError."""
    return [folder / f"{name}.parquet" for name in sorted(own_files(folder) | packed_units(folder))]


def there(unit: Path) -> bool:
    """Whether there are rows of a unit, or something in their place. Raises InputError."""
    return os.path.lexists(unit) or unit.stem in packed_units(unit.parent)


@dataclass(frozen=True, slots=True)
class Part:
    """Files that have one schema, and for each the number of its unit among those that were asked for; of a packed
    file the numbers of its units by their names."""

    files: tuple[str, ...]
    numbers: tuple[int, ...] = ()
    packed: dict[str, int] | None = None


def parts(asked: Iterable[Path]) -> tuple[list[Part], list[int]]:
    """Units in as few parts as they have schemas, and the numbers of those that are no files of rows on the face of it.

    Raises InputError for a packed file that is damaged.
    """
    alike: dict[bytes, list[tuple[str, int]]] = {}
    packed: dict[Path, dict[str, int]] = {}
    damaged: list[int] = []
    there: dict[Path, frozenset[str]] = {}
    for number, path in enumerate(asked):
        folder = path.parent
        if folder not in there:
            there[folder] = packed_units(folder) - own_files(folder)
        if path.stem in there[folder]:
            packed.setdefault(packed_file(folder), {})[path.stem] = number
        elif (kind := _kind(str(path))) is None:
            damaged.append(number)
        else:
            alike.setdefault(kind, []).append((str(path), number))
    found = [Part(tuple(f for f, _ in files), tuple(n for _, n in files)) for files in alike.values()]
    return found + [Part((str(path),), packed=names) for path, names in packed.items()], damaged


def schema(part: Part) -> pa.Schema:
    """The schema of a part's rows."""
    import pyarrow.parquet as pq

    with open(part.files[0], "rb") as file:
        found = pq.read_schema(file)
    return found if part.packed is None else found.remove(found.get_field_index(FILE))


def _kind(path: str) -> bytes | None:
    """What files of one schema have in common, at the price of reading their ends: the schema as pyarrow leaves it
    there; of other writers' the name. None for what is no Parquet file."""
    try:
        if not os.path.isfile(path):  # a pipe would be waited for
            return None
        with open(path, "rb", buffering=0) as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(0, size - _END))
            end = file.read(_END)
    except OSError:
        return None
    footer = int.from_bytes(end[-8:-4], "little")
    if end[-4:] != b"PAR1" or footer + 12 > size:
        return None
    at = end.rfind(b"ARROW:schema", max(0, len(end) - 8 - footer))
    return end[at:-8] if at >= 0 else path.encode()
