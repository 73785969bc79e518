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

from harness.report.page import axes, count, header, new_page, quantity, save, shorten, ticks
from harness.report.style import HEIGHT, PAGE, RC, WIDTH, looks

_LEFT, _TOP, _NAMES, _BELOW = 110, 130, 400, 70


class CandidateLine(NamedTuple):
    """The line of a candidate.

    Attributes:
        name: label of the candidate.
        alone: label of the same candidate on one thread.
        solver: name of its solver.
        vertices, values: points (k,).
        older: which points (k,) were measured by other code than the current version.
    """

    name: str
    alone: str
    solver: str
    vertices: Sequence[int]
    values: Sequence[float]
    older: Sequence[bool]


def draw_by_size(path: Path, title: str, facts: Sequence[str], series: Sequence[CandidateLine], *, share: bool) -> None:
    """Draw a plot as a PNG file of WIDTH x HEIGHT pixels.

    Candidates have the colour and the marker of their solver, and a line style of their own. Multithreaded candidates
    have thinner lines, and stale points are hollow. A series without values is not drawn, but its line style stays
    reserved, so that candidates look the same in all plots.

    Args:
        path: target file.
        title: title of the plot.
        facts: phrases below the title.
        series: lines of the candidates.
        share: whether values are shares, drawn in percent.
    """
    drawn = [line for line in series if line.values]
    marked = looks((line.alone, line.solver) for line in series)
    with matplotlib.rc_context(RC):
        page = new_page()
        header(page, title, facts, letters=84)
        ax = axes(page, _LEFT, _TOP, WIDTH - _LEFT - _NAMES, HEIGHT - _TOP - _BELOW)
        handles: list[tuple[float, Line2D]] = []
        for line in drawn:
            look = marked[line.alone]
            (handle,) = ax.plot(
                line.vertices,
                line.values,
                color=look.color,
                linestyle=look.dash,
                linewidth=2.0 if line.name == line.alone else 0.9,
                marker=look.marker,
                markersize=6,
                markeredgecolor=PAGE,
                label=shorten(line.name, 44),
            )
            for n, value in ((n, v) for n, v, older in zip(*line[3:], strict=True) if older):
                ax.plot(n, value, look.marker, mfc=PAGE, mec=look.color, mew=1.5, markersize=6)
            handles.append((line.values[-1], handle))
        _scales(ax, drawn, share)
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
        save(page, path)


def _scales(ax: Axes, drawn: Sequence[CandidateLine], share: bool) -> None:
    """Set a logarithmic vertex axis; times are logarithmic too, shares start at zero."""
    sizes = sorted({n for line in drawn for n in line.vertices})
    ax.set_xscale("log")
    ax.set_xlabel("vertices", fontsize=10, loc="left")
    ax.xaxis.set_major_locator(FixedLocator(sizes))
    ax.xaxis.set_major_formatter(ticks(lambda value: count(round(value))))
    if share:
        highest = max((max(line.values) for line in drawn), default=1.0)
        ax.set_ylim(0.0, max(1.0, 1.05 * highest))
        ax.yaxis.set_major_locator(MultipleLocator(0.1 * np.ceil(max(1.0, highest) / 1.5)))
        ax.yaxis.set_major_formatter(ticks(lambda value: f"{100 * value:.0f} %"))
    else:
        ax.set_yscale("log")
        ax.yaxis.set_major_locator(LogLocator(numticks=12))
        ax.yaxis.set_major_formatter(ticks(quantity))
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_minor_locator(NullLocator())
    ax.tick_params(length=3, labelsize=9.5)
    ax.grid(axis="y")
    ax.set_axisbelow(True)
