# pyright: reportUnknownMemberType=false
# Matplotlib's stubs do not type most keywords.
"""Charts of pages, as plain data and as pictures.

One chart has one message, which its title says. At most a few series have colours and labels; the others are grey.
"""

from __future__ import annotations

import hashlib
import json
import math
import textwrap
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from io import BytesIO
from typing import Literal

import matplotlib
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from springbench.harness.report.figures.direct_labels import spread_positions
from springbench.harness.report.plot_style import BACKGROUND_COLOUR, MUTED_COLOUR, PAGE_RC, RULE_COLOUR, TEXT_COLOUR

ChartForm = Literal["bars", "lines", "heatmap"]

_WIDTH, _DPI, _FONT_SIZE = 5.2, 200, 9.0
"""Width [inches], resolution and font size [points]: at 85 mm the type is 6 points high."""
_TITLE_LETTERS = 58
"""Number of letters of the title on one line."""
_ROW_HEIGHT, _FRAME_HEIGHT, _MARGIN = 0.21, 2.9, 0.62
"""Inches: height of a row of names, of the frame of curves, and of the axis with its label."""
_ACCENTS = ("#0072b2", "#d55e00", "#00a878", "#cc79a7", "#e69f00", "#7a5fd0")
"""Colours of the series that a chart is about."""
_GREY = "#c4c7cc"
_MAX_NAMED_PLACES = 7
"""Largest number of places of a logarithmic x axis that are all written out."""
_SHARE_MAP = LinearSegmentedColormap.from_list("share", ("#f6f4ef", "#8fcbad", "#1f7a55"))


@dataclass(frozen=True, slots=True)
class ChartPoint:
    """One value of a chart.

    Attributes:
        series: curve, bar, or column of a heat map.
        x: abscissa, or row of a heat map.
        y: value; None is a gap.
        low, high: interval of the value.
    """

    series: str
    x: float | str
    y: float | None
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True, slots=True)
class PageChart:
    """A chart as plain data: what it draws, and nothing else.

    Attributes:
        title: the message in one sentence.
        form: bars by name, lines, or a heat map of shares.
        points: values, in the order of their appearance.
        x_label, y_label: quantities with units.
        x_scale, y_scale: "log" or "linear"; bars on a logarithmic axis are ratios and start at 1.
        highlights: series in colour; the others are grey. Empty: all of them.
        limit: a value that a line marks, and its meaning.
    """

    title: str
    form: ChartForm
    points: Sequence[ChartPoint]
    x_label: str = ""
    y_label: str = ""
    x_scale: str = "linear"
    y_scale: str = "linear"
    highlights: Sequence[str] = ()
    limit: tuple[float, str] | None = None
    is_percentage: bool = False
    notes: Sequence[str] = field(default_factory=tuple)

    def compute_digest(self) -> str:
        """Compute the digest of all that the chart draws."""
        return hashlib.sha256(json.dumps(asdict(self), sort_keys=True).encode()).hexdigest()


def draw_chart(chart: PageChart) -> bytes:
    """Draw a chart, and return it as PNG; the same chart gives the same bytes."""
    with matplotlib.rc_context({**PAGE_RC, "font.size": _FONT_SIZE}):
        title = textwrap.wrap(chart.title, _TITLE_LETTERS)
        names = list(dict.fromkeys(str(point.x if chart.form == "heatmap" else point.series) for point in chart.points))
        rows = _ROW_HEIGHT * (len(names) + (3.2 if chart.form == "heatmap" else 0.0))
        frame = _FRAME_HEIGHT if chart.form == "lines" else rows
        height = frame + _MARGIN + 0.2 * len(title) + 0.16 * len(chart.notes) + 0.15
        figure = Figure((_WIDTH, height), _DPI, facecolor=BACKGROUND_COLOUR, layout="constrained")
        FigureCanvasAgg(figure)
        ax = figure.add_subplot()
        {"bars": _draw_bars, "lines": _draw_lines, "heatmap": _draw_heatmap}[chart.form](ax, chart)
        figure.suptitle("\n".join(title), x=0.015, ha="left", fontsize=10.5, weight="bold", color=TEXT_COLOUR)
        if chart.notes:
            figure.supxlabel("\n".join(chart.notes), x=0.015, ha="left", fontsize=7.5, color=MUTED_COLOUR)
        content = BytesIO()
        figure.savefig(content, format="png", facecolor=BACKGROUND_COLOUR, metadata={"Software": "springbench"})
        return content.getvalue()


def _choose_colour(chart: PageChart, name: str, number: int) -> str:
    if not chart.highlights:
        return _ACCENTS[number % len(_ACCENTS)]
    return _ACCENTS[list(chart.highlights).index(name) % len(_ACCENTS)] if name in chart.highlights else _GREY


def _format_value(chart: PageChart, value: float) -> str:
    return f"{100 * value:.0f} %" if chart.is_percentage else f"{value:.3g}"


