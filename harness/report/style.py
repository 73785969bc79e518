"""The visual language of all pictures: page, type, the strain scale, and a colour and marker for each solver."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

from matplotlib.colors import LinearSegmentedColormap

from harness.record.shading import STRAIN_COLOURS
from solvers.registry import SOLVERS

WIDTH, HEIGHT, DPI = 1600, 900, 100
"""Every picture's size in pixels, and the dots per inch that turn it into a matplotlib figure."""

PAGE, INK, MUTED, RULE = "#fcfbf9", "#23262b", "#6c7078", "#dcdad5"
"""Background, text, secondary text, hairlines."""

STRAIN_MAP = LinearSegmentedColormap.from_list("strain", STRAIN_COLOURS, N=512)
"""The scale of the recordings, from -strain_range to strain_range."""

RC: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 10,
    "text.color": INK,
    "figure.facecolor": PAGE,
    "axes.facecolor": PAGE,
    "axes.edgecolor": MUTED,
    "axes.labelcolor": MUTED,
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "grid.color": RULE,
    "grid.linewidth": 0.8,
}


class Mark(NamedTuple):
    """How one solver is drawn: a colour and a matplotlib marker."""

    color: str
    marker: str


# Okabe and Ito's palette, less its yellow and black, which vanish on a light page or in the text.
_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#6d4c9f", "#7a7a7a")
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "h")


def marks(solvers: Iterable[str]) -> dict[str, Mark]:
    """A mark for each solver name: by the registry's order, then by alphabet."""
    names = (*SOLVERS, *sorted(set(solvers) - set(SOLVERS)))
    return {name: mark(i) for i, name in enumerate(names)}


def mark(number: int) -> Mark:
    """The mark of this number, from 0: 64 different ones, the first 8 in different colours."""
    # The marker moves on once more with each turn of the colours.
    return Mark(_COLORS[number % 8], _MARKERS[(number + number // 8) % 8])
