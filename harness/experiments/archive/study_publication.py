# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyarrow's stubs are incomplete for columns.
"""Write the results of a study to the published set (`springbench.harness.results.published_set`).

Columns that no page uses and no repetition confirms are left out. A study of outcomes has no times, and no rows that
have only times.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from springbench.harness.atomic_files import atomic_write, explain_unreadable_file
from springbench.harness.config.config_loader import load_config
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.results import parquet_rows, published_set, row_store, run_schema
from springbench.harness.results.solver_phases import SECONDS_PATTERN

DROPPED_COLUMNS = frozenset(
    (
        *("positions_digest", "recording_digest", "recording_path", "node_id", "source_fingerprint", "sweep"),
        *("wall_seconds_check", "wall_seconds_sum", "phases_consistent", "energy_springs", "energy_inertia"),
        *("energy_force", "energy_pins", "energy_effects", "energy_gain", "energy_available", "max_strain"),
        *("strain_p99", "flops_per_solve", "factor_bytes", "nnz_system", "nnz_factor", "nnz_hessian_factor"),
    )
)
"""Columns that are left out: digests of files that are not published, checks that a run has passed, and provenance.

`study.json` states the provenance once.
"""

_TIME_COLUMNS = frozenset(("seconds", "cpu_seconds", "preempted", "load_average", "cold_seconds", "search_seconds"))
"""Columns without meaning where the steps were not timed, and several runs shared the machine."""

_SOLVE_PHASES = ("prepare", "run", "step")
"""Phases whose rows have more than times; those of the parts of an iteration have nothing else."""

MAX_PAUSE = 600.0
"""Longest time between the starts of two runs that counts as work [s]; one run of a study takes less."""

MAX_PUBLISHED_BYTES = 8 * 2**20
"""Largest total size of the published set: it is part of every clone."""


def write_study(
    parts: Sequence[Path],
    config: Path,
    published: Path,
    print_message: Callable[[str], None],
    provenance: Path | None = None,
    *,
    omits_times: bool = False,
) -> published_set.PublishedStudy:
    """Write the study of folders of results to the published set, and return it.

    Args:
        parts: folders of results of one config, one for each command. A published study may be one of them, to which
            the runs of the others are added. Or one Parquet file of measurements that a script wrote.
        config: the config; its stem is the name of the study.
        published: folder of the published set.
        print_message: prints a remark.
        provenance: Parquet file of rows of a run by the same machine and code, for measurements without such columns.
        omits_times: whether all times are left out, as those of runs that share a machine are.

    Raises:
        InputError: there are no rows, runs of several configs, or the published set would become too large.
    """
    if not config.is_file():
        raise InputError(InputMistake("does not exist; expected the config of these results", config, key="--config"))
    by_part = [_read_part(part) for part in parts]
    made = _read_measurements(provenance) if provenance else None
    found = {
        table: _join_newest_runs(several)
        for table in ("measurements", *row_store.TABLE_FOLDERS)
        if (several := [_drop_missing_software(tables[table]) for tables in by_part if table in tables])
    }
    if not found:
        raise InputError(
            InputMistake("contains no rows; expected the folder of one sweep, such as results/hard", parts[0])
        )
    is_timed = not omits_times and any(_is_timed(rows) for rows in found.values())
    folder = published / config.stem
    published.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(dir=published, prefix=".") as temporary:
        for table, rows in found.items():
            has_times = is_timed or (not omits_times and _ran_alone(rows))
            written = _drop_columns(rows, DROPPED_COLUMNS) if has_times else _drop_times(rows)
            write_published_table(Path(temporary) / published_set.TABLE_FILES[table], written)
        older = list(folder.glob("*.parquet"))
        size = sum(path.stat().st_size for path in published.rglob("*.parquet") if path not in older)
        if size > MAX_PUBLISHED_BYTES:
            why = f"takes {size:,} bytes with this study, and at most {MAX_PUBLISHED_BYTES:,} are part of a clone"
            raise InputError(InputMistake(f"{why}; publish fewer runs, or --omit-times", published))
        folder.mkdir(exist_ok=True)
        replaced = sorted(Path(temporary).iterdir())
        for path in replaced:
            path.replace(folder / path.name)
        for path in older:  # last: an interruption leaves a table of each kind
            if path.name not in {one.name for one in replaced}:
                path.unlink()
    metadata = {
        "config": os.path.relpath(config.resolve(), folder.resolve()),
        "config_digest": published_set.compute_file_digest(config),
        "command": _describe_command(found, config),
        "is_timed": is_timed,
        "requested_runs": _count_requested_runs(config) if "rows" in found else None,
        **summarise_provenance(
            [row for rows in ([made] if made else found.values()) for row in _select_provenance(rows)]
        ),
    }
    durations = [_measure_duration(_select_provenance(rows)) for tables in by_part for rows in tables.values()]
    # Parts of one run each have no duration; the time from the first start to the last one is then the best estimate.
    metadata["duration_seconds"] = round(sum(durations)) or metadata["duration_seconds"]
    if made:
        metadata |= {"runs": sum(map(len, found.values())), "duration_seconds": None}
    study = write_study_file(folder, metadata)
    print_message(f"{folder}: {sum(map(len, found.values())):,} rows; the published set takes {size / 2**20:.1f} MiB")
    return study


def write_study_file(folder: Path, metadata: Mapping[str, Any]) -> published_set.PublishedStudy:
    """Write `study.json`, and return the study as it is read from there.

    Args:
        folder: folder of the study, whose tables (*.parquet) are listed with their checksums.
        metadata: all other entries of the file.
    """
    files = {path.name: published_set.compute_file_digest(path) for path in sorted(folder.glob("*.parquet"))}
    with atomic_write(folder / published_set.STUDY_FILE) as partial:
        partial.write_text(json.dumps({**metadata, "files": files}, indent=2) + "\n", encoding="utf-8")
    return published_set.read_study(folder)


def write_published_table(path: Path, table: pa.Table) -> None:
    """Write a table with the strongest compression: it is read rarely and cloned often.

    Args:
        path: the Parquet file, which is replaced if it exists.
        table: rows to write.
    """
    with atomic_write(path) as partial:
        pq.write_table(table, partial, compression="zstd", compression_level=19, store_schema=False)


def summarise_provenance(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Describe commits, machines, versions, dates and load of rows; each value is listed once.

    Args:
        rows: mappings with the columns of provenance; missing ones are omitted.
    """

    def list_values(name: str) -> list[Any]:
        return sorted({row[name] for row in rows if row.get(name) is not None})

    machines = {(row.get("cpu"), row.get("cores"), row.get("memory_gib"), row.get("operating_system")) for row in rows}
    versions: dict[str, str] = {}
    for text in list_values("versions"):
        versions |= json.loads(text)
    started, loads = list_values("started_at"), list_values("load_average")
    return {
        "runs": len({row.get("run_id") or row.get("unit_id") for row in rows}),
        "commits": list_values("commit"),
        "machines": [
            {"cpu": cpu, "cores": cores, "memory_gib": memory, "operating_system": system}
            for cpu, cores, memory, system in sorted(machines, key=str)
        ],
        "versions": dict(sorted(versions.items())),
        "started": [started[0], started[-1]] if started else [],
        "load_average": [round(loads[0], 2), round(loads[-1], 2)] if loads else [],
        "duration_seconds": round(_measure_duration(rows)),
    }


