"""Panels of stored benchmark results by commit."""

from __future__ import annotations

from pathlib import Path

from springbench.harness.report.change_detection import MIN_RESULTS, find_stored_files, read_histories
from springbench.harness.report.charts.benchmark_chart import RATIO_CHART, TIME_CHART, build_benchmark_chart
from springbench.harness.report.charts.chart_description import select_curve_plots
from springbench.harness.report.figures.panel_selection import PanelEntry, entries_from_panels

REQUIRED_RESULTS = (
    f"{MIN_RESULTS} stored results of a benchmark, by `pytest tests/bench --benchmark-only` at as many commits"
)


def benchmark_panels(folder: Path) -> list[PanelEntry]:
    """Build a panel for each benchmark with enough results, the largest change first."""
    known = [one for one in read_histories(find_stored_files([folder])) if len(one.points) >= MIN_RESULTS]
    charts = (build_benchmark_chart(RATIO_CHART if one.is_ratio else TIME_CHART, [one]) for one in known)
    return entries_from_panels(plot for chart in charts for plot in select_curve_plots(chart))