def _draw_bars(ax: Axes, chart: PageChart) -> None:
    """Draw one horizontal bar per name, with its value at the end."""
    known = [(point, point.y) for point in chart.points if point.y is not None]
    base = 1.0 if chart.x_scale == "log" else 0.0  # a ratio of 1, from which both directions are equally long
    for k, (point, value) in enumerate(known):
        name = point.series
        is_grey = bool(chart.highlights) and name not in chart.highlights
        ax.barh(k, value - base, left=base, height=0.72, color=_GREY if is_grey else _ACCENTS[0])
        if point.low is not None and point.high is not None:
            ax.plot([point.low, point.high], [k, k], color=TEXT_COLOUR, linewidth=1.0)
        end = max(value, point.high or value)
        weight = "bold" if name in chart.highlights else "normal"
        label = f" {_format_value(chart, value)}"
        ax.text(end, k, label, va="center", fontsize=8, color=TEXT_COLOUR, weight=weight)
    ax.set_yticks(range(len(known)), [point.series for point, _ in known])
    ax.set_ylim(len(known) - 0.4, -0.6)
    ax.set_xscale(chart.x_scale)
    ax.set_xlabel(chart.x_label, loc="right")
    if chart.x_scale == "log":
        _set_plain_ticks(ax, [m * 10.0**e for e in range(-3, 7) for m in (1, 2, 5)])
    ax.tick_params(axis="y", length=0)
    ax.margins(x=0.12)
    if chart.is_percentage:
        ax.set_xlim(0, 1.12)
        ax.set_xticks([0, 0.25, 0.5, 0.75, 1.0], ["0", "25 %", "50 %", "75 %", "100 %"])
    if chart.limit:
        ax.axvline(chart.limit[0], color=MUTED_COLOUR, linewidth=0.8, linestyle="--")
        ax.text(chart.limit[0], -0.65, f" {chart.limit[1]}", fontsize=7.5, color=MUTED_COLOUR, va="bottom")


def _draw_lines(ax: Axes, chart: PageChart) -> None:
    """Draw one line per series; highlighted ones have a label at their end."""
    names = list(dict.fromkeys(point.series for point in chart.points))
    ends: list[tuple[float, float, str, str]] = []
    for k, name in enumerate(names):
        own = [point for point in chart.points if point.series == name and point.y is not None]
        xs, ys = [float(point.x) for point in own], [point.y or 0.0 for point in own]
        colour = _choose_colour(chart, name, k)
        is_grey = colour == _GREY
        ax.plot(
            xs,
            ys,
            color=colour,
            linewidth=1.0 if is_grey else 1.9,
            marker="o",
            ms=2 if is_grey else 3.5,
            zorder=1 if is_grey else 2,
        )
        if own and not is_grey:
            ends.append((xs[-1], ys[-1], name, colour))
    ax.set_xscale(chart.x_scale)
    ax.set_yscale(chart.y_scale)
    places = sorted({float(point.x) for point in chart.points})
    if chart.x_scale == "log" and len(places) <= _MAX_NAMED_PLACES:
        _set_plain_ticks(ax, places)
    ax.set_xlabel(chart.x_label)
    ax.set_ylabel(chart.y_label)
    ax.grid(visible=True, color=RULE_COLOUR, linewidth=0.6)
    if chart.limit:
        ax.axhline(chart.limit[0], color=MUTED_COLOUR, linewidth=0.8, linestyle="--")
        ax.annotate(
            chart.limit[1], (0.01, chart.limit[0]), xycoords=("axes fraction", "data"), fontsize=7.5, va="bottom"
        )
    _label_ends(ax, chart, ends)


def _set_plain_ticks(ax: Axes, places: Sequence[float]) -> None:
    """Write numbers instead of powers at those places of the x axis that lie within its limits."""
    low, high = ax.get_xlim()
    inside = [place for place in places if low <= place <= high]
    ax.set_xticks(inside, [f"{place:,.0f}" if place == int(place) else f"{place:g}" for place in inside])
    ax.xaxis.set_minor_formatter(NullFormatter())


def _label_ends(ax: Axes, chart: PageChart, ends: Sequence[tuple[float, float, str, str]]) -> None:
    """Write the names of series to the right of the frame, spread so that none overlaps."""
    ax.margins(x=0.03)
    low, high = ax.get_ylim()

    def to_fraction(y: float) -> float:
        if chart.y_scale == "log":
            return (math.log(y) - math.log(low)) / (math.log(high) - math.log(low))
        return (y - low) / (high - low)

    ordered = sorted(ends, key=lambda end: to_fraction(end[1]))
    places = spread_positions([to_fraction(end[1]) for end in ordered], 0.062, 1.0)
    for (_, _, name, colour), y in zip(ordered, places, strict=True):
        ax.annotate(name, (1.015, y), xycoords="axes fraction", color=colour, va="center", fontsize=8.5, weight="bold")


def _draw_heatmap(ax: Axes, chart: PageChart) -> None:
    """Draw a map of shares: rows are the `x` of the points, columns their series."""
    rows = list(dict.fromkeys(str(point.x) for point in chart.points))
    columns = list(dict.fromkeys(point.series for point in chart.points))
    grid = [[math.nan] * len(columns) for _ in rows]
    for point in chart.points:
        if point.y is not None:
            grid[rows.index(str(point.x))][columns.index(point.series)] = point.y
    ax.imshow(grid, cmap=_SHARE_MAP, vmin=0.0, vmax=1.0, aspect="auto")
    for r, values in enumerate(grid):
        for c, value in enumerate(values):
            words = "" if math.isnan(value) else f"{100 * value:.0f}"
            ax.text(c, r, words, ha="center", va="center", fontsize=7.5, color="white" if value > 0.7 else TEXT_COLOUR)
    ax.set_xticks(range(len(columns)), columns, rotation=40, ha="left", rotation_mode="anchor")
    ax.set_yticks(range(len(rows)), rows)
    ax.xaxis.tick_top()
    ax.tick_params(length=0)
    for side in ("left", "bottom", "top", "right"):
        ax.spines[side].set_visible(False)
    ax.set_xlabel(chart.x_label)
