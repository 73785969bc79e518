"""Find stale results: rows of a folder that other source code produced.

The folder's config determines which source files count.
"""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import pyarrow as pa
from springbench.harness.config.config_loader import load_config
from springbench.harness.config.sweep_config import RunSpec
from springbench.harness.errors import SpringbenchError
from springbench.harness.experiments.sweep_plan import REQUIRED_COLUMNS, find_stale_run_ids
from springbench.harness.results import parquet_rows, row_store
from springbench.harness.results.folder_ownership import OWNER_FILE


def find_stale_runs(folder: Path, table: pa.Table) -> Collection[str]:
    """Return the ids of stale runs in a table of the folder's rows.

    The result is empty where the config is missing or invalid, and omits runs that the config does not request.
    Plug-ins of the config are not imported.

    Args:
        folder: folder of a sweep.
        table: rows of that folder.
    """
    runs = _load_runs(folder)
    return find_stale_run_ids(runs, table) & set(map(str, table["run_id"].unique().to_pylist()))


def find_stale_runs_in_folder(folder: Path) -> Collection[str]:
    """Return the ids of all stale runs in the folder of a sweep."""
    table = parquet_rows.read_rows(
        row_store.list_units(folder / "rows"), required_columns=REQUIRED_COLUMNS, on_invalid=lambda mistake: None
    )
    return find_stale_runs(folder, table)


def _load_runs(folder: Path) -> list[RunSpec]:
    note = folder / OWNER_FILE
    if not note.is_file():
        return []
    config_path = note.read_text(errors="replace").strip()[:4096]
    config = folder / config_path
    if not config_path or "\0" in config_path or not config.is_file():
        return []
    try:
        return load_config(config, imports_code=False).list_runs()
    except SpringbenchError:
        return []