def _read_part(part: Path) -> dict[str, pa.Table]:
    """Read the tables of a part of a study, by their names.

    The part is a folder of results, a published study, or a file of measurements.
    """
    if part.suffix == ".parquet":
        return {"measurements": _read_measurements(part)}
    if (part / published_set.STUDY_FILE).is_file():
        with published_set.open_study_folder(published_set.read_study(part)) as folder:
            return _read_part(folder)
    return {table: rows for table in row_store.TABLE_FOLDERS if (rows := _read_table(part / table)) is not None}


def _join_newest_runs(parts: Sequence[pa.Table]) -> pa.Table:
    """Join tables, with only the newest execution of each run or unit.

    Of equal ones, that of the last table is selected. A run is identified by its key on any machine, a unit of another
    table by the name of its file. Measurements have neither: all are joined.
    """
    names = [*published_set.RUN_KEYS, "run_id", "started_at", row_store.FILE_COLUMN]
    newest: dict[tuple[Any, ...], tuple[str, str, int]] = {}
    executions = list[list[tuple[tuple[Any, ...], tuple[str, int]]]]()
    for number, part in enumerate(parts):
        executions.append([])
        if not {"run_id", row_store.FILE_COLUMN} & set(part.column_names):
            return pa.concat_tables(parts, promote_options="permissive")
        for row in part.select([name for name in names if name in part.column_names]).to_pylist():
            run_id = row.get("run_id")
            key = tuple(map(row.get, published_set.RUN_KEYS)) if run_id else (row[row_store.FILE_COLUMN],)
            execution = (str(row.get("started_at")), run_id or "", number)
            newest[key] = max(newest.get(key, execution), execution)
            executions[-1].append((key, execution[1:]))
    tables = [
        part.filter(pa.array([execution == newest[key][1:] for key, execution in rows], pa.bool_()))
        for part, rows in zip(parts, executions, strict=True)
    ]
    return pa.concat_tables(tables, promote_options="permissive")


