"""Panels of sweeps and of speed reports: times against size."""

from __future__ import annotations

from collections.abc import Callable, Collection
from pathlib import Path

import pyarrow as pa
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.report.charts.chart_description import select_curve_plots
from springbench.harness.report.charts.speed_chart import build_speed_chart
from springbench.harness.report.charts.timing_chart import build_compared_timing_chart
from springbench.harness.report.figures.panel_selection import PanelEntry, entries_from_panels
from springbench.harness.report.provenance_words import PROVENANCE_COLUMNS, describe_provenance
from springbench.harness.report.speed import speed_figures
from springbench.harness.report.timing_table import read_run_times
from springbench.harness.results import parquet_rows, row_store

_REQUIRED_COLUMNS = ("run_id", "scene", "size", "solver", "phase", "status")


def read_sweep_rows(folder: Path) -> pa.Table:
    """Read the rows of a sweep.

    Raises:
        InputError: if there are none, or if they belong to a speed report.
    """
    units = row_store.list_units(folder / "rows")
    if not units:
        raise InputError(InputMistake("contains no rows of runs; expected those of `springbench run CONFIG`", folder))
    table = parquet_rows.read_rows(units, required_columns=_REQUIRED_COLUMNS)
    if speed_figures.has_machine_limits(table):
        raise InputError(InputMistake("contains rows of `springbench roofline`; draw the kind `speed`", folder))
    return table


def list_timing_panels(folder: Path, find_stale: Callable[[pa.Table], Collection[str]]) -> list[PanelEntry]:
    """Build the panels of a sweep's times, for each scene.

    Args:
        folder: folder of a sweep's results.
        find_stale: returns the ids of stale runs in a table of rows.
    """
    table = read_sweep_rows(folder)
    words = describe_provenance(table.select(PROVENANCE_COLUMNS).to_pylist())
    chart = build_compared_timing_chart(read_run_times(table), find_stale(table), machine_words=words)
    return entries_from_panels(select_curve_plots(chart))


def list_speed_panels(folder: Path) -> list[PanelEntry]:
    """Build the panels of a speed report."""
    units = row_store.list_units(folder / "rows")
    table = parquet_rows.read_rows(units, required_columns=_REQUIRED_COLUMNS) if units else None
    if table is None or not speed_figures.has_machine_limits(table):
        raise InputError(
            InputMistake("contains no speed report; expected the rows of `springbench roofline CONFIG`", folder)
        )
    return entries_from_panels(select_curve_plots(build_speed_chart(speed_figures.compute_speed_figures(table))))
