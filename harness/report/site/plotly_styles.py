"""Colours, markers and line styles of `springbench.harness.report.plot_style` in Plotly's terms."""

from __future__ import annotations

from typing import Any

from springbench.harness.report.plot_style import (
    ARROW_BAR_MARKERS,
    ARROWHEAD_MARKER,
    BOWTIE_MARKER,
    CHEVRON_MARKER,
    CORNER_MARKERS,
    HOURGLASS_MARKER,
    LOZENGE_MARKER,
    SPEARHEAD_MARKERS,
    STAR_MARKERS,
    SeriesStyle,
)

_PLOTLY_SYMBOLS: dict[Any, str] = {
    "None": "none", "o": "circle", "s": "square", "^": "triangle-up", "v": "triangle-down", "<": "triangle-left",
    ">": "triangle-right", "D": "diamond", "d": "diamond-tall", "P": "cross", "X": "x", "p": "pentagon",
    "h": "hexagon", "*": "star", "H": "hexagon2", "8": "octagon", "|": "line-ns",
    STAR_MARKERS[0]: "star-diamond", STAR_MARKERS[1]: "hexagram", STAR_MARKERS[2]: "star-triangle-up",
    STAR_MARKERS[3]: "star-square",
    STAR_MARKERS[4]: "star-triangle-down", CORNER_MARKERS[0]: "triangle-nw", CORNER_MARKERS[1]: "triangle-ne",
    CORNER_MARKERS[2]: "triangle-sw",
    CORNER_MARKERS[3]: "triangle-se", HOURGLASS_MARKER: "hourglass", BOWTIE_MARKER: "bowtie",
    LOZENGE_MARKER: "diamond-wide",
    ARROWHEAD_MARKER: "arrow", ARROW_BAR_MARKERS[0]: "arrow-bar-up", ARROW_BAR_MARKERS[1]: "arrow-bar-left",
    ARROW_BAR_MARKERS[2]: "arrow-bar-down",
    CHEVRON_MARKER: "arrow-wide",
    SPEARHEAD_MARKERS[0]: "arrow-right", SPEARHEAD_MARKERS[1]: "arrow-left", SPEARHEAD_MARKERS[2]: "arrow-down",
    SPEARHEAD_MARKERS[3]: "arrow-up",
}  # fmt: skip


def build_plotly_style(mark: SeriesStyle) -> dict[str, str]:
    """Return a style in Plotly's terms."""
    return {
        "color": mark.color,
        "symbol": _PLOTLY_SYMBOLS[mark.marker],
        "dash": "solid" if mark.dash == "-" else ",".join(f"{2 * length:g}px" for length in mark.dash[1]),
    }
