# pyright: reportUnknownMemberType=false
# pyarrow's stubs have incomplete types of columns, and of files that Parquet is read from.
"""Row store: a file for each unit, or one packed file for many units.

A unit's own file is `rows/<unit>.parquet`. The packed file `rows.parquet` is next to the folder, and its column `file`
names the unit (`springbench compact`). A path under `rows/` identifies a unit wherever its rows are stored. Its own
file has priority over packed rows. Therefore no unit appears twice or is missing at any moment of packing, and a
repeated run replaces its packed rows.
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
"""Column of a packed file that names the unit."""

_END = 2**15
"""Number of bytes at the end of a file in which its schema is searched."""


def packed_file(folder: Path) -> Path:
    """Return the path of the packed file of a folder of rows.

    It may not exist.
    """
    return folder.with_name(f"{folder.name}.parquet")


def folders(above: Path, name: str, depth: str = "**/") -> list[Path]:
    """Find the folders of rows of a given name, including completely packed ones.

    Args:
        above: folder to search.
        name: name of the row folders, such as `rows`.
        depth: glob prefix of the search.
    Returns: sorted paths.
    """
    packed = (path.with_suffix("") for path in above.glob(f"{depth}{name}.parquet"))
    return sorted({*above.glob(f"{depth}{name}/"), *packed})


def own_files(folder: Path) -> set[str]:
    """List the units of a folder that have a file of their own.

    Anything else at the path of such a file counts too.
    """
    try:
        with os.scandir(folder) as entries:
            return {e.name[:-8] for e in entries if e.name.endswith(".parquet") and not e.name.startswith(".")}
    except (FileNotFoundError, NotADirectoryError):
        return set()


def packed_units(folder: Path) -> frozenset[str]:
    """List the units in the packed file of a folder.

    Raises:
        InputError: if it is damaged.
    """
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
    """List all units of a folder of rows as paths, sorted by name; raise InputError."""
    return [folder / f"{name}.parquet" for name in sorted(own_files(folder) | packed_units(folder))]


def there(unit: Path) -> bool:
    """Return whether a unit has rows, or something else at its path; raise InputError."""
    return os.path.lexists(unit) or unit.stem in packed_units(unit.parent)


@dataclass(frozen=True, slots=True)
class Part:
    """A group of files with one schema.

    files: paths of the files.
    numbers: for each file, the index of its unit in the request.
    packed: for a packed file, the indices of its units by name.
    """

    files: tuple[str, ...]
    numbers: tuple[int, ...] = ()
    packed: dict[str, int] | None = None


def parts(asked: Iterable[Path]) -> tuple[list[Part], list[int]]:
    """Group units by schema.

    Args:
        asked: row files of the units.
    Returns: the groups, and the indices of units that are evidently not files of rows.
    Raises:
        InputError: for a damaged packed file.
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
    """Read the schema of the rows of a group."""
    import pyarrow.parquet as pq

    with open(part.files[0], "rb") as file:
        found = pq.read_schema(file)
    return found if part.packed is None else found.remove(found.get_field_index(FILE))


def _kind(path: str) -> bytes | None:
    """Read a key that files of one schema share.

    Only the end of the file is read. It is the schema as pyarrow stores it there, or the path for files of other
    writers. None for other files.
    """
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
