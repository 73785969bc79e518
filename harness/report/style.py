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

WARNING = "#b3261e"
"""Words that a reader must not miss."""

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
    """How one solver is drawn: a colour, a matplotlib marker and a matplotlib line style."""

    color: str
    marker: str
    dash: Any = "-"


DASHED, DOTTED, DASH_DOTTED = (0, (5, 2)), (0, (1, 1.6)), (0, (6, 2, 1, 2))

# Okabe and Ito's palette, less its yellow and black, which vanish on a light page or in the text.
_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#6d4c9f", "#7a7a7a")
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "h")

# The solvers of a family share a colour and differ in line style; no two share a marker.
_SOLVERS = {
    "dense": Mark("#0072b2", "s", DOTTED),
    "sparse": Mark("#0072b2", "o"),
    "numba": Mark("#56b4e9", "D"),
    "anderson": Mark("#009e73", "^"),
    "chebyshev": Mark("#009e73", "v", DASHED),
    "lbfgs": Mark("#e69f00", "P"),
    "newton": Mark("#d55e00", "X"),
    "newton-cg": Mark("#d55e00", "p", DASHED),
    "hybrid": Mark(INK, "*"),
    "xpbd": Mark("#cc79a7", "<"),
    "xpbd-small-steps": Mark("#cc79a7", ">", DASHED),
    "vbd": Mark("#882255", "h"),
    "symplectic-euler": Mark("#7a7a7a", "d", DASH_DOTTED),
}


def marks(solvers: Iterable[str]) -> dict[str, Mark]:
    """A mark for each of the registry's solvers and of these; of names without one of their own by alphabet."""
    names = {*SOLVERS, *solvers}
    strangers = sorted(names - set(_SOLVERS))
    looks = _SOLVERS | {name: mark(i) for i, name in enumerate(strangers)}
    return {name: look for name, look in looks.items() if name in names}


def mark(number: int) -> Mark:
    """The mark of this number, from 0: 64 different ones, the first 8 in different colours; no solver's own."""
    # The marker moves on once more with each turn of the colours.
    return Mark(_COLORS[number % 8], _MARKERS[(number + number // 8) % 8], (0, (3, 1.2)))
