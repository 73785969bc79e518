# pyright: reportUnknownMemberType=false
# PyArrow's stubs do not type most keywords.
"""Published set of results: compact tables of each study, and what made them.

`results/published/<study>/` contains one Parquet file for each table of a results folder (`TABLE_FILES`) and
`study.json`: config, command, commits, machines, versions, dates, load and checksums. `springbench publish-study`
writes all of it. The tables are packed rows (`springbench.harness.results.row_store`) without the columns that no
repetition can confirm, so `open_study_folder` presents a study as an ordinary folder of results to every report.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, cast

from springbench.harness.atomic_files import describe_cause, is_file_name
from springbench.harness.errors import InputError, InputMistake, format_allowed_names

if TYPE_CHECKING:
    import pyarrow as pa

STUDY_FILE = "study.json"
PUBLISHED_FOLDER = Path("results/published")
"""The published set of a checkout, relative to its root."""

TABLE_FILES = {
    "rows": "runs.parquet",
    "accuracy": "units.parquet",
    "ablation": "effects.parquet",
    "blocks": "blocks.parquet",
    "rates": "rates.parquet",
    "measurements": "measurements.parquet",
}
"""File of each table.

The names differ from those of packed rows, so that reports and queries over `results/` do not find them.
"""

RUN_KEYS = (
    "scene",
    "size",
    "solver",
    "parameters",
    "integrator",
    "time_step",
    "initial_guess",
    "max_iterations",
    "residual_rtol",
)
"""Columns that identify a run on any machine and in any results folder."""


QUICK_SHARE = 0.1
"""Share of the runs that `springbench reproduce --quick` and `springbench verify-archive` repeat."""


@dataclass(frozen=True, slots=True)
class PublishedStudy:
    """One study of the published set.

    Attributes:
        folder: its folder.
        metadata: content of `study.json`.
    """

    folder: Path
    metadata: dict[str, Any]

    @property
    def study_name(self) -> str:
        """Name of the study, which is that of its folder."""
        return self.folder.name

    @property
    def config_path(self) -> Path:
        """Config from which the study was made."""
        return (self.folder / str(self.metadata["config"])).resolve()

    @property
    def is_timed(self) -> bool:
        """Whether times are among the published results."""
        return bool(self.metadata["is_timed"])

    @property
    def is_repeatable(self) -> bool:
        """Whether single runs of the study can be repeated and compared."""
        return bool(self.find_table("rows") or self.find_table("accuracy"))

    def find_table(self, table: str) -> Path | None:
        """Return the file of a table, or None if the study has no such table."""
        path = self.folder / TABLE_FILES[table]
        return path if path.is_file() else None

    def read_table(self, table: str) -> pa.Table:
        """Read a table; raise InputError if the study has no such table."""
        import pyarrow.parquet as pq  # a study may be listed without it

        path = self.find_table(table)
        if path is None:
            raise InputError(InputMistake(f"has no table {TABLE_FILES[table]}; publish the study again", self.folder))
        return pq.read_table(path, partitioning=None)


def list_studies(published: Path) -> list[PublishedStudy]:
    """List the studies of a published set, sorted by name.

    Raises:
        InputError: there is no published set, or a `study.json` is damaged.
    """
    found = [read_study(path.parent) for path in sorted(published.glob(f"*/{STUDY_FILE}"))]
    if not found:
        raise InputError(
            InputMistake(
                "contains no published studies; run this in a checkout of springbench, or give its path", published
            )
        )
    return found


def find_study(published: Path, name: str) -> PublishedStudy:
    """Find a study by its name.

    Args:
        published: folder of the published set.
        name: name of the study, which is that of its folder.

    Raises:
        InputError: there is no such study or no published set, or a `study.json` is damaged.
    """
    studies = {study.study_name: study for study in list_studies(published)}
    if name not in studies:
        raise InputError(InputMistake(f"got {name!r}; expected {format_allowed_names(name, studies)}", key="STUDY"))
    return studies[name]


def read_study(folder: Path) -> PublishedStudy:
    """Read `study.json` of a folder; raise InputError if it is damaged."""
    path = folder / STUDY_FILE
    try:
        if not path.is_file():
            raise ValueError("it is no file")
        if path.stat().st_size > _MAX_STUDY_FILE_BYTES:
            raise ValueError(f"it has more than {_MAX_STUDY_FILE_BYTES:,} bytes")
        metadata = json.loads(path.read_text(encoding="utf-8"))
        if wrong := _find_wrong_key(metadata):
            raise ValueError(f"its key {wrong!r} is missing or wrong")
    except (OSError, ValueError, RecursionError) as error:
        problem = "its lists are too deep" if isinstance(error, RecursionError) else describe_cause(error)
        why = f"describes no study ({problem}); restore it, or write it again by `springbench publish-study`"
        raise InputError(InputMistake(why, path)) from None
    return PublishedStudy(folder, metadata)


_MAX_STUDY_FILE_BYTES = 2**20
_MAX_CONFIG_PATH = 1000


def _find_wrong_key(metadata: Any) -> str:
    """Return the first required key of `study.json` that is missing or has a wrong value."""
    if not isinstance(metadata, dict):
        return "config"
    keys = cast("dict[str, Any]", metadata)
    config, duration = keys.get("config"), keys.get("duration_seconds")
    files, machines = keys.get("files"), keys.get("machines")
    is_right = {
        "config": isinstance(config, str) and 0 < len(config) <= _MAX_CONFIG_PATH and "\0" not in config,
        "is_timed": isinstance(keys.get("is_timed"), bool),
        "runs": isinstance(keys.get("runs"), int),
        "duration_seconds": "duration_seconds" in keys
        and (duration is None or (isinstance(duration, int | float) and 0.0 <= duration < math.inf)),
        "command": isinstance(keys.get("command"), str),
        "machines": isinstance(machines, list)
        and machines != []
        and all(isinstance(one, dict) for one in cast("list[object]", machines)),
        "files": isinstance(files, dict)
        and all(
            is_file_name(name) and isinstance(digest, str) for name, digest in cast("dict[str, object]", files).items()
        ),
    }
    return next((key for key, right in is_right.items() if not right), "")


def compute_file_digest(path: Path) -> str:
    """Compute the SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def find_changed_tables(study: PublishedStudy) -> list[Path]:
    """Return the tables that are missing or differ from the checksums in `study.json`."""
    stated = {study.folder / name: digest for name, digest in study.metadata["files"].items()}
    there = {path for path in study.folder.iterdir() if path.suffix == ".parquet"}
    return sorted(
        path for path in there | stated.keys() if not path.is_file() or stated.get(path) != compute_file_digest(path)
    )


@contextmanager
def open_study_folder(study: PublishedStudy) -> Generator[Path]:
    """Yield a temporary folder of results with the packed rows of a study."""
    with TemporaryDirectory() as scratch:
        folder = Path(scratch) / study.study_name
        folder.mkdir()
        for table in ("rows", "accuracy", "ablation"):
            if path := study.find_table(table):
                (folder / f"{table}.parquet").symlink_to(path.resolve())
        yield folder
