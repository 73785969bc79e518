"""The reports that a sweep names, shipped ones and somebody's own: each is told the rows and writes its files."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Protocol

import pyarrow as pa

from harness.base.errors import RunFailed, SpringbenchError
from harness.config.sweep import EVERY_REPORT
from solvers.plugins import load


class Report(Protocol):
    """A report: a function."""

    def __call__(self, rows: pa.Table, folder: Path) -> Iterable[Path]:
        """Write files into the folder of a sweep's results, from all of its rows, and tell which."""
        ...


def draw_reports(names: Iterable[str], table: pa.Table, folder: Path) -> list[Path]:
    """The files that the named reports wrote. Raises RunFailed where one fails."""
    drawn: list[Path] = []
    for name in names:
        report: Report = load(EVERY_REPORT[name])
        try:
            drawn += report(table, folder)
        except (SpringbenchError, OSError):
            raise
        except Exception as error:  # a report may be somebody's own
            raise RunFailed(f"the report {name} failed: {type(error).__name__}: {error}") from error
    return drawn
