"""Sheets of charts: all frames of what was measured on one page, as the reports of `springbench accuracy` show them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from springbench.harness.report.charts.chart_description import ChartDescription, ChartFrame, select_curve_plots
from springbench.harness.report.charts.figure_panels import CurvePlot
from springbench.harness.report.figures.figure_files import write_images
from springbench.harness.report.figures.figure_layout import MILLIMETRES_PER_INCH, compose_figure
from springbench.harness.report.figures.figure_options import FigureOptions
from springbench.harness.report.plot_style import PAGE_DPI, PAGE_WIDTH

SHEET_OPTIONS = FigureOptions(
    width_mm=PAGE_WIDTH / PAGE_DPI * MILLIMETRES_PER_INCH, formats=("png", "svg"), font_size=10.0
)


def draw_chart_sheets(chart: ChartDescription, stem: Path) -> list[Path]:
    """Draw the sheets of a chart as PNG and SVG, and return the files.

    Args:
        chart: the chart.
        stem: path of the chart's own sheet without suffix; a folder for the other sheets.
    """
    paths: list[Path] = []
    for sheet in dict.fromkeys(frame.sheet for frame in chart.frames):
        frames = [frame for frame in chart.frames if frame.sheet == sheet]
        panels, columns = _arrange_plots(chart, frames)
        if panels:
            figure = compose_figure(panels, chart.title, SHEET_OPTIONS, columns)
            target = stem / sheet if sheet else stem
            paths += write_images(figure, target, chart.title, chart.machine_words, SHEET_OPTIONS, PAGE_DPI)
    return paths


def _arrange_plots(chart: ChartDescription, frames: Sequence[ChartFrame]) -> tuple[list[CurvePlot], int | None]:
    """Return the plots by rows, and the number of columns; None if it is free.

    Quantities of y are in rows if x has several too, otherwise in columns.
    """
    shown = [axis for axis in chart.y if axis.is_on_sheets]
    if len(shown) == 1:
        return [*select_curve_plots(chart, frames, shown)], None
    if len(chart.x) == 1:
        return [*select_curve_plots(chart, frames, shown)], len(shown)
    rows = [[plot for frame in frames for plot in select_curve_plots(chart, [frame], [axis])] for axis in shown]
    return [plot for row in rows for plot in row], max(map(len, rows))
