# pyright: reportUnknownMemberType=false
# Matplotlib's stubs do not type most keywords.
"""Drawing of panels in their frames: curves, cells, pictures.

Sizes are in points of the printed figure.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.transforms import ScaledTranslation
from springbench.harness.report.charts.figure_panels import (
    AxisScale,
    CellMap,
    CurvePlot,
    CurveSeries,
    FloatArray,
    MeshPicture,
    ShadedBand,
)
from springbench.harness.report.figures.axis_scales import bar_base, frame_size_points, set_axis_scales
from springbench.harness.report.figures.figure_options import MIN_FONT_SIZE, FigureOptions
from springbench.harness.report.plot_style import (
    MUTED_COLOUR,
    RULE_COLOUR,
    TEXT_COLOUR,
    SeriesStyle,
    contrasting_text_colour,
)

_LINE_WIDTH, _MARKER_SIZE, _MAX_MARKERS = 1.1, 3.6, 12
"""Width of curves and size of markers [points]; curves of at most this many points get a marker at each."""
_MARKER_SCALES: dict[Any, float] = {"*": 1.8, "P": 1.35, "X": 1.35, "p": 1.2, "h": 1.15, "d": 1.2}
"""Factors that make all markers appear equally large."""
_MAX_LEVEL_LETTERS = 3
"""Names of a map's columns with more letters than this are rotated."""
_DOT_INSET = 2.2
"""Distance from a cell's corner to the dot in it [points]."""
RASTER_DPI = 300
"""Resolution of images in vector formats [dots per inch]."""


def draw_curve_plot(ax: Axes, panel: CurvePlot, options: FigureOptions, panels: Sequence[CurvePlot]) -> None:
    """Draw curves with their intervals, shaded bands and lines at marked values.

    Args:
        ax: axes.
        panel: panel to draw.
        options: options of the figure.
        panels: all panels of the figure.
    """
    set_axis_scales(ax, panel, panels)
    directions: list[tuple[Sequence[ShadedBand], tuple[float, float], Callable[..., object]]] = [
        (panel.bands, ax.get_ylim(), ax.axhspan),
        (panel.x_bands, ax.get_xlim(), ax.axvspan),
    ]
    for bands, limits, shade in directions:
        for band in bands:
            low, high = max(band.low, limits[0]), min(band.high, limits[1])
            if low < high:
                shade(low, high, color=RULE_COLOUR, alpha=0.7, linewidth=0, zorder=0.5)
    _draw_marked_values(ax, panel, options)
    if panel.x.division == "linear" and ax.get_xlim()[0] < 0.0 < ax.get_xlim()[1]:
        ax.axvline(0.0, color=MUTED_COLOUR, linewidth=0.5, zorder=1)
    for series in panel.series:
        if series.is_bar:
            _draw_bars(ax, series, panel.x, options)
            continue
        _draw_curve(ax, series, options)
        if series.has_cross:
            _draw_cross(ax, series, options)
    ax.grid(axis="x" if panel.y.division == "names" else "y", linewidth=0.4)
    ax.set_axisbelow(True)
    ax.set_xlabel(panel.x.label, loc="left", fontsize=options.small_font_size, labelpad=2)


def _draw_marked_values(ax: Axes, panel: CurvePlot, options: FigureOptions) -> None:
    """Draw dashed lines at marked values, with labels at the right or at the top.

    The labels of x values are above the frame if rows have names, otherwise inside it and rotated.
    """
    line: Any = {"color": MUTED_COLOUR, "linewidth": 0.6, "linestyle": (0, (4, 2.5)), "zorder": 1}
    words: Any = {"textcoords": "offset points", "fontsize": options.small_font_size, "color": MUTED_COLOUR}
    for marked in panel.lines:
        ax.axhline(marked.value, **line)
        at: Any = {"xy": (1.0, marked.value), "xycoords": ("axes fraction", "data")}
        ax.annotate(marked.label, **at, xytext=(-1, 2), ha="right", **words)
    for marked in panel.x_lines:
        ax.axvline(marked.value, **line | {"zorder": 2.5})
        at = {"xy": (marked.value, 1.0), "xycoords": ("data", "axes fraction")}
        if panel.y.division == "names":
            at |= {"xytext": (0, 1), "va": "bottom", "ha": "center", "annotation_clip": False}
        else:
            at |= {"xytext": (2, -1), "va": "top", "rotation": 90}
        ax.annotate(marked.label, **at, **words)


