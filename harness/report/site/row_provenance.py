"""Provenance of rows for the results page: code, machine and scene files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pyarrow as pa
from springbench.harness.report.table_queries import query_table
from springbench.harness.results.folder_ownership import find_config, read_owner

_MACHINE_COLUMNS = ("machine_id", "cpu", "cores", "memory_gib", "operating_system", "commit")

_PROVENANCE_QUERY = f"""
select {", ".join(f'"{name}"' for name in _MACHINE_COLUMNS)},
    list(distinct source_fingerprint order by source_fingerprint),
    min(started_at), max(started_at), count(distinct {{unit}})
from rows_of where machine_id is not null group by all order by max(started_at) desc
"""


def collect_provenance(table: pa.Table, unit: str) -> list[dict[str, Any]]:
    """Collect machines and commits of rows, the newest first.

    Args:
        table: rows.
        unit: column whose distinct values are counted.
    """
    lacking = [
        name for name in (*_MACHINE_COLUMNS, "source_fingerprint", "started_at", unit) if name not in table.column_names
    ]
    for name in lacking:
        table = table.append_column(name, pa.nulls(len(table), pa.string()))
    names = (*_MACHINE_COLUMNS, "source_fingerprints", "first_started_at", "last_started_at", "count")
    return [dict(zip(names, row, strict=True)) for row in query_table(_PROVENANCE_QUERY.format(unit=unit), table)]


def find_newest_fingerprint(table: pa.Table) -> str:
    """Return the fingerprint of the newest row's code; "" if it is unknown."""
    dated = zip(*(table[name].to_pylist() for name in ("started_at", "source_fingerprint")), strict=True)
    return max(((started or "", code or "") for started, code in dated), default=("", ""))[1]


def find_scene_files(folder: Path) -> dict[str, str]:
    """Find the scene files that a sweep's config lists, by scene name.

    Paths are relative to the same folder as that of the config.
    """
    from springbench.harness.schema.yaml_loader import read_yaml

    owner = read_owner(folder)
    if owner is None:
        return {}
    called, data = find_config(folder), read_yaml(owner).data
    if "mesh" in data:
        return {Path(called).stem: called}
    listed = [str(scene) for scene in data.get("scenes") or ()]
    return {Path(scene).stem: (Path(called).parent / scene).as_posix() for scene in listed}
