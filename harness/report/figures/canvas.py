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

from harness.record.shading import percent
from harness.report.figures.asked import Asked
from harness.report.figures.direct import label_directly
from harness.report.figures.drawing import draw_grid, draw_picture, draw_plot, handle, names, write_cells
from harness.report.figures.panel import CellMap, Panel, Picture, Plot, Series
from harness.report.figures.scales import thin
from harness.report.page import ticks
from harness.report.style import INK, MUTED, STRAIN_MAP

INCH = 25.4
_PANEL, _PICTURE = 58.0, 36.0
"""Preferred minimum width of a panel and of a picture [mm], at a font size of 8 points."""
_COLUMN = 1.5
"""Maximum total height of the rows of frames, in units of the figure's width, so that a two-column page has space."""
_TALL = 48.0 / INCH
"""A frame wider than 85 mm becomes flatter: its height is 0.3 of its width plus this [inches]."""
_FIVE = 55.0
"""Width from which on a colour bar has five numbers [mm], at a font size of 8 points."""
_BAR = 18.0
"""Height of a colour bar with its margins [points]."""
_PAD = 3.0
"""Padding between strips and at the border [points]."""

RC: Any = {
    "font.family": "DejaVu Sans",
    "pdf.fonttype": 42,
    "svg.fonttype": "path",
    "svg.hashsalt": "springbench",
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": MUTED,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "axes.linewidth": 0.5,
    "grid.color": "#e3e1dc",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlepad": 4.0,
    "axes.facecolor": "none",
    "legend.frameon": False,
    "path.simplify": True,
}


def compose(panels: Sequence[Panel], title: str, asked: Asked) -> Figure:
    """Compose the figure of these panels.

    Args:
        panels: panels of the figure.
        title: title; the panels' subject is appended if they share one.
        asked: options of the figure.
    """
    rc: Any = {**RC, "font.size": asked.size, "xtick.labelsize": asked.small, "ytick.labelsize": asked.small}
    with matplotlib.rc_context(rc):
        figure = Figure((asked.width / INCH, 4.0), dpi=DPI, facecolor=asked.background, layout="constrained")
        FigureCanvasAgg(figure)
        columns = _columns(panels, asked)
        subjects = list(dict.fromkeys(panel.subject for panel in panels))
        heads = [_head(panel, asked, columns, several=len(subjects) > 1) for panel in panels]
        heights = _heights(panels, heads, columns, asked)
        grid = figure.add_gridspec(len(heights), columns, height_ratios=heights)
        axes = [figure.add_subplot(grid[divmod(k, columns)]) for k in range(len(panels))]
        for ax, panel, head in zip(axes, panels, heads, strict=True):
            _draw(ax, panel, head, asked, columns)
        below = _strain_scale(figure, axes, panels, asked)
        direct = label_directly(axes, panels, asked)
        whole = ": ".join([title, subjects[0]] if len(subjects) == 1 and subjects[0] else [title])
        _strips(figure, panels, whole, sum(heights) + below, asked, legend=not direct)
        with warnings.catch_warnings():
            _settle(axes, panels, asked)
        return figure


DPI = 100
"""Resolution of the canvas that text is measured on; vector formats have none, and images use DOTS."""