def _read_table(folder: Path) -> pa.Table | None:
    """Read the rows of a folder with the names of their units; None without rows."""
    units = row_store.list_units(folder)
    if not units:
        return None
    schema = run_schema.RUN_SCHEMA if folder.name == "rows" else pa.schema([])
    return parquet_rows.read_rows(units, schema, with_unit_names=True)


def _read_measurements(path: Path) -> pa.Table:
    """Read a table that a script wrote.

    A column that names files of the script's machine is left out.
    """
    try:
        table = pq.read_table(path, partitioning=None)
    except (pa.ArrowException, OSError) as error:
        problem = explain_unreadable_file(path) or f"contains no table ({error}); expected a Parquet file"
        raise InputError(InputMistake(problem, path)) from error
    return table.select([name for name in table.column_names if name != row_store.FILE_COLUMN])


def _drop_missing_software(rows: pa.Table) -> pa.Table:
    """Drop the rows of solvers that support no run, because their software is not installed.

    Another part of the study may have them.
    """
    if "status" not in rows.column_names or "solver" not in rows.column_names:
        return rows
    supported = pc.unique(rows.filter(pc.field("status") != "unsupported")["solver"])
    return rows.filter(pc.is_in(rows["solver"], supported))


def _is_timed(rows: pa.Table) -> bool:
    return "timing" not in rows.column_names or "none" not in pc.unique(rows["timing"]).to_pylist()


def _ran_alone(rows: pa.Table) -> bool:
    return "num_concurrent_runs" in rows.column_names and set(rows["num_concurrent_runs"].to_pylist()) <= {1, None}


def _drop_times(rows: pa.Table) -> pa.Table:
    """Return the table without times, empty columns, and rows of phases that have only times."""
    if "phase" in rows.column_names:
        rows = rows.filter(pc.is_in(rows["phase"], value_set=pa.array(_SOLVE_PHASES)))
    return _drop_columns(_omit_phase_times(rows), DROPPED_COLUMNS | _TIME_COLUMNS)


def _drop_columns(rows: pa.Table, names: frozenset[str]) -> pa.Table:
    """Return the table without empty columns and those of these names."""
    selected = [name for name in rows.column_names if name not in names and rows[name].null_count < len(rows)]
    return rows.select(selected)


def _omit_phase_times(rows: pa.Table) -> pa.Table:
    """Return the table without the times in `solver_phases`."""
    place = rows.schema.get_field_index("solver_phases")
    if place < 0:
        return rows
    return rows.set_column(
        place, "solver_phases", pc.replace_substring_regex(rows["solver_phases"], SECONDS_PATTERN, "")
    )


_PROVENANCE_COLUMNS = (
    *("run_id", "unit_id", "commit", "cpu", "cores", "memory_gib", "operating_system", "versions", "started_at"),
    "load_average",
)


def _select_provenance(rows: pa.Table) -> list[dict[str, Any]]:
    return rows.select([name for name in _PROVENANCE_COLUMNS if name in rows.column_names]).to_pylist()


def _count_requested_runs(config: Path) -> int:
    """Count the runs that a sweep requests; fewer are published if software is missing."""
    return len(load_config(config, imports_code=False).list_runs())


def _describe_command(tables: Mapping[str, pa.Table], config: Path) -> str:
    if "measurements" in tables:
        return f"measurements of {config.parent.name}/{config.name}"
    command = next(name for table, name in _COMMANDS.items() if table in tables)
    return f"springbench {command} {config.parent.name}/{config.name}"


_COMMANDS = {"accuracy": "accuracy", "ablation": "ablate", "rows": "run"}


def _measure_duration(rows: Sequence[Mapping[str, Any]]) -> float:
    """Return the wall time of the study [s].

    The time of a repetition is predicted from it. It is the sum of the times between successive starts of runs. Longer
    pauses than MAX_PAUSE count as interruptions.
    """
    starts = sorted({datetime.fromisoformat(row["started_at"]) for row in rows if row.get("started_at")})
    pauses = ((later - earlier).total_seconds() for earlier, later in pairwise(starts))
    return sum(min(pause, MAX_PAUSE) for pause in pauses)
