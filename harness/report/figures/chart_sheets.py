"""Sheets of charts: all frames with the same sheet name on one page.

The reports of `springbench accuracy` consist of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from springbench.harness.report.charts.chart_description import ChartDescription, ChartFrame, select_curve_plots
from springbench.harness.report.charts.figure_panels import CurvePlot, FigurePanel, merge_cell_maps
from springbench.harness.report.figures.figure_files import write_images
from springbench.harness.report.figures.figure_layout import MILLIMETRES_PER_INCH, compose_figure
from springbench.harness.report.figures.figure_options import FigureOptions
from springbench.harness.report.plot_style import PAGE_DPI, PAGE_WIDTH

SHEET_OPTIONS = FigureOptions(
    width_mm=PAGE_WIDTH / PAGE_DPI * MILLIMETRES_PER_INCH, formats=("png", "svg"), font_size=10.0
)

_MAX_WHOLE_FRAMES = 4
"""Maximum number of frames of a sheet that shows all quantities of each."""
_MAX_NOTES = 12
"""Maximum number of notes at the foot of a sheet."""
_MAX_LONE_COLUMNS = 4
"""Maximum number of plots of a single frame in one row."""


def draw_chart_sheets(chart: ChartDescription, stem: Path, sources: str = "") -> list[Path]:
    """Draw the sheets of a chart as PNG and SVG, and return the files.

    Its maps are on its own sheet, one below the other. If the chart has no panels, its earlier sheet is deleted.

    Args:
        chart: the chart.
        stem: path of the chart's own sheet without suffix; a folder for the other sheets.
        sources: digest of the data, stored in the PNG (`springbench.harness.report.picture_sources`).
    """
    paths: list[Path] = []
    maps = merge_cell_maps(chart.maps)
    sheets = [*(frame.sheet for frame in chart.frames), *([""] if maps else [])]
    for sheet in dict.fromkeys(sheets):
        frames = [frame for frame in chart.frames if frame.sheet == sheet]
        plots, columns = _arrange_plots(chart, frames)
        panels: list[FigurePanel] = [*plots, *([] if sheet else maps)]
        if maps and not sheet:
            columns = 1 if plots else None
        if panels:
            figure = compose_figure(_shorten_notes(panels), chart.title, SHEET_OPTIONS, columns)
            target = stem / sheet if sheet else stem
            paths += write_images(figure, target, chart.title, chart.machine_words, SHEET_OPTIONS, PAGE_DPI, sources)
    if not paths:  # the sheet of earlier rows would mislead
        for kind in SHEET_OPTIONS.formats:
            stem.with_name(f"{stem.name}.{kind}").unlink(missing_ok=True)
    return paths


def _shorten_notes(panels: Sequence[FigurePanel]) -> list[FigurePanel]:
    """Reduce the notes to _MAX_NOTES; the last one then states the number of omitted ones."""
    notes = list(dict.fromkeys(note for panel in panels for note in panel.notes))
    if len(notes) <= _MAX_NOTES:
        return [*panels]
    shown = {*notes[: _MAX_NOTES - 1]}
    rest = f"{len(notes) - len(shown)} more notes are on the results page."
    shortened = [replace(panel, notes=[note for note in panel.notes if note in shown]) for panel in panels]
    return [*shortened[:-1], replace(shortened[-1], notes=[*shortened[-1].notes, rest])]


def _arrange_plots(chart: ChartDescription, frames: Sequence[ChartFrame]) -> tuple[list[CurvePlot], int | None]:
    """Return the plots by rows, and the number of columns; None if it is free.

    Quantities of y are in rows if x has several too, otherwise in columns. If there are many frames, only the first
    quantity of y is shown.
    """
    shown = [axis for axis in chart.y if axis.is_on_sheets]
    if len(shown) == 1 or len(frames) > _MAX_WHOLE_FRAMES:
        return [*select_curve_plots(chart, frames, shown[:1])], None
    if len(chart.x) == 1:
        rows = [[*select_curve_plots(chart, [frame], shown)] for frame in frames]
        plots, counts = [plot for row in rows for plot in row], {len(row) for row in rows if row}
        if len(counts) != 1:  # a quantity is missing somewhere
            return plots, None
        (count,) = counts
        return plots, count if len(rows) > 1 or count <= _MAX_LONE_COLUMNS else 3
    rows = [[plot for frame in frames for plot in select_curve_plots(chart, [frame], [axis])] for axis in shown]
    return [plot for row in rows for plot in row], max(map(len, rows), default=None)
