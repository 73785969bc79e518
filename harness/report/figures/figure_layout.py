# pyright: reportUnknownMemberType=false
# Matplotlib's stubs do not type most keywords.
"""Composition of a figure at its width.

A figure has a title, panels, one legend below them, and notes at the foot. Nothing covers data. The height follows from
the width: each strip is as high as its text, and each frame has the height that suits its width.
"""

from __future__ import annotations

import textwrap
import warnings
from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.patches import Patch
from matplotlib.text import Text
from springbench.harness.recording.strain_scale import format_percent
from springbench.harness.report.charts.figure_panels import CellMap, CurvePlot, CurveSeries, FigurePanel, MeshPicture
from springbench.harness.report.figures.axis_scales import thin_ticks
from springbench.harness.report.figures.direct_labels import add_direct_labels
from springbench.harness.report.figures.figure_options import FigureOptions
from springbench.harness.report.figures.panel_drawing import (
    draw_cell_map,
    draw_curve_plot,
    draw_mesh_picture,
    legend_handle,
    write_cell_values,
)
from springbench.harness.report.page_layout import STRAIN_MAP, tick_formatter
from springbench.harness.report.plot_style import MUTED_COLOUR, TEXT_COLOUR

MILLIMETRES_PER_INCH = 25.4
_PANEL_WIDTH, _PICTURE_WIDTH = 58.0, 36.0
"""Preferred minimum width of a panel and of a picture [mm], at a font size of 8 points."""
_MAX_HEIGHT_RATIO = 1.5
"""Maximum total height of the rows of frames, in units of the figure's width, so that a two-column page has space."""
_FRAME_HEIGHT_OFFSET = 48.0 / MILLIMETRES_PER_INCH
"""Constant part of the height of a wide frame [inches].

A frame of aspect 1 that is wider than 85 mm is flatter: its height is 0.3 of its width plus this.
"""
_FIVE_TICK_WIDTH = 55.0
"""Width from which on a colour bar has five numbers [mm], at a font size of 8 points."""
_COLOUR_BAR_HEIGHT = 18.0
"""Height of a colour bar with its margins [points]."""
_STRIP_PADDING = 3.0
"""Padding between strips and at the border [points]."""

FIGURE_RC: Any = {
    "font.family": "DejaVu Sans",
    "pdf.fonttype": 42,
    "svg.fonttype": "path",
    "svg.hashsalt": "springbench",
    "text.color": TEXT_COLOUR,
    "axes.labelcolor": TEXT_COLOUR,
    "axes.edgecolor": MUTED_COLOUR,
    "xtick.color": MUTED_COLOUR,
    "ytick.color": MUTED_COLOUR,
    "xtick.labelcolor": TEXT_COLOUR,
    "ytick.labelcolor": TEXT_COLOUR,
    "axes.linewidth": 0.5,
    "grid.color": "#e3e1dc",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlepad": 4.0,
    "axes.facecolor": "none",
    "legend.frameon": False,
    "path.simplify": True,
}


def compose_figure(
    panels: Sequence[FigurePanel], title: str, options: FigureOptions, columns: int | None = None
) -> Figure:
    """Compose the figure of these panels.

    Args:
        panels: panels of the figure.
        title: title; the panels' subject is appended if they share one.
        options: options of the figure.
        columns: number of panels in a row; None for as many as the width allows.
    """
    rc: Any = {
        **FIGURE_RC,
        "font.size": options.font_size,
        "xtick.labelsize": options.small_font_size,
        "ytick.labelsize": options.small_font_size,
    }
    with matplotlib.rc_context(rc):
        figure = Figure(
            (options.width_mm / MILLIMETRES_PER_INCH, 4.0),
            dpi=LAYOUT_DPI,
            facecolor=options.background_colour,
            layout="constrained",
        )
        FigureCanvasAgg(figure)
        columns = columns or _choose_column_count(panels, options)
        subjects = list(dict.fromkeys(panel.subject for panel in panels))
        heads = [_panel_title_lines(panel, options, columns, several=len(subjects) > 1) for panel in panels]
        heights = _compute_row_heights(panels, heads, columns, options)
        grid = figure.add_gridspec(len(heights), columns, height_ratios=heights)
        axes = [figure.add_subplot(grid[divmod(k, columns)]) for k in range(len(panels))]
        for ax, panel, head in zip(axes, panels, heads, strict=True):
            _draw_panel(ax, panel, head, options, columns, panels)
        below = _draw_strain_scale(figure, axes, panels, options)
        direct = add_direct_labels(axes, panels, options)
        whole = ": ".join([title, subjects[0]] if len(subjects) == 1 and subjects[0] else [title])
        _draw_strips(figure, panels, whole, sum(heights) + below, options, legend=not direct)
        with warnings.catch_warnings():
            _adjust_final_labels(axes, panels, options)
        return figure


