# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyarrow's stubs are incomplete for columns, and for file objects that Parquet is read from.
"""Merge results of several folders.

Units are identified by content, so that none is lost or duplicated.

A run on two machines has two ids, so both keep their rows. Where a unit was measured twice with different rows, the
newer rows keep its name. The others are named by their content, `<unit>~<digest>`. Rows are copied file by file with
pyarrow, and compared with the original before they replace a file. Runs that should have ended at the same positions
and did not are reported.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from glob import escape
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from harness.base import columns, holding, rows, shelf, union
from harness.base.claim import NAME as CLAIM
from harness.base.claim import claimed, config_of
from harness.base.errors import InputError, Mistake
from harness.base.files import replacing
from harness.experiments.archive.compact import TABLES, fitting_schema
from harness.report.machines import KNOWN, foot
from harness.report.stored import ASKED

_ANY = pa.schema([])
_STARTED = pa.schema([columns.SCHEMA.field("started")])


@dataclass(frozen=True, slots=True)
class Merged:
    """Result of a merge.

    Attributes:
        written: units written.
        known: units that existed already.
        conflicts: descriptions of runs with the same machine and source code that end at different positions.
        others: descriptions of such runs across machines or source codes, whose last bits may
            differ.
        machines: all machines, and what may be compared across them.
    """

    written: int
    known: int
    conflicts: list[str]
    others: list[str]
    machines: list[str]


def sweeps(results: Path) -> list[Path]:
    """Return the folders that contain rows, or `results` itself if it does.

    Raises InputError for none.
    """
    found = {folder.parent for table in TABLES for folder in shelf.folders(results, table)}
    found = {folder for folder in found if not any(part.startswith(".") for part in folder.relative_to(results).parts)}
    if not found:
        raise InputError(Mistake("holds no rows; wanted a folder of results, or that of a sweep", results))
    return sorted(found)


def merge(sources: Sequence[Path], into: Path, say: Callable[[str], None]) -> Merged:
    """Merge the rows, recordings and pictures of several folders into one.

    The target may contain results already. The same command resumes an interrupted merge.

    Args:
        sources: folders of results, or of sweeps.
        into: folder for the merged results.
        say: prints a remark.

    Raises:
        InputError: a folder has no rows, one contains another, sweeps and folders of several sweeps are mixed, rows are
            damaged, or their schemas do not match.
    """
    for source in sources:
        if into.resolve().is_relative_to(source.resolve()) or source.resolve().is_relative_to(into.resolve()):
            raise InputError(
                Mistake(f"and {source} lie in each other; wanted a folder beside them", into, key="--into")
            )
    places = {(source, folder.relative_to(source)) for source in sources for folder in sweeps(source)}
    if len({place == Path() for _, place in places}) > 1:
        raise InputError("merge: one folder is that of a sweep, another holds several; wanted folders of one kind")
    written = known = 0
    for place in {place for _, place in places}:  # all that do not fit are refused before anything is written
        for table in TABLES:
            folders = [folder / place / table for folder in (into, *sources)]
            schema = columns.SCHEMA if table == "rows" else _ANY
            fitting_schema([unit for folder in folders for unit in shelf.units(folder)], schema)
    for place in sorted({place for _, place in places}):
        home = into / place
        home.mkdir(parents=True, exist_ok=True)
        with holding.alone(home):
            for table in TABLES:
                found = [source / place / table for source in sources if (source, place) in places]
                count = _table([folder for folder in found if shelf.units(folder)], home / table)
                written, known = written + count[0], known + count[1]
        for source in sources:
            _claim(source / place, home)
        say(f"{home}: {len(shelf.units(home / 'rows'))} runs")
    return Merged(written, known, *_conflicts([folder for s in sweeps(into) for folder in [s / "rows"]]))


def _table(folders: Sequence[Path], home: Path) -> tuple[int, int]:
    """Merge the units of one table; return the numbers of written and of existing units."""
    by_name: dict[str, list[Path]] = defaultdict(list)
    for folder in (home, *folders):
        for unit in shelf.units(folder):
            by_name[unit.stem].append(unit)
    written = known = 0
    single = [units[0] for units in by_name.values() if len(units) == 1]
    for unit, table in _tables([unit for unit in single if unit.parent != home]):
        _put(table, unit, home / unit.name)
        written += 1
    known += sum(unit.parent == home for unit in single)
    for name, units in by_name.items():
        if len(units) == 1:
            continue
        heads = rows.heads(units, ["started"], _STARTED)
        tables = [(unit, rows.read_each([unit], _ANY)) for unit in units]
        newest = sorted(tables, key=lambda pair: _started(heads[pair[0]]), reverse=True)  # the first where they tie
        kept = list[pa.Table]()
        named = list[tuple[Path, pa.Table, Path]]()
        for unit, table in newest:
            if any(rows.same(table, other) for other in kept):
                known += 1
                continue
            named.append((unit, table, home / (f"{name}~{content(table)}.parquet" if kept else f"{name}.parquet")))
            kept.append(table)
        for unit, table, target in reversed(named):  # what gives its name to a newer one is there under another first
            if not shelf.there(target) or not rows.same(rows.read_each([target], _ANY), table):
                _put(table, unit, target)
                written += 1
    return written, known


def _started(head: dict[str, object] | str) -> str:
    if isinstance(head, str):
        raise InputError(head)
    return str(head["started"] or "")


def _tables(units: Sequence[Path], batch: int = 1_000) -> Iterator[tuple[Path, pa.Table]]:
    """Yield the rows of each unit; packed ones are read in batches."""
    for start in range(0, len(units), batch):
        chosen = units[start : start + batch]
        packed = [unit for unit in chosen if not unit.exists()]
        yield from ((unit, rows.read_each([unit], _ANY)) for unit in chosen if unit.exists())
        if packed:
            table = rows.read_each(packed, _ANY, named=True)
            lengths = Counter(table[shelf.FILE].to_pylist())
            at = 0
            for unit in packed:
                yield unit, table.slice(at, lengths[unit.stem]).drop_columns([shelf.FILE])
                at += lengths[unit.stem]


def content(table: pa.Table) -> str:
    """Return 8 hexadecimal digits of SHA-256 over rows, independent of storage; empty columns are ignored."""
    full = [name for name in table.column_names if table[name].null_count < len(table)]
    return hashlib.sha256(repr(table.select(sorted(full)).to_pylist()).encode()).hexdigest()[:8]


def _put(table: pa.Table, unit: Path, target: Path) -> None:
    """Write a unit's rows, after its recordings and its picture: rows mark a complete unit."""
    source, home = unit.parent.parent, target.parent.parent
    for part in ("recordings", "pictures"):
        for path in sorted((source / part).glob(f"{escape(unit.stem)}[.-]*")):
            if path.is_file() and path.suffix in (".rrd", ".png"):
                _copy(path, home / part / (target.stem + path.name[len(unit.stem) :]))
    target.parent.mkdir(parents=True, exist_ok=True)
    with replacing(target) as partial:
        with partial.open("wb") as file:
            pq.write_table(table, file)
            file.flush()
            os.fsync(file.fileno())
        if not rows.same(rows.read_each([partial], _ANY), table):
            raise InputError(Mistake("its rows differ from those written; nothing was replaced", unit))


