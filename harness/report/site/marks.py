"""Colours, markers and line styles of `harness.report.style`, and axes, in Plotly's terms."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from harness.report.style import (
    ARROWHEAD,
    BARS,
    BOWTIE,
    CHEVRON,
    CORNERS,
    DASH_DOTTED,
    DASHED,
    DOTTED,
    HOURGLASS,
    LOZENGE,
    SPEARHEADS,
    STARS,
    Mark,
)

_SYMBOLS: dict[Any, str] = {
    "o": "circle", "s": "square", "^": "triangle-up", "v": "triangle-down", "<": "triangle-left",
    ">": "triangle-right", "D": "diamond", "d": "diamond-tall", "P": "cross", "X": "x", "p": "pentagon",
    "h": "hexagon", "*": "star", "H": "hexagon2", "8": "octagon",
    STARS[0]: "star-diamond", STARS[1]: "hexagram", STARS[2]: "star-triangle-up", STARS[3]: "star-square",
    STARS[4]: "star-triangle-down", CORNERS[0]: "triangle-nw", CORNERS[1]: "triangle-ne", CORNERS[2]: "triangle-sw",
    CORNERS[3]: "triangle-se", HOURGLASS: "hourglass", BOWTIE: "bowtie", LOZENGE: "diamond-wide",
    ARROWHEAD: "arrow", BARS[0]: "arrow-bar-up", BARS[1]: "arrow-bar-down", CHEVRON: "arrow-wide",
    SPEARHEADS[0]: "arrow-right", SPEARHEADS[1]: "arrow-left", SPEARHEADS[2]: "arrow-down",
    SPEARHEADS[3]: "arrow-up",
}  # fmt: skip
_DASHES: dict[Any, str] = {"-": "solid", DASHED: "dash", DOTTED: "dot", DASH_DOTTED: "dashdot"}

LOG = {"type": "log"}


def drawn(mark: Mark) -> dict[str, str]:
    """Return a style in Plotly's terms."""
    return {"color": mark.color, "symbol": _SYMBOLS[mark.marker], "dash": _DASHES.get(mark.dash, "longdash")}


def axis(column: str, title: str, how: Mapping[str, Any] = LOG) -> dict[str, Any]:
    """Return a possible axis of a chart.

    It has a column of the items, a title, and the layout for Plotly.
    """
    return {"column": column, "title": title, "axis": how}
