# pyright: reportUnknownMemberType=false
# Matplotlib's stubs do not type most keywords.
"""Drawing of panels in their frames: curves, cells, pictures.

Sizes are in points of the printed figure.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.transforms import ScaledTranslation

from harness.report.accuracy.sheet import size as enlarged
from harness.report.figures.asked import Asked
from harness.report.figures.panel import CellMap, Picture, Plot, Series, Values
from harness.report.figures.scales import in_points, set_scales
from harness.report.style import INK, MUTED, RULE, Mark

_LINE, _MARKER, _FEW = 1.1, 3.6, 12
"""Width of curves and size of markers [points]; curves of at most this many points get a marker at each."""
_INSET = 2.2
"""Distance from a cell's corner to the dot in it [points]."""
DOTS = 300
"""Resolution of images in vector formats [dots per inch]."""


def draw_plot(ax: Axes, panel: Plot, asked: Asked) -> None:
    """Draw curves with their intervals, shaded bands and lines at marked values.

    Args:
        ax: axes.
        panel: panel to draw.
        asked: options of the figure.
    """
    set_scales(ax, panel)
    for band in panel.bands:
        low, high = max(band.low, ax.get_ylim()[0]), min(band.high, ax.get_ylim()[1])
        if low < high:
            ax.axhspan(low, high, color=RULE, alpha=0.7, linewidth=0, zorder=0.5)
    for marked in panel.lines:
        ax.axhline(marked.y, color=MUTED, linewidth=0.6, linestyle=(0, (4, 2.5)), zorder=1)
        place: Any = {"xycoords": ("axes fraction", "data"), "xytext": (-1, 2), "textcoords": "offset points"}
        ax.annotate(marked.words, (1.0, marked.y), ha="right", fontsize=asked.small, color=MUTED, **place)
    if panel.x.kind == "linear" and ax.get_xlim()[0] < 0.0 < ax.get_xlim()[1]:
        ax.axvline(0.0, color=MUTED, linewidth=0.5, zorder=1)
    for series in panel.series:
        _curve(ax, series)
    ax.grid(axis="x" if panel.y.kind == "names" else "y", linewidth=0.4)
    ax.set_axisbelow(True)
    ax.set_xlabel(panel.x.words, loc="left", fontsize=asked.small, labelpad=2)


def _curve(ax: Axes, series: Series) -> None:
    look = series.look
    how: Any = {"drawstyle": "steps-post"} if series.steps else {}
    if series.low is not None and series.high is not None:
        _interval(ax, series, series.low, series.high)
    if series.joined and len(series.x) > 1:
        ax.plot(series.x, series.y, color=look.color, linestyle=look.dash, linewidth=_LINE, label=series.label, **how)
    older = np.zeros(len(series.x), bool) if series.older is None else series.older
    many = series.joined and len(series.x) > _FEW
    for chosen, hollow in ((~older, False), (older, True)):
        if chosen.any():
            (marks,) = ax.plot(
                series.x[chosen], series.y[chosen], linestyle="none", **mark(look, series.grown, hollow=hollow)
            )
            if series.steps:
                marks.set_markevery((0.1, 0.3))  # a step is no measurement: marks but tell the curves apart
            elif many:
                marks.set_markevery(0.14)


def mark(look: Mark, grown: float = 1.0, *, hollow: bool = False) -> dict[str, Any]:
    """Return the style of a solver's marker.

    Args:
        look: style of the solver.
        grown: size relative to other markers.
        hollow: whether other code measured it; such markers are hollow.
    """
    face = "white" if hollow else look.color
    edge, width = (look.color, 0.9) if hollow else ("white", 0.35)
    size = grown * _MARKER * enlarged(look)
    return {"marker": look.marker, "color": look.color, "ms": size, "mfc": face, "mec": edge, "mew": width, "zorder": 3}


def _interval(ax: Axes, series: Series, low: Values, high: Values) -> None:
    color = series.look.color
    if series.across and series.joined:
        ax.fill_betweenx(series.y, low, high, color=color, alpha=0.18, linewidth=0)
    elif series.joined and len(series.x) > 1:
        ax.fill_between(series.x, low, high, color=color, alpha=0.18, linewidth=0)
    elif series.across:
        ax.hlines(series.y, low, high, color=color, alpha=0.6, linewidth=1.0)
    else:
        ax.vlines(series.x, low, high, color=color, alpha=0.6, linewidth=1.0)


def handle(series: Series) -> Line2D:
    """Build a curve's entry in the legend."""
    look = series.look
    line = "none" if not series.joined else look.dash
    return Line2D([], [], linestyle=line, linewidth=_LINE, label=series.label, **mark(look))


def draw_grid(ax: Axes, panel: CellMap, asked: Asked) -> None:
    """Draw the cells of a map with row and column names.

    Row names are at the left, column names above. Cells measured by other code have a dot in the corner, unless that
    holds for all.

    Args:
        ax: axes.
        panel: map to draw.
        asked: options of the figure.
    """
    rows, columns = names(panel)
    ax.set_xlim(0, len(columns))
    ax.set_ylim(len(rows), 0)
    for spine in ax.spines.values():
        spine.set_visible(False)
    mixed = not all(cell.older for cell in panel.cells)
    corner = ax.transData + ScaledTranslation(_INSET / 72.0, -_INSET / 72.0, ax.figure.dpi_scale_trans)
    for cell in panel.cells:
        x, y = columns.index(cell.column), rows.index(cell.row)
        ax.add_patch(Rectangle((x + 0.04, y + 0.06), 0.92, 0.88, facecolor=cell.color, linewidth=0))
        if cell.older and mixed:
            ax.plot(x + 0.04, y + 0.06, "o", mfc="white", mec=INK, ms=2.6, mew=0.7, zorder=4, transform=corner)
    ax.set_yticks(np.arange(len(rows)) + 0.5, rows, fontsize=asked.small)
    ax.set_xticks(np.arange(len(columns)) + 0.5, columns, fontsize=asked.small, rotation=90)
    ax.tick_params(length=0, pad=2, labeltop=True, labelbottom=False, labelcolor=INK)


def write_cells(ax: Axes, panel: CellMap, asked: Asked) -> None:
    """Write the values of all cells if the longest one fits.

    The frame must have its final size.
    """
    rows, columns = names(panel)
    longest = max((len(cell.figure) for cell in panel.cells), default=0)
    width, _ = in_points(ax)
    if longest and longest * 0.64 * asked.small < 0.9 * width / len(columns):
        for cell in panel.cells:
            at = columns.index(cell.column) + 0.5, rows.index(cell.row) + 0.53
            ax.text(*at, cell.figure, ha="center", va="center", fontsize=asked.small, color=ink_on(cell.color))


def names(panel: CellMap) -> tuple[list[str], list[str]]:
    """Return the names of rows and of columns, in their order."""
    return list(dict.fromkeys(c.row for c in panel.cells)), list(dict.fromkeys(c.column for c in panel.cells))


def ink_on(color: str) -> str:
    """Return a text colour that is readable on the given colour."""
    red, green, blue = to_rgb(color)
    return INK if 0.3 * red + 0.6 * green + 0.1 * blue > 0.47 else "white"


def draw_picture(ax: Axes, panel: Picture, asked: Asked, width: float) -> None:
    """Draw the mesh, rendered at the resolution of its place in print.

    Args:
        ax: axes.
        panel: picture to draw.
        asked: options of the figure.
        width: width of the place [inches].
    """
    ax.imshow(panel.render(round(width * DOTS), None if asked.transparent else "white"), interpolation="antialiased")
    ax.set_axis_off()
