"""Which rows of a folder were made by other code than today's, told from the config that the folder belongs to."""

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
    """The ids of those runs in a table of the folder's rows. None where nobody can tell: the config is gone, or it
    says something else today. Imports nothing that the config names."""
    runs = _runs(folder)
    return of_other_code(runs, table) & set(map(str, table["run_id"].unique().to_pylist()))


def older_of(folder: Path) -> Collection[str]:
    """The same of all rows of a sweep's folder."""
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
