"""Sheet of a sweep's step and preparation times by number of vertices, for each scene."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
from springbench.harness.report.charts.timing_chart import build_timing_chart
from springbench.harness.report.figures.chart_sheets import draw_chart_sheets
from springbench.harness.report.provenance_words import PROVENANCE_COLUMNS, describe_provenance
from springbench.harness.report.timing_table import read_run_times

_MAX_SCENES = 24
"""Maximum number of scenes on a sheet; each takes a quarter of a second to draw."""


def write_timing_plot(rows: pa.Table, folder: Path) -> list[Path]:
    """Write the timing plot of a sweep; a report that a sweep can name.

    Args:
        rows: rows of the sweep.
        folder: folder that the files are written to.

    Returns:
        The paths of the pictures.
    """
    return draw_timing_plot(rows, folder / "timing.png", folder.name)


def draw_timing_plot(
    table: pa.Table, path: Path, title: str, stale_ids: Collection[str] = (), sources: str = ""
) -> list[Path]:
    """Draw the times of a sweep's runs as PNG and SVG, and return the files.

    If no run succeeded, nothing is drawn, and an earlier picture is deleted.

    Args:
        table: rows (schema: `springbench.harness.results.run_schema.RUN_SCHEMA`).
        path: file of the PNG; that of the SVG is next to it.
        title: name of the sweep.
        stale_ids: ids of runs that were executed by other code than the current version; their marks are hollow.
        sources: digest of the runs and the title, stored in the file (`springbench.harness.report.picture_sources`).
    """
    words = describe_provenance(table.select(PROVENANCE_COLUMNS).to_pylist())
    chart = build_timing_chart(read_run_times(table), stale_ids, machine_words=words)
    part = f", the first {_MAX_SCENES} of {len(chart.frames)} scenes" if len(chart.frames) > _MAX_SCENES else ""
    chart = replace(chart, title=f"Time by size, {title}{part}", frames=chart.frames[:_MAX_SCENES])
    return draw_chart_sheets(chart, path.with_suffix(""), sources)
