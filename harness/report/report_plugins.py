"""Reports that a sweep names: built-in ones and plug-ins.

Each receives the rows and writes its files.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Protocol

import pyarrow as pa
from springbench.harness.config.sweep_config import REPORT_TABLE
from springbench.harness.errors import RunFailed, SpringbenchError
from springbench.harness.execution.isolated_worker import IsolatedWorker, TaskFailure
from springbench.harness.execution.progress_events import ignore_progress
from springbench.harness.execution.worker_process import ProgressCallback, TaskLimits
from springbench.solvers.plugins.plugin_discovery import PluginName, load_target

_TIME_LIMIT, _MEMORY_LIMIT = 600.0, 2.0
"""Limits of a plug-in report: wall time [s] and memory [GiB]."""


class ReportFunction(Protocol):
    """A report: a function that writes files.

    An installed report with a function `panels(rows)`, which returns a list of `FigurePanel`, is also a kind of
    `springbench figure`.

    Example:
        >>> def count_rows(rows, folder):
        ...     path = folder / "count.txt"
        ...     path.write_text(f"{rows.num_rows} rows")
        ...     return [path]

        >>> import pyarrow as pa
        >>> report: springbench.ReportFunction = count_rows
        >>> [path.name for path in report(pa.table({"size": [4, 8]}), Path("."))]
        ['count.txt']
    """

    def __call__(self, rows: pa.Table, folder: Path) -> Iterable[Path]:
        """Write files into the folder of a sweep's results, and return their paths.

        Args:
            rows: rows of the sweep.
            folder: folder of its results.
        """
        ...


def run_reports(names: Iterable[str], table: pa.Table, folder: Path, seconds: float | None = None) -> list[Path]:
    """Run the named reports and return the files that they wrote.

    Plug-in reports run in a process of their own.

    Args:
        names: names of built-in reports, or plug-ins.
        table: rows of the sweep.
        folder: folder of the sweep's results.
        seconds: time limit of a plug-in [s]; None for the default of 600 s, which is also the maximum.

    Raises:
        RunFailed: if a report fails.
    """
    drawn: list[Path] = []
    for name in names:
        if isinstance(name, PluginName):
            drawn += _run_in_worker(name, table, folder, seconds)
        else:
            report: ReportFunction = load_target(REPORT_TABLE[name])
            drawn += report(table, folder)
    return drawn


def _run_in_worker(name: PluginName, table: pa.Table, folder: Path, seconds: float | None) -> list[Path]:
    worker = IsolatedWorker()
    try:
        limits = TaskLimits(min(_TIME_LIMIT, seconds or _TIME_LIMIT), _MEMORY_LIMIT, folder / "logs" / "reports.txt")
        return worker.run_task(partial(_run_plugin_report, name, table, folder.absolute()), ignore_progress, limits)
    except (TaskFailure, SpringbenchError) as error:
        raise RunFailed(f"the report {name} failed: {error}") from None
    finally:
        worker.stop_worker()


def _run_plugin_report(name: PluginName, table: pa.Table, folder: Path, tick: ProgressCallback) -> list[Path]:
    report: ReportFunction = load_target(name.import_target)
    wrote: object = report(table, folder)
    paths: list[object] = list(wrote) if isinstance(wrote, list | tuple) else [None]  # pyright: ignore[reportUnknownArgumentType]
    if not all(isinstance(path, Path | str) for path in paths):
        raise RunFailed(f"it returned a {type(wrote).__name__}; expected a list of the files that it wrote")
    return [Path(str(path)) for path in paths]
