# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyarrow's stubs are incomplete for columns, and for file objects that Parquet is read from.
"""Merge results of several folders.

Units are identified by content, so that none is lost or duplicated. A run on two machines has two ids, so the rows of
both remain. Where a unit was measured twice with different rows, the newer rows have its name. The others are named by
their content, `<unit>~<digest>`. Rows are copied file by file with pyarrow, and compared with the original before they
replace a file. Runs that should have ended at the same positions and did not are reported.
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
from springbench.harness.atomic_files import atomic_write
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.execution import folder_locks
from springbench.harness.experiments.archive.compaction import unify_schemas
from springbench.harness.report.machine_footer import FOOTER_COLUMNS, build_machine_footer
from springbench.harness.report.results_comparison import PAIRING_COLUMNS
from springbench.harness.results import parquet_rows, row_store, row_union, run_schema
from springbench.harness.results.folder_ownership import OWNER_FILE as CLAIM
from springbench.harness.results.folder_ownership import claim_folder, read_owner

_EMPTY_SCHEMA = pa.schema([])
_STARTED_SCHEMA = pa.schema([run_schema.RUN_SCHEMA.field("started_at")])


@dataclass(frozen=True, slots=True)
class MergeReport:
    """Result of a merge.

    Attributes:
        num_written: units written.
        num_existing: units that existed already.
        conflicts: descriptions of runs with the same machine and source code that end at different positions.
        cross_machine_differences: descriptions of such runs across machines or source codes, whose last bits may
            differ.
        machine_summary: all machines, and what may be compared across them.
    """

    num_written: int
    num_existing: int
    conflicts: list[str]
    cross_machine_differences: list[str]
    machine_summary: list[str]


def list_sweep_folders(results: Path) -> list[Path]:
    """Return the folders that contain rows, or `results` itself if it does.

    Raises:
        InputError: there are no rows.
    """
    found = {
        folder.parent for table in row_store.TABLE_FOLDERS for folder in row_store.find_row_folders(results, table)
    }
    found = {folder for folder in found if not any(part.startswith(".") for part in folder.relative_to(results).parts)}
    if not found:
        raise InputError(InputMistake("contains no rows; expected a folder of results, or that of a sweep", results))
    return sorted(found)


def merge_results(sources: Sequence[Path], target: Path, print_message: Callable[[str], None]) -> MergeReport:
    """Merge the rows, recordings and pictures of several folders into one.

    The target may contain results already. The same command resumes an interrupted merge.

    Args:
        sources: folders of results, or of sweeps.
        target: folder for the merged results.
        print_message: prints a remark.

    Raises:
        InputError: a folder has no rows, one contains another, sweeps and folders of several sweeps are mixed, rows are
            damaged, or their schemas do not match.
    """
    for source in sources:
        if target.resolve().is_relative_to(source.resolve()) or source.resolve().is_relative_to(target.resolve()):
            raise InputError(
                InputMistake(f"contains {source} or lies in it; expected a separate folder", target, key="--output")
            )
    places = {(source, folder.relative_to(source)) for source in sources for folder in list_sweep_folders(source)}
    if len({place == Path() for _, place in places}) > 1:
        raise InputError("merge: one folder is that of a sweep, another contains several; expected folders of one kind")
    written = known = 0
    for place in {place for _, place in places}:  # schemas that do not match are refused before anything is written
        for table in row_store.TABLE_FOLDERS:
            folders = [folder / place / table for folder in (target, *sources)]
            schema = run_schema.RUN_SCHEMA if table == "rows" else _EMPTY_SCHEMA
            unify_schemas([unit for folder in folders for unit in row_store.list_units(folder)], schema)
    for place in sorted({place for _, place in places}):
        home = target / place
        home.mkdir(parents=True, exist_ok=True)
        with folder_locks.lock_folder_exclusive(home):
            for table in row_store.TABLE_FOLDERS:
                found = [source / place / table for source in sources if (source, place) in places]
                count = _merge_table([folder for folder in found if row_store.list_units(folder)], home / table)
                written, known = written + count[0], known + count[1]
        for source in sources:
            _copy_ownership(source / place, home)
        print_message(f"{home}: {len(row_store.list_units(home / 'rows'))} runs")
    return MergeReport(
        written, known, *_find_conflicts([folder for s in list_sweep_folders(target) for folder in [s / "rows"]])
    )


def _merge_table(folders: Sequence[Path], home: Path) -> tuple[int, int]:
    """Merge the units of one table; return the numbers of written and of existing units."""
    by_name: dict[str, list[Path]] = defaultdict(list)
    for folder in (home, *folders):
        for unit in row_store.list_units(folder):
            by_name[unit.stem].append(unit)
    written = known = 0
    single = [units[0] for units in by_name.values() if len(units) == 1]
    for unit, table in _iterate_tables([unit for unit in single if unit.parent != home]):
        _write_unit(table, unit, home / unit.name)
        written += 1
    known += sum(unit.parent == home for unit in single)
    for name, units in by_name.items():
        if len(units) == 1:
            continue
        heads = parquet_rows.read_first_rows(units, ["started_at"], _STARTED_SCHEMA)
        tables = [(unit, parquet_rows.read_rows_by_file([unit], _EMPTY_SCHEMA)) for unit in units]
        newest = sorted(
            tables, key=lambda pair: _read_start_time(heads[pair[0]]), reverse=True
        )  # stable: among equals the target's unit comes first
        merged = list[pa.Table]()
        named = list[tuple[Path, pa.Table, Path]]()
        for unit, table in newest:
            if any(parquet_rows.is_bitwise_equal(table, other) for other in merged):
                known += 1
                continue
            named.append(
                (
                    unit,
                    table,
                    home / (f"{name}~{compute_content_digest(table)}.parquet" if merged else f"{name}.parquet"),
                )
            )
            merged.append(table)
        # Oldest first: an older unit is stored by its content's name before a newer one replaces its file.
        for unit, table, target in reversed(named):
            if not row_store.has_rows(target) or not parquet_rows.is_bitwise_equal(
                parquet_rows.read_rows_by_file([target], _EMPTY_SCHEMA), table
            ):
                _write_unit(table, unit, target)
                written += 1
    return written, known


def _read_start_time(head: dict[str, object] | str) -> str:
    if isinstance(head, str):
        raise InputError(head)
    return str(head["started_at"] or "")


def _iterate_tables(units: Sequence[Path], batch: int = 1_000) -> Iterator[tuple[Path, pa.Table]]:
    """Yield the rows of each unit; packed ones are read in batches."""
    for start in range(0, len(units), batch):
        chosen = units[start : start + batch]
        packed = [unit for unit in chosen if not unit.exists()]
        yield from ((unit, parquet_rows.read_rows_by_file([unit], _EMPTY_SCHEMA)) for unit in chosen if unit.exists())
        if packed:
            table = parquet_rows.read_rows_by_file(packed, _EMPTY_SCHEMA, with_unit_names=True)
            lengths = Counter(table[row_store.FILE_COLUMN].to_pylist())
            at = 0
            for unit in packed:
                yield unit, table.slice(at, lengths[unit.stem]).drop_columns([row_store.FILE_COLUMN])
                at += lengths[unit.stem]


def compute_content_digest(table: pa.Table) -> str:
    """Return 8 hexadecimal digits of SHA-256 over rows, independent of storage; empty columns are ignored."""
    full = [name for name in table.column_names if table[name].null_count < len(table)]
    return hashlib.sha256(repr(table.select(sorted(full)).to_pylist()).encode()).hexdigest()[:8]


def _write_unit(table: pa.Table, unit: Path, target: Path) -> None:
    """Write a unit's rows, after its recordings and its picture: rows mark a complete unit."""
    source, home = unit.parent.parent, target.parent.parent
    for part in ("recordings", "pictures"):
        for path in sorted((source / part).glob(f"{escape(unit.stem)}[.-]*")):
            if path.is_file() and path.suffix in (".rrd", ".png"):
                _copy_file(path, home / part / (target.stem + path.name[len(unit.stem) :]))
    target.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(target) as partial:
        with partial.open("wb") as file:
            pq.write_table(table, file)
            file.flush()
            os.fsync(file.fileno())
        if not parquet_rows.is_bitwise_equal(parquet_rows.read_rows_by_file([partial], _EMPTY_SCHEMA), table):
            raise InputError(InputMistake("its rows differ from those written; nothing was replaced", unit))


