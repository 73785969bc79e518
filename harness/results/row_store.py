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

from springbench.harness.atomic_files import explain_unreadable_file, is_file_name
from springbench.harness.errors import InputError, InputMistake

if TYPE_CHECKING:
    import pyarrow as pa

TABLE_FOLDERS = ("rows", "accuracy", "ablation")
"""Names of the folders of rows in the results of a sweep, and stems of packed files."""

MANY_FILES = 500
"""Number of files from which on opening them takes most of a query's time."""

FILE_COLUMN = "file"
"""Column of a packed file that names the unit."""

_FOOTER_BYTES = 2**15
"""Number of bytes at the end of a file that are searched for its schema."""


def build_packed_path(folder: Path) -> Path:
    """Return the path of the packed file of a row folder; it may not exist."""
    return folder.parent / f"{folder.name}.parquet"  # with_name rejects "."


def find_row_folders(above: Path, name: str, depth: str = "**/") -> list[Path]:
    """Find the folders of rows of a given name, including completely packed ones.

    Args:
        above: folder to search.
        name: name of the row folders, such as `rows`.
        depth: glob prefix of the search.

    Returns:
        Sorted paths.
    """
    packed = (path.with_suffix("") for path in above.glob(f"{depth}{name}.parquet"))
    return sorted({*above.glob(f"{depth}{name}/"), *packed})


def list_unit_files(folder: Path) -> set[str]:
    """List the units of a folder that have a file of their own.

    Anything else at the path of such a file counts too.
    """
    try:
        with os.scandir(folder) as entries:
            return {e.name[:-8] for e in entries if e.name.endswith(".parquet") and not e.name.startswith(".")}
    except (FileNotFoundError, NotADirectoryError):
        return set()


def has_many_files(folder: Path) -> bool:
    """Return whether MANY_FILES units or more have a file of their own."""
    return len(list_unit_files(folder)) >= MANY_FILES


def list_packed_units(folder: Path) -> frozenset[str]:
    """List the units in the packed file of a folder.

    Raises:
        InputError: if it is damaged.
    """
    path = build_packed_path(folder)
    try:
        there = path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return frozenset()
    return _read_packed_units(path, there.st_ino, there.st_mtime_ns, there.st_size)


@lru_cache(maxsize=16)
def _read_packed_units(path: Path, *state: int) -> frozenset[str]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        if not path.is_file():
            raise OSError("it is no plain file")
        with path.open("rb") as file:  # pyarrow interprets some paths as URLs, and rejects paths that are not UTF-8
            column = [FILE_COLUMN]
            names = pq.ParquetFile(file, read_dictionary=column).read(column)[FILE_COLUMN]
        if names.null_count:
            raise OSError(f"rows without a {FILE_COLUMN}")
        found = frozenset(map(str, names.unify_dictionaries().unique().cast(pa.string()).to_pylist()))
        if foreign := [name for name in found if not is_file_name(name) or name.startswith(".")]:
            raise OSError(f"{foreign[0]!r} is the name of no unit")
        return found
    except (pa.ArrowException, OSError, KeyError) as error:
        problem = explain_unreadable_file(path) or f"contains no packed rows ({error}); take it out of the results"
        raise InputError(InputMistake(problem, path)) from error


def list_units(folder: Path) -> list[Path]:
    """List all units of a folder of rows as paths, sorted by name; raise InputError."""
    return [folder / f"{name}.parquet" for name in sorted(list_unit_files(folder) | list_packed_units(folder))]


def has_rows(unit: Path) -> bool:
    """Return whether a unit has rows, or something else at its path; raise InputError."""
    return os.path.lexists(unit) or unit.stem in list_packed_units(unit.parent)


@dataclass(frozen=True, slots=True)
class UnitGroup:
    """A group of files with one schema: unpacked units, or one packed file.

    Attributes:
        files: paths of the files.
        unit_numbers: for each unpacked file, the index of its unit in the request.
        packed_numbers: for a packed file, the indices of its units by name; None for unpacked files.
    """

    files: tuple[str, ...]
    unit_numbers: tuple[int, ...] = ()
    packed_numbers: dict[str, int] | None = None


def group_units(paths: Iterable[Path]) -> tuple[list[UnitGroup], list[int]]:
    """Group units by schema.

    Args:
        paths: row files of the units.

    Returns:
        The groups, and the indices of units that are evidently not files of rows.

    Raises:
        InputError: for a damaged packed file.
    """
    by_kind: dict[bytes, list[tuple[str, int]]] = {}
    packed: dict[Path, dict[str, int]] = {}
    damaged: list[int] = []
    there: dict[Path, frozenset[str]] = {}
    for number, path in enumerate(paths):
        folder = path.parent
        if folder not in there:
            there[folder] = list_packed_units(folder) - list_unit_files(folder)
        if path.stem in there[folder]:
            packed.setdefault(build_packed_path(folder), {})[path.stem] = number
        elif (kind := _read_schema_key(str(path))) is None:
            damaged.append(number)
        else:
            by_kind.setdefault(kind, []).append((str(path), number))
    found = [UnitGroup(tuple(f for f, _ in files), tuple(n for _, n in files)) for files in by_kind.values()]
    return found + [UnitGroup((str(path),), packed_numbers=names) for path, names in packed.items()], damaged


def read_group_schema(part: UnitGroup) -> pa.Schema:
    """Read the schema of the rows of a group."""
    import pyarrow.parquet as pq

    with open(part.files[0], "rb") as file:
        found = pq.read_schema(file)
    return found if part.packed_numbers is None else found.remove(found.get_field_index(FILE_COLUMN))


def _read_schema_key(path: str) -> bytes | None:
    """Read a key that files of one schema share.

    The key is the schema that pyarrow stores at the end of the file, or the path if another program wrote the file. It
    is None if the file is no Parquet file.
    """
    try:
        if not os.path.isfile(path):  # reading a pipe would block
            return None
        with open(path, "rb", buffering=0) as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(0, size - _FOOTER_BYTES))
            end = file.read(_FOOTER_BYTES)
    except OSError:
        return None
    footer = int.from_bytes(end[-8:-4], "little")
    if end[-4:] != b"PAR1" or footer + 12 > size:
        return None
    at = end.rfind(b"ARROW:schema", max(0, len(end) - 8 - footer))
    return end[at:-8] if at >= 0 else path.encode()