LAYOUT_DPI = 100
"""Resolution of the canvas that text is measured on; vector formats have none, and images use RASTER_DPI."""


def _choose_column_count(panels: Sequence[FigurePanel], options: FigureOptions) -> int:
    min_width = _PICTURE_WIDTH if isinstance(panels[0], MeshPicture) else _PANEL_WIDTH
    abreast = max(1, int(options.width_mm * 8.0 / options.font_size / min_width))
    rows = -(-len(panels) // abreast)
    return -(-len(panels) // rows)


def _compute_row_heights(
    panels: Sequence[FigurePanel], title_lines: Sequence[list[str]], columns: int, options: FigureOptions
) -> list[float]:
    """Compute the height of each row of panels [inches]."""
    width = options.width_mm / MILLIMETRES_PER_INCH / columns
    room = _MAX_HEIGHT_RATIO * options.width_mm / MILLIMETRES_PER_INCH / -(-len(panels) // columns)
    heights = [
        _compute_panel_height(panel, len(head), width, room, options)
        for panel, head in zip(panels, title_lines, strict=True)
    ]
    return [max(heights[k : k + columns]) for k in range(0, len(heights), columns)]


def _compute_panel_height(panel: FigurePanel, head: int, width: float, room: float, options: FigureOptions) -> float:
    line = 1.45 * options.small_font_size / 72.0
    if isinstance(panel, CellMap):
        lines = 1.0 + max(cell.marked_text.count("\n") for cell in panel.cells)
        above = 0.62 * options.small_font_size / 72.0 * max(map(len, panel.column_names))
        return line * lines * len(panel.row_names) + above + (3.0 if panel.column_label else 2.0) * line
    if isinstance(panel, MeshPicture):
        return width / panel.aspect + line * (1 + len(panel.facts))
    if panel.y.division == "names":
        return line * (1.25 * len(panel.y.place_names) + 4.0)
    return min(min(0.86 * width, 0.3 * width + _FRAME_HEIGHT_OFFSET) * panel.aspect, room) + max(3.0, head + 1.0) * line


def _panel_title_lines(panel: FigurePanel, options: FigureOptions, columns: int, *, several: bool) -> list[str]:
    """Return the title lines of a panel."""
    if isinstance(panel, MeshPicture):
        return [panel.title, *panel.facts]
    words = [panel.subject if several else "", panel.title, panel.y.label if isinstance(panel, CurvePlot) else ""]
    room = options.width_mm / columns / MILLIMETRES_PER_INCH * 72.0 - 6.0 * options.font_size
    return [line for one in words if one for line in wrap_words(one, room, options.small_font_size)]


def _draw_panel(
    ax: Axes,
    panel: FigurePanel,
    head: Sequence[str],
    options: FigureOptions,
    columns: int,
    panels: Sequence[FigurePanel],
) -> None:
    if isinstance(panel, MeshPicture):
        draw_mesh_picture(ax, panel, options, options.width_mm / MILLIMETRES_PER_INCH / columns)
        ax.set_title("\n".join(head), loc="center", fontsize=options.small_font_size, color=TEXT_COLOUR)
        return
    if isinstance(panel, CurvePlot):
        draw_curve_plot(ax, panel, options, [one for one in panels if isinstance(one, CurvePlot)])
    else:
        draw_cell_map(ax, panel, options)
    ax.set_title("\n".join(head), loc="center", x=0.0, ha="left", fontsize=options.small_font_size)


def wrap_words(words: str, room: float, size: float) -> list[str]:
    """Wrap text into lines that fit into a width.

    A letter is assumed to be 0.58 of the font size wide.

    Args:
        words: text; words longer than a line are broken.
        room: width [points].
        size: font size [points].

    Returns:
        The lines; one empty line for empty text.
    """
    return textwrap.wrap(words, max(12, int(room / (0.58 * size))), break_long_words=True) or [""]


def _draw_strain_scale(
    figure: Figure, axes: Sequence[Axes], panels: Sequence[FigurePanel], options: FigureOptions
) -> float:
    """Draw one strain scale for all pictures, which share their limit; return its height [inches]."""
    pictures = [panel for panel in panels if isinstance(panel, MeshPicture)]
    if not pictures:
        return 0.0
    limit = pictures[0].strain_limit
    low, high = (float(end([0.0, *(end(panel.strain) for panel in pictures)])) for end in (np.nanmin, np.nanmax))
    cut = {"min": low < -limit, "max": high > limit}
    extend = "both" if all(cut.values()) else next((end for end, beyond in cut.items() if beyond), "neither")
    num_ticks = 5 if options.width_mm * 8.0 / options.font_size > _FIVE_TICK_WIDTH else 3
    bar = figure.colorbar(
        ScalarMappable(Normalize(-limit, limit), STRAIN_MAP), ax=list(axes), location="bottom", shrink=0.8, aspect=45,
        extend=extend, pad=0.02, ticks=np.linspace(-limit, limit, num_ticks).tolist(),
    )  # fmt: skip
    bar.outline.set_visible(False)
    bar.ax.xaxis.set_major_formatter(
        tick_formatter(lambda e: f"{100 * e:+.3g} %".replace("-", "−") if e else "at rest")
    )
    bar.ax.tick_params(length=2.0, width=0.5, labelsize=options.small_font_size)
    ends = [format_percent(end, 2) for end, beyond in zip((low, high), cut.values(), strict=True) if beyond]
    further = f"; tips: to {' and '.join(ends)}" if ends else ""
    words = wrap_words(
        f"strain of a vertex's most strained spring{further}",
        options.width_mm / MILLIMETRES_PER_INCH * 58.0,
        options.small_font_size,
    )
    bar.set_label("\n".join(words), fontsize=options.small_font_size)
    return (1.45 * options.small_font_size * (len(words) + 1.0) + _COLOUR_BAR_HEIGHT) / 72.0


def _draw_strips(
    figure: Figure, panels: Sequence[FigurePanel], title: str, height: float, options: FigureOptions, *, legend: bool
) -> None:
    """Draw title, legend and foot, and set the figure's height.

    The argument `height` is the height of the panels [inches].
    """
    room = options.width_mm / MILLIMETRES_PER_INCH * 72.0 - 2.0 * _STRIP_PADDING
    notes = list(dict.fromkeys(note for panel in panels for note in panel.notes))
    machines = list(dict.fromkeys(panel.machine_words for panel in panels if panel.machine_words))
    foot = [
        line
        for words in notes + (machines if options.has_title else [])
        for line in wrap_words(words, room, options.small_font_size)
    ]
    head = wrap_words(title, room / 1.08, options.font_size) if options.has_title else []
    entries = _draw_legend(figure, panels, options, room) if legend else None
    pad = _STRIP_PADDING / 72.0
    tall = [
        _text_height(head, options.font_size),
        0.0 if entries is None else _artist_height(figure, entries),
        _text_height(foot, options.small_font_size),
    ]
    above, below = (tall[0] + pad if head else 0.0), sum(part + pad for part in tall[1:] if part)
    whole = height + above + below + 2.0 * pad
    figure.set_size_inches(options.width_mm / MILLIMETRES_PER_INCH, whole)
    engine: Any = figure.get_layout_engine()
    side = pad / (options.width_mm / MILLIMETRES_PER_INCH)
    frame = (side, (below + pad) / whole, 1.0 - 2.0 * side, 1.0 - (above + below + 2.0 * pad) / whole)
    engine.set(rect=frame, w_pad=0.02, h_pad=0.03, wspace=0.03, hspace=0.04)
    kind: Any = {"x": side, "linespacing": 1.25}
    if head:
        figure.text(y=1.0 - pad / whole, s="\n".join(head), va="top", fontsize=options.font_size, weight="bold", **kind)
    if entries is not None:
        entries.set_bbox_to_anchor((side, (tall[2] + pad * (2.0 if foot else 1.0)) / whole), figure.transFigure)
    if foot:
        figure.text(
            y=pad / whole, s="\n".join(foot), va="bottom", fontsize=options.small_font_size, color=MUTED_COLOUR, **kind
        )


def _text_height(lines: Sequence[str], size: float) -> float:
    """Return the height of lines of text [inches]."""
    return 1.42 * size * len(lines) / 72.0


def _draw_legend(figure: Figure, panels: Sequence[FigurePanel], options: FigureOptions, room: float) -> Legend | None:
    """Draw the legend in as many columns as fit.

    Read downwards, its order is that of the curves.
    """
    entries = _collect_legend_entries(panels)
    if not entries:
        return None
    for columns in range(min(len(entries), 6), 0, -1):
        legend = figure.legend(
            handles=entries, ncols=columns, loc="lower left", bbox_to_anchor=(0, 0), borderaxespad=0.0, borderpad=0.0,
            fontsize=options.small_font_size, handlelength=2.2, columnspacing=1.2, handletextpad=0.5, labelspacing=0.35,
        )  # fmt: skip
        legend.set_in_layout(False)
        if columns == 1 or legend.get_window_extent().width / LAYOUT_DPI * 72.0 <= room:
            return legend
        legend.remove()
    return None


def _artist_height(figure: Figure, artist: Artist) -> float:
    return artist.get_window_extent().height / figure.dpi


def _collect_legend_entries(panels: Sequence[FigurePanel]) -> list[Any]:
    grids = [panel for panel in panels if isinstance(panel, CellMap)]
    if grids:
        used = {cell.outcome for grid in grids for cell in grid.cells}
        return [Patch(color=one.color, label=one.label) for one in grids[0].outcomes if one.label in used]
    plots = [panel for panel in panels if isinstance(panel, CurvePlot) and panel.y.division != "names"]
    found: dict[str, CurveSeries] = {}
    for panel in plots:
        for series in sort_by_end_value(panel.series):
            found.setdefault(series.label, series)
    entries: list[Any] = [legend_handle(series) for series in found.values() if not series.labels_points]
    bands = dict.fromkeys(band.label for panel in plots for band in (*panel.bands, *panel.x_bands) if band.label)
    return entries + [Patch(color="#eceae6", label=words) for words in bands]


def sort_by_end_value(series: Sequence[CurveSeries]) -> list[CurveSeries]:
    """Sort series by the end values of their curves, the highest first.

    Series without a point come last.
    """

    def end(one: CurveSeries) -> float:
        known = one.y[np.isfinite(one.y) & np.isfinite(one.x)]
        return -float(known[-1]) if len(known) else np.inf

    return sorted(series, key=end)


def _adjust_final_labels(axes: Sequence[Axes], panels: Sequence[FigurePanel], options: FigureOptions) -> None:
    """Adjust what depends on the final size of the frames.

    These are tick labels, values in cells, and labels at curve ends.
    """
    figure: Any = axes[0].figure
    warnings.simplefilter("ignore", UserWarning)  # missing room is reported as a fault
    figure.draw_without_rendering()
    for ax, panel in zip(axes, panels, strict=True):
        if isinstance(panel, CurvePlot):
            thin_ticks(ax)
        elif isinstance(panel, CellMap):
            write_cell_values(ax, panel, options)
    figure.draw_without_rendering()
    for ax in axes:
        for text in ax.texts:
            settle = getattr(text, "settle", None)
            if settle is not None:
                settle()
    figure.set_layout_engine(None)


def visible_texts(figure: Figure) -> list[Text]:
    """Return all visible text objects of a figure."""
    found: list[Text] = [*figure.texts, *(text for legend in figure.legends for text in legend.get_texts())]
    for ax in figure.axes:
        found += [*ax.texts, ax.title, ax.xaxis.label, ax.yaxis.label]
        for axis in (ax.xaxis, ax.yaxis) if ax.axison else ():
            low, high = sorted(axis.get_view_interval())
            for at, label in zip(axis.get_majorticklocs(), axis.get_ticklabels(), strict=False):
                found += [label] if low - 1e-9 <= at <= high + 1e-9 else []
    return [text for text in found if text.get_visible() and text.get_text().strip()]
