"""One quantity against mesh size on a page of its own: a line for each candidate, named at the right."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, MultipleLocator, NullLocator

from harness.report.page import axes, count, header, new_page, quantity, save, shorten
from harness.report.style import DASH_DOTTED, DOTTED, HEIGHT, PAGE, RC, WIDTH, mark

_DASHES = (((0, (4, 2)), "-"), (DOTTED, DASH_DOTTED))
"""Of a family's other members and of its namesake; the ninth family has the colour of the first, and other dashes."""

_LEFT, _TOP, _NAMES, _BELOW = 110, 130, 400, 70


class Series(NamedTuple):
    """The line of a candidate: its name, the family that shares its colour, vertices and values (k,) each."""

    name: str
    family: str
    vertices: Sequence[int]
    values: Sequence[float]


def draw_by_size(path: Path, title: str, facts: Sequence[str], series: Sequence[Series], *, share: bool) -> None:
    """Draw to `path`, WIDTH x HEIGHT pixels, PNG; `share`: values are parts of a whole, drawn in percent.

    The line of a family's namesake is solid, those of its other members are dashed (dash-dotted and dotted from the
    ninth family on). A series without values is not
    drawn; it keeps its family's colour free, so that pictures of the same candidates have the same colours.
    """
    drawn = [line for line in series if line.values]
    looks = {family: mark(k) for k, family in enumerate(dict.fromkeys(line.family for line in series))}
    with matplotlib.rc_context(RC):
        page = new_page()
        header(page, title, facts, letters=84)
        ax = axes(page, _LEFT, _TOP, WIDTH - _LEFT - _NAMES, HEIGHT - _TOP - _BELOW)
        handles: list[tuple[float, Line2D]] = []
        for line in drawn:
            look = looks[line.family]
            (handle,) = ax.plot(
                line.vertices,
                line.values,
                color=look.color,
                linestyle=_DASHES[list(looks).index(line.family) // 8 % 2][line.name == line.family],
                linewidth=1.8,
                marker=look.marker,
                markersize=6,
                markeredgecolor=PAGE,
                label=shorten(line.name, 44),
            )
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


def _scales(ax, drawn: Sequence[Series], share: bool) -> None:
    """Vertices by logarithms; times by logarithms too, shares from nothing up."""
    sizes = sorted({n for line in drawn for n in line.vertices})
    ax.set_xscale("log")
    ax.set_xlabel("vertices", fontsize=10, loc="left")
    ax.xaxis.set_major_locator(FixedLocator(sizes))
    ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: count(round(value))))
    if share:
        highest = max((max(line.values) for line in drawn), default=1.0)
        ax.set_ylim(0.0, max(1.0, 1.05 * highest))
        ax.yaxis.set_major_locator(MultipleLocator(0.1 * np.ceil(max(1.0, highest) / 1.5)))
        ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{100 * value:.0f} %"))
    else:
        ax.set_yscale("log")
        ax.yaxis.set_major_locator(LogLocator(numticks=12))
        ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: quantity(value)))
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_minor_locator(NullLocator())
    ax.tick_params(length=3, labelsize=9.5)
    ax.grid(axis="y")
    ax.set_axisbelow(True)