def _draw_curve(ax: Axes, series: CurveSeries, options: FigureOptions) -> None:
    look = series.style
    how: Any = {"drawstyle": "steps-post"} if series.is_stepped else {}
    if series.lower is not None and series.upper is not None:
        _draw_interval(ax, series, series.lower, series.upper)
    if series.is_connected and len(series.x) > 1:
        width = options.mark_scale * _LINE_WIDTH
        ax.plot(series.x, series.y, color=look.color, linestyle=look.dash, linewidth=width, label=series.label, **how)
    older = np.zeros(len(series.x), bool) if series.stale is None else series.stale
    many = series.is_connected and len(series.x) > _MAX_MARKERS
    for chosen, hollow in ((~older, False), (older, True)):
        if chosen.any():
            (marks,) = ax.plot(
                series.x[chosen],
                series.y[chosen],
                linestyle="none",
                **marker_style(look, options.mark_scale * series.marker_scale, is_stale=hollow),
            )
            if series.is_stepped:
                marks.set_markevery((0.1, 0.3))  # a step is no measurement: its marks only distinguish the curves
            elif many:
                marks.set_markevery(0.14)  # distance of markers, relative to the diagonal of the frame


def _draw_bars(ax: Axes, series: CurveSeries, scale: AxisScale, options: FigureOptions) -> None:
    """Draw horizontal bars with their intervals and values."""
    base, color = bar_base(scale), series.style.color
    ax.barh(series.y, series.x - base, left=base, height=0.72, color=color, linewidth=0, zorder=2)
    ends = series.x
    if series.lower is not None and series.upper is not None:
        ax.hlines(series.y, series.lower, series.upper, color=TEXT_COLOUR, linewidth=1.0, zorder=3)
        ends = np.fmax(ends, series.upper)
    for x, y, value in zip(ends, series.y, series.x, strict=True):
        words = f"{100 * value:.0f} %" if scale.tick_format == "percent" else f"{value:.3g}"
        ax.annotate(
            words, (x, y), (3, 0), textcoords="offset points", va="center", fontsize=options.small_font_size,
            annotation_clip=False,
        )  # fmt: skip


def _draw_cross(ax: Axes, series: CurveSeries, options: FigureOptions) -> None:
    """Draw a cross at the end of a curve that ended early."""
    known = np.flatnonzero(np.isfinite(series.x) & np.isfinite(series.y))
    if len(known):
        at = series.x[known[-1:]], series.y[known[-1:]]
        ax.plot(*at, "x", color=series.style.color, ms=1.8 * options.mark_scale * _MARKER_SIZE, mew=1.4, zorder=4)


def marker_style(style: SeriesStyle, marker_scale: float = 1.0, *, is_stale: bool = False) -> dict[str, Any]:
    """Return the style of a solver's marker.

    Args:
        style: style of the solver.
        marker_scale: size relative to other markers.
        is_stale: whether other code measured it; such markers are hollow.
    """
    face = "white" if is_stale else style.color
    edge, width = (style.color, 0.9) if is_stale else ("white", 0.35)
    size = marker_scale * _MARKER_SIZE * _MARKER_SCALES.get(style.marker, 1.0)
    return {
        "marker": style.marker,
        "color": style.color,
        "ms": size,
        "mfc": face,
        "mec": edge,
        "mew": width,
        "zorder": 3,
    }


def _draw_interval(ax: Axes, series: CurveSeries, low: FloatArray, high: FloatArray) -> None:
    color = series.style.color
    if series.is_horizontal and series.is_connected:
        ax.fill_betweenx(series.y, low, high, color=color, alpha=0.18, linewidth=0)
    elif series.is_connected and len(series.x) > 1:
        ax.fill_between(series.x, low, high, color=color, alpha=0.18, linewidth=0)
    elif series.is_horizontal:
        ax.hlines(series.y, low, high, color=color, alpha=0.6, linewidth=1.0)
    else:
        ax.vlines(series.x, low, high, color=color, alpha=0.6, linewidth=1.0)


