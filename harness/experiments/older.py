"""Find stale results: rows of a folder that other source code produced.

The folder's config determines the current source code.
"""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import pyarrow as pa

from harness.base import rows, shelf
from harness.base.claim import NAME
from harness.base.errors import SpringbenchError
from harness.config.load import load_any
from harness.config.sweep import RunSpec
from harness.experiments.plan import NEEDED, of_other_code


def older_runs(folder: Path, table: pa.Table) -> Collection[str]:
    """Return the ids of stale runs in a table of the folder's rows.

    The result is empty where the config is missing or has changed. Plug-ins of the config are not imported.

    Args:
        folder: folder of a sweep.
        table: rows of that folder.
    """
    runs = _runs(folder)
    return of_other_code(runs, table) & set(map(str, table["run_id"].unique().to_pylist()))


def older_of(folder: Path) -> Collection[str]:
    """Return the ids of all stale runs in the folder of a sweep."""
    table = rows.read(shelf.units(folder / "rows"), needed=NEEDED, left_out=lambda mistake: None)
    return older_runs(folder, table)


def _runs(folder: Path) -> list[RunSpec]:
    note = folder / NAME
    if not note.is_file():
        return []
    said = note.read_text(errors="replace").strip()[:4096]
    config = folder / said
    if not said or "\0" in said or not config.is_file():
        return []
    try:
        return load_any(config, opens=False).runs()
    except SpringbenchError:
        return []