def _columns(panels: Sequence[Panel], asked: Asked) -> int:
    wanted = _PICTURE if isinstance(panels[0], Picture) else _PANEL
    abreast = max(1, int(asked.width * 8.0 / asked.size / wanted))
    rows = -(-len(panels) // abreast)
    return -(-len(panels) // rows)


def _heights(panels: Sequence[Panel], heads: Sequence[list[str]], columns: int, asked: Asked) -> list[float]:
    """Compute the height of each row of panels [inches]."""
    width = asked.width / INCH / columns
    room = _COLUMN * asked.width / INCH / -(-len(panels) // columns)
    wanted = [_height(panel, len(head), width, room, asked) for panel, head in zip(panels, heads, strict=True)]
    return [max(wanted[k : k + columns]) for k in range(0, len(wanted), columns)]


def _height(panel: Panel, head: int, width: float, room: float, asked: Asked) -> float:
    line = 1.45 * asked.small / 72.0
    if isinstance(panel, CellMap):
        rows, columns = names(panel)
        return line * len(rows) + 0.62 * asked.small / 72.0 * max(map(len, columns)) + 2.0 * line
    if isinstance(panel, Picture):
        return width / panel.aspect + line * (1 + len(panel.facts))
    if panel.y.kind == "names":
        return line * (1.25 * len(panel.y.names) + 4.0)
    return min(min(0.86 * width, 0.3 * width + _TALL) * panel.aspect, room) + max(3.0, head + 1.0) * line


def _head(panel: Panel, asked: Asked, columns: int, *, several: bool) -> list[str]:
    """Return the title lines of a panel."""
    if isinstance(panel, Picture):
        return [panel.title, *panel.facts]
    words = [panel.subject if several else "", panel.title, panel.y.words if isinstance(panel, Plot) else ""]
    room = asked.width / columns / INCH * 72.0 - 6.0 * asked.size
    return [line for one in words if one for line in wrapped(one, room, asked.small)]


def _draw(ax: Axes, panel: Panel, head: Sequence[str], asked: Asked, columns: int) -> None:
    if isinstance(panel, Picture):
        draw_picture(ax, panel, asked, asked.width / INCH / columns)
        ax.set_title("\n".join(head), loc="center", fontsize=asked.small, color=INK)
        return
    if isinstance(panel, Plot):
        draw_plot(ax, panel, asked)
    else:
        draw_grid(ax, panel, asked)
    ax.set_title("\n".join(head), loc="center", x=0.0, ha="left", fontsize=asked.small)


def wrapped(words: str, room: float, size: float) -> list[str]:
    """Wrap text into lines that fit into `room` [points].

    A letter is about 0.6 of the font size wide.
    """
    return textwrap.wrap(words, max(12, int(room / (0.58 * size))), break_long_words=True) or [""]


def _strain_scale(figure: Figure, axes: Sequence[Axes], panels: Sequence[Panel], asked: Asked) -> float:
    """Draw one strain scale for all pictures, which share their limit; return its height [inches]."""
    pictures = [panel for panel in panels if isinstance(panel, Picture)]
    if not pictures:
        return 0.0
    limit = pictures[0].limit
    low, high = (float(end([0.0, *(end(panel.strain) for panel in pictures)])) for end in (np.nanmin, np.nanmax))
    cut = {"min": low < -limit, "max": high > limit}
    extend = "both" if all(cut.values()) else next((end for end, beyond in cut.items() if beyond), "neither")
    bar = figure.colorbar(
        ScalarMappable(Normalize(-limit, limit), STRAIN_MAP), ax=list(axes), location="bottom", shrink=0.8, aspect=45,
        extend=extend, pad=0.02,
        ticks=np.linspace(-limit, limit, 5 if asked.width * 8.0 / asked.size > _FIVE else 3).tolist(),
    )  # fmt: skip
    bar.outline.set_visible(False)
    bar.ax.xaxis.set_major_formatter(ticks(lambda e: f"{100 * e:+.3g} %".replace("-", "−") if e else "at rest"))
    bar.ax.tick_params(length=2.0, width=0.5, labelsize=asked.small)
    ends = [percent(end, 2) for end, beyond in zip((low, high), cut.values(), strict=True) if beyond]
    further = f"; tips: to {' and '.join(ends)}" if ends else ""
    words = wrapped(f"strain of a vertex's most strained spring{further}", asked.width / INCH * 58.0, asked.small)
    bar.set_label("\n".join(words), fontsize=asked.small)
    return (1.45 * asked.small * (len(words) + 1.0) + _BAR) / 72.0


def _strips(figure: Figure, panels: Sequence[Panel], title: str, height: float, asked: Asked, *, legend: bool) -> None:
    """Draw title, legend and foot, and set the figure's height.

    The argument `height` is the height of the panels [inches].
    """
    room = asked.width / INCH * 72.0 - 2.0 * _PAD
    said = list(dict.fromkeys(note for panel in panels for note in panel.notes))
    machines = list(dict.fromkeys(panel.machine for panel in panels if panel.machine))
    foot = [line for words in said + (machines if asked.titled else []) for line in wrapped(words, room, asked.small)]
    head = wrapped(title, room / 1.08, asked.size) if asked.titled else []
    entries = _legend(figure, panels, asked, room) if legend else None
    pad = _PAD / 72.0
    tall = [_tall(head, asked.size), 0.0 if entries is None else _height_of(figure, entries), _tall(foot, asked.small)]
    above, below = (tall[0] + pad if head else 0.0), sum(part + pad for part in tall[1:] if part)
    whole = height + above + below + 2.0 * pad
    figure.set_size_inches(asked.width / INCH, whole)
    engine: Any = figure.get_layout_engine()
    side = pad / (asked.width / INCH)
    frame = (side, (below + pad) / whole, 1.0 - 2.0 * side, 1.0 - (above + below + 2.0 * pad) / whole)
    engine.set(rect=frame, w_pad=0.02, h_pad=0.03, wspace=0.03, hspace=0.04)
    kind: Any = {"x": side, "linespacing": 1.25}
    if head:
        figure.text(y=1.0 - pad / whole, s="\n".join(head), va="top", fontsize=asked.size, weight="bold", **kind)
    if entries is not None:
        entries.set_bbox_to_anchor((side, (tall[2] + pad * (2.0 if foot else 1.0)) / whole), figure.transFigure)
    if foot:
        figure.text(y=pad / whole, s="\n".join(foot), va="bottom", fontsize=asked.small, color=MUTED, **kind)


def _tall(lines: Sequence[str], size: float) -> float:
    """Return the height of lines of text [inches]."""
    return 1.42 * size * len(lines) / 72.0


def _legend(figure: Figure, panels: Sequence[Panel], asked: Asked, room: float) -> Legend | None:
    """Draw the legend in as many columns as fit.

    Read downwards, its order is that of the curves.
    """
    entries = _entries(panels)
    if not entries:
        return None
    for columns in range(min(len(entries), 6), 0, -1):
        legend = figure.legend(
            handles=entries, ncols=columns, loc="lower left", bbox_to_anchor=(0, 0), borderaxespad=0.0, borderpad=0.0,
            fontsize=asked.small, handlelength=2.2, columnspacing=1.2, handletextpad=0.5, labelspacing=0.35,
        )  # fmt: skip
        legend.set_in_layout(False)
        if columns == 1 or legend.get_window_extent().width / DPI * 72.0 <= room:
            return legend
        legend.remove()
    return None


def _height_of(figure: Figure, artist: Artist) -> float:
    return artist.get_window_extent().height / figure.dpi


def _entries(panels: Sequence[Panel]) -> list[Any]:
    grids = [panel for panel in panels if isinstance(panel, CellMap)]
    if grids:
        used = {cell.outcome for grid in grids for cell in grid.cells}
        return [Patch(color=color, label=words) for words, color in grids[0].outcomes if words in used]
    plots = [panel for panel in panels if isinstance(panel, Plot) and panel.y.kind != "names"]
    found: dict[str, Series] = {}
    for panel in plots:
        for series in ordered(panel.series):
            found.setdefault(series.label, series)
    entries: list[Any] = [handle(series) for series in found.values() if not series.named]
    bands = dict.fromkeys(band.words for panel in plots for band in panel.bands if band.words)
    return entries + [Patch(color="#eceae6", label=words) for words in bands]


def ordered(series: Sequence[Series]) -> list[Series]:
    """Sort series by the end values of their curves, the highest first.

    Series without a point come last.
    """

    def end(one: Series) -> float:
        known = one.y[np.isfinite(one.y) & np.isfinite(one.x)]
        return -float(known[-1]) if len(known) else np.inf

    return sorted(series, key=end)


def _settle(axes: Sequence[Axes], panels: Sequence[Panel], asked: Asked) -> None:
    """Adjust what depends on the final size of the frames.

    These are tick labels, values in cells, and labels at curve ends.
    """
    figure: Any = axes[0].figure
    warnings.simplefilter("ignore", UserWarning)  # where frames have no room the faults are told
    figure.draw_without_rendering()
    for ax, panel in zip(axes, panels, strict=True):
        if isinstance(panel, Plot):
            thin(ax)
        elif isinstance(panel, CellMap):
            write_cells(ax, panel, asked)
    figure.draw_without_rendering()
    for ax in axes:
        for text in ax.texts:
            settle = getattr(text, "settle", None)
            if settle is not None:
                settle()
    figure.set_layout_engine("none")


def texts(figure: Figure) -> list[Text]:
    """Return all visible text objects of a figure."""
    found: list[Text] = [*figure.texts, *(text for legend in figure.legends for text in legend.get_texts())]
    for ax in figure.axes:
        found += [*ax.texts, ax.title, ax.xaxis.label, ax.yaxis.label]
        for axis in (ax.xaxis, ax.yaxis) if ax.axison else ():
            low, high = sorted(axis.get_view_interval())
            for at, label in zip(axis.get_majorticklocs(), axis.get_ticklabels(), strict=False):
                found += [label] if low - 1e-9 <= at <= high + 1e-9 else []
    return [text for text in found if text.get_visible() and text.get_text().strip()]