def legend_handle(series: CurveSeries) -> Line2D:
    """Build a curve's entry in the legend."""
    look = series.style
    line = "none" if not series.is_connected else look.dash
    return Line2D([], [], linestyle=line, linewidth=_LINE_WIDTH, label=series.label, **marker_style(look))


def draw_cell_map(ax: Axes, panel: CellMap, options: FigureOptions) -> None:
    """Draw the cells of a map with row and column names.

    Row names are at the left, column names above. Cells measured by other code have a dot in the corner, unless that
    applies to all.

    Args:
        ax: axes.
        panel: map to draw.
        options: options of the figure.
    """
    rows, columns = panel.row_names, panel.column_names
    ax.set_xlim(0, len(columns))
    ax.set_ylim(len(rows), 0)
    for spine in ax.spines.values():
        spine.set_visible(False)
    mixed = not all(cell.is_stale for cell in panel.cells)
    corner = ax.transData + ScaledTranslation(_DOT_INSET / 72.0, -_DOT_INSET / 72.0, ax.figure.dpi_scale_trans)
    for cell in panel.cells:
        x, y = columns.index(cell.column), rows.index(cell.row)
        border: Any = {"edgecolor": TEXT_COLOUR, "linewidth": 1.6} if cell.is_framed else {"linewidth": 0}
        ax.add_patch(Rectangle((x + 0.04, y + 0.06), 0.92, 0.88, facecolor=cell.color, **border))
        if cell.is_stale and mixed:
            ax.plot(x + 0.04, y + 0.06, "o", mfc="white", mec=TEXT_COLOUR, ms=2.6, mew=0.7, zorder=4, transform=corner)
    ax.set_yticks(np.arange(len(rows)) + 0.5, rows, fontsize=options.small_font_size)
    angle = 90 if max(map(len, columns)) > _MAX_LEVEL_LETTERS else 0
    ax.set_xticks(np.arange(len(columns)) + 0.5, columns, fontsize=options.small_font_size, rotation=angle)
    ax.tick_params(length=0, pad=2, labeltop=True, labelbottom=False, labelcolor=TEXT_COLOUR)
    ax.xaxis.set_label_position("top")
    ax.set_xlabel(panel.column_label, loc="left", fontsize=options.small_font_size, labelpad=2)
    ax.set_ylabel(panel.row_label, loc="top", fontsize=options.small_font_size, labelpad=2)


def write_cell_values(ax: Axes, panel: CellMap, options: FigureOptions) -> None:
    """Write the values of all cells in a font size at which the longest fits.

    No value is written if that size is too small to read.

    Args:
        ax: axes of the map, whose frame must have its final size.
        panel: map of the cells.
        options: the small font size, which is the largest that is used.
    """
    rows, columns = panel.row_names, panel.column_names
    longest = max((len(line) for cell in panel.cells for line in cell.marked_text.split("\n")), default=0)
    width, _ = frame_size_points(ax)
    size = min(options.small_font_size, 0.9 * width / len(columns) / (0.7 * max(longest, 1)))
    if longest and size >= MIN_FONT_SIZE:
        for cell in panel.cells:
            at = columns.index(cell.column) + 0.5, rows.index(cell.row) + 0.53
            ax.text(
                *at,
                cell.marked_text,
                ha="center",
                va="center",
                fontsize=size,
                color=contrasting_text_colour(cell.color),
            )


def draw_mesh_picture(ax: Axes, panel: MeshPicture, options: FigureOptions, width: float) -> None:
    """Draw the mesh, rendered at the resolution of its place in print.

    Args:
        ax: axes.
        panel: picture to draw.
        options: options of the figure.
        width: width of the place [inches].
    """
    ax.imshow(
        panel.render(round(width * RASTER_DPI), None if options.is_transparent else "white"),
        interpolation="antialiased",
    )
    ax.set_axis_off()