def _copy_file(path: Path, target: Path) -> None:
    if target.exists() and target.samefile(path):
        return
    target.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(target) as partial:
        shutil.copyfile(path, partial)


def _copy_ownership(source: Path, home: Path) -> None:
    """Assign the merged folder to the config of its sources, if that still exists."""
    config = read_owner(source)
    if config and not (home / CLAIM).exists():
        claim_folder(home, config)


def _find_conflicts(folders: Sequence[Path]) -> tuple[list[str], list[str], list[str]]:
    """Find runs with equal specifications whose steps ended at different positions.

    Returns:
        Descriptions of those of one machine and source code, of those across several, and of the machines.
    """
    units = [unit for folder in folders for unit in row_store.list_units(folder)]
    try:
        return _query_conflicts(units)
    except row_union.SchemaMismatch:  # damaged, or paths that are patterns to DuckDB
        return _query_conflicts(units, parquet_rows.read_rows_by_file(units))


def _query_conflicts(units: Sequence[Path], table: pa.Table | None = None) -> tuple[list[str], list[str], list[str]]:
    """Query the conflicts; DuckDB reads the units unless `table` has their rows. Raises SchemaMismatch."""
    pairing_columns = ", ".join(f'"{name}"' for name in PAIRING_COLUMNS)
    with row_union.open_connection() as connection:
        if table is None:
            whole = row_union.build_union(connection, "files", units, run_schema.RUN_SCHEMA, "default")
            connection.execute(f"CREATE VIEW rows AS {whole.build_query()}")
        else:
            connection.register("rows", table)

        def find_differing_runs(key: str) -> list[str]:
            each = (
                f"SELECT {key}, {pairing_columns}, frame FROM rows "
                "WHERE phase = 'step' AND positions_digest IS NOT NULL GROUP BY ALL"
            )
            found = connection.execute(
                "SELECT scene, size, solver, parameters, first FROM "
                f"(SELECT {key}, {pairing_columns}, min(frame) AS first FROM "
                f"({each} HAVING count(DISTINCT positions_digest) > 1) GROUP BY ALL) ORDER BY ALL"
            ).fetchall()
            return [
                f"{scene}{f' {size}' if size else ''} {solver}{'' if given == '{}' else f' {given}'}: from step {first}"
                for scene, size, solver, given, first in found
            ]

        where = connection.sql(f"SELECT {', '.join(FOOTER_COLUMNS)} FROM rows GROUP BY ALL").to_arrow_table()
        return find_differing_runs("run_id, source_fingerprint"), find_differing_runs("0"), build_machine_footer(where)
