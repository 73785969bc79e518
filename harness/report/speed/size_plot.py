# pyright: reportUnknownMemberType=false
# Matplotlib's stubs do not type most keywords.
"""Plot of one quantity against mesh size on a page of its own.

There is a line for each candidate, and a legend at the right.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, LogLocator, MultipleLocator, NullLocator
from springbench.harness.report.number_format import format_count, format_quantity, shorten_words
from springbench.harness.report.page_layout import add_axes, draw_header, new_page, save_page, tick_formatter
from springbench.harness.report.plot_style import (
    BACKGROUND_COLOUR,
    PAGE_HEIGHT,
    PAGE_RC,
    PAGE_WIDTH,
    assign_label_styles,
)

_PANEL_LEFT, _PANEL_TOP, _NAME_WIDTH, _MARGIN_BELOW = 110, 130, 400, 70


class CandidateLine(NamedTuple):
    """The line of a candidate.

    Attributes:
        name: label of the candidate.
        single_thread_name: label of the same candidate on one thread.
        solver: name of its solver.
        vertices, values: points (k,).
        stale: which points (k,) were measured by other code than the current version.
    """

    name: str
    single_thread_name: str
    solver: str
    vertices: Sequence[int]
    values: Sequence[float]
    stale: Sequence[bool]


def draw_size_plot(
    path: Path, title: str, facts: Sequence[str], series: Sequence[CandidateLine], *, is_share: bool
) -> None:
    """Draw a plot as a PNG file of PAGE_WIDTH x PAGE_HEIGHT pixels.

    Candidates have the colour and the marker of their solver, and a line style of their own. Multithreaded candidates
    have thinner lines, and stale points are hollow. A series without values is not drawn, but its line style stays
    reserved, so that candidates look the same in all plots.

    Args:
        path: target file.
        title: title of the plot.
        facts: phrases below the title.
        series: lines of the candidates.
        is_share: whether values are shares, drawn in percent.
    """
    drawn = [line for line in series if line.values]
    marked = assign_label_styles((line.single_thread_name, line.solver) for line in series)
    with matplotlib.rc_context(PAGE_RC):
        page = new_page()
        draw_header(page, title, facts, max_letters=84)
        ax = add_axes(
            page,
            _PANEL_LEFT,
            _PANEL_TOP,
            PAGE_WIDTH - _PANEL_LEFT - _NAME_WIDTH,
            PAGE_HEIGHT - _PANEL_TOP - _MARGIN_BELOW,
        )
        handles: list[tuple[float, Line2D]] = []
        for line in drawn:
            look = marked[line.single_thread_name]
            (handle,) = ax.plot(
                line.vertices,
                line.values,
                color=look.color,
                linestyle=look.dash,
                linewidth=2.0 if line.name == line.single_thread_name else 0.9,
                marker=look.marker,
                markersize=6,
                markeredgecolor=BACKGROUND_COLOUR,
                label=shorten_words(line.name, 44),
            )
            for n, value in ((n, v) for n, v, older in zip(*line[3:], strict=True) if older):
                ax.plot(n, value, look.marker, mfc=BACKGROUND_COLOUR, mec=look.color, mew=1.5, markersize=6)
            handles.append((line.values[-1], handle))
        _format_axes(ax, drawn, is_share)
        ordered = [handle for _, handle in sorted(handles, key=lambda pair: -pair[0])]
        if ordered:
            ax.legend(
                handles=ordered,
                loc="center left",
                bbox_to_anchor=(1.02, 0.5),
                frameon=False,
                fontsize=10,
                handlelength=4,
                labelspacing=0.8,
            )
        save_page(page, path)


def _format_axes(ax: Axes, drawn: Sequence[CandidateLine], share: bool) -> None:
    """Set a logarithmic vertex axis; times are logarithmic too, shares start at zero."""
    sizes = sorted({n for line in drawn for n in line.vertices})
    ax.set_xscale("log")
    ax.set_xlabel("vertices", fontsize=10, loc="left")
    ax.xaxis.set_major_locator(FixedLocator(sizes))
    ax.xaxis.set_major_formatter(tick_formatter(lambda value: format_count(round(value))))
    if share:
        highest = max((max(line.values) for line in drawn), default=1.0)
        ax.set_ylim(0.0, max(1.0, 1.05 * highest))
        ax.yaxis.set_major_locator(MultipleLocator(0.1 * np.ceil(max(1.0, highest) / 1.5)))
        ax.yaxis.set_major_formatter(tick_formatter(lambda value: f"{100 * value:.0f} %"))
    else:
        ax.set_yscale("log")
        ax.yaxis.set_major_locator(LogLocator(numticks=12))
        ax.yaxis.set_major_formatter(tick_formatter(format_quantity))
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_minor_locator(NullLocator())
    ax.tick_params(length=3, labelsize=9.5)
    ax.grid(axis="y")
    ax.set_axisbelow(True)