def _copy(path: Path, target: Path) -> None:
    if target.exists() and target.samefile(path):
        return
    target.parent.mkdir(parents=True, exist_ok=True)
    with replacing(target) as partial:
        shutil.copyfile(path, partial)


def _claim(source: Path, home: Path) -> None:
    """Assign the merged folder to the config of its sources, if that still exists."""
    config = config_of(source)
    if config and not (home / CLAIM).exists():
        claimed(home, config)


def _conflicts(folders: Sequence[Path]) -> tuple[list[str], list[str], list[str]]:
    """Find runs with equal specifications whose steps ended at different positions.

    Returns those of one machine and source code, those across several, and the machines.
    """
    units = [unit for folder in folders for unit in shelf.units(folder)]
    try:
        return _differing(units)
    except union.Unfit:  # damaged, or paths that are patterns to DuckDB
        return _differing(units, rows.read_each(units))


def _differing(units: Sequence[Path], read: pa.Table | None = None) -> tuple[list[str], list[str], list[str]]:
    """Query the conflicts; DuckDB reads the units unless `read` has their rows. Raises Unfit."""
    asked = ", ".join(f'"{name}"' for name in ASKED)
    with union.connected() as connection:
        if read is None:
            whole = union.union(connection, "files", units, columns.SCHEMA, "default")
            connection.execute(f"CREATE VIEW rows AS {whole.select()}")
        else:
            connection.register("rows", read)

        def differing(key: str) -> list[str]:
            each = f"SELECT {key}, {asked}, frame FROM rows WHERE phase = 'step' AND digest IS NOT NULL GROUP BY ALL"
            found = connection.execute(
                f"SELECT scene, size, solver, parameters, first FROM (SELECT {key}, {asked}, min(frame) AS first "
                f"FROM ({each} HAVING count(DISTINCT digest) > 1) GROUP BY ALL) ORDER BY ALL"
            ).fetchall()
            return [
                f"{scene}{f' {size}' if size else ''} {solver}{'' if given == '{}' else f' {given}'}: from step {first}"
                for scene, size, solver, given, first in found
            ]

        where = connection.sql(f"SELECT {', '.join(KNOWN)} FROM rows GROUP BY ALL").to_arrow_table()
        return differing("run_id, code"), differing("0"), foot(where)
