"""Publish what a script measures, as a study of the published set."""

from __future__ import annotations

import json
import os
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
from springbench.harness.console import print_message
from springbench.harness.experiments.archive.study_publication import (
    summarise_provenance,
    write_published_table,
    write_study_file,
)
from springbench.harness.experiments.provenance import build_provenance_columns
from springbench.harness.results.published_set import STUDY_FILE, TABLE_FILES, compute_file_digest


def describe_provenance() -> dict[str, Any]:
    """Describe machine, commit, date and load of this moment; a script calls it when it begins."""
    return build_provenance_columns() | {"load_average": os.getloadavg()[0]}


def describe_command() -> str:
    """Describe the command of this process, without the files that it writes."""
    module, arguments = sys.modules["__main__"].__spec__, sys.argv[1:]
    for option in ("--publish", "--save"):
        if option in arguments:
            at = arguments.index(option)
            del arguments[at : at + 2]
    return shlex.join(["python", "-m", module.name if module else Path(sys.argv[0]).stem, *arguments])


def publish_tables(
    folder: Path,
    config: Path,
    command: str,
    tables: Mapping[str, pa.Table],
    moments: Sequence[Mapping[str, Any]],
    *,
    is_timed: bool = True,
    has_earlier_rows: bool = False,
) -> None:
    """Write tables and what made them as a published study.

    Args:
        folder: folder of the study; its name is that of the view in templates of pages.
        config: config or scene that was measured.
        command: command that repeats the study.
        tables: tables by their names in TABLE_FILES.
        moments: values of `describe_provenance`, of which the first and the last give dates and load.
        is_timed: whether times are among the results.
        has_earlier_rows: whether the tables include rows that were published before, by other code or machines.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name, table in tables.items():
        write_published_table(folder / TABLE_FILES[name], table)
    metadata = {
        "config": os.path.relpath(config.resolve(), folder.resolve()),
        "config_digest": compute_file_digest(config),
        "command": command,
        "is_timed": is_timed,
        **summarise_provenance(moments),
        "runs": max(map(len, tables.values())),
    }
    if has_earlier_rows:
        metadata = add_provenance(json.loads((folder / STUDY_FILE).read_text()), metadata)
    write_study_file(folder, metadata)
    print_message(f"published in {folder}")


def add_provenance(earlier: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, Any]:
    """Return new metadata of a study with the machines, commits, dates and loads of earlier ones added."""
    united = {
        name: [*earlier[name], *(one for one in new[name] if one not in earlier[name])]
        for name in ("commits", "machines")
    }
    extremes = {
        name: [min(values), max(values)]
        for name in ("started", "load_average")
        if (values := [*earlier[name], *new[name]])
    }
    return {**new, **united, **extremes}


def publish_rows(
    folder: Path | None,
    config: Path,
    rows: Sequence[Mapping[str, Any]],
    begin: Mapping[str, Any],
    *,
    is_timed: bool = True,
) -> None:
    """Write rows of measurements as a published study, or nothing without a folder.

    Args:
        folder: folder of the study, or None.
        config: config or scene that was measured.
        rows: one mapping for each measurement; a column that a row lacks is empty in it.
        begin: value of `describe_provenance` when the script began.
        is_timed: whether times are among the results.
    """
    if folder:
        names = dict.fromkeys(name for row in rows for name in row)
        tables = {"measurements": pa.table({name: [row.get(name) for row in rows] for name in names})}
        publish_tables(folder, config, describe_command(), tables, [begin, describe_provenance()], is_timed=is_timed)
