"""What a figure is made of: panels of curves, grids of cells and pictures of meshes, as plain data.

The same panel is drawn, written as CSV and drawn again by the script beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from harness.report.style import Mark

Values = NDArray[np.float64]
Row = dict[str, str | float | int | bool]


class Scale(NamedTuple):
    """An axis. words: what it shows, with its unit; kind: how it is divided (`sizes`: as `log`, with a tick at each
    value); unit: how its ticks are written; names: of its places 0, 1, ... where kind is `names`."""

    words: str
    kind: Literal["log", "sizes", "linear", "iterations", "names"] = "log"
    unit: Literal["power", "time", "plain", "percent", "strain"] = "plain"
    names: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """One curve: points x, y (k,), in order; what is not a number is a gap.

    low, high: an interval (k,) of y, or of x where `across`; older: which points (k,) other code measured, drawn
    hollow; steps: whether it is constant between points; joined: whether a line joins them; named: whether each point
    is named by `label`; setting: what tells curves of one label apart, in the data; grown: how much larger than others
    its marks are.
    """

    label: str
    look: Mark
    x: Values
    y: Values
    low: Values | None = None
    high: Values | None = None
    across: bool = False
    older: NDArray[np.bool_] | None = None
    steps: bool = False
    joined: bool = True
    named: bool = False
    setting: str = ""
    grown: float = 1.0


class Band(NamedTuple):
    """A range of y that is shaded, and what that means."""

    low: float
    high: float
    words: str


class Line(NamedTuple):
    """A value of y that a line marks, and what it is."""

    y: float
    words: str


@dataclass(frozen=True, slots=True, eq=False)
class Plot:
    """Curves in one frame.

    of: the parts of the name that say what was measured, such as scene and size; name: those that say which panel of it
    this is; `--panels` chooses by both. subject, title: the same for people; notes: at the figure's foot.
    """

    of: tuple[str, ...]
    name: tuple[str, ...]
    subject: str
    title: str
    x: Scale
    y: Scale
    series: Sequence[Series]
    bands: Sequence[Band] = ()
    lines: Sequence[Line] = ()
    notes: Sequence[str] = ()
    machine: str = ""
    aspect: float = 0.72
    """Height over width of the frame."""

    def rows(self) -> list[Row]:
        """The data as rows of a CSV file, all of the same keys."""
        return [row for series in self.series for row in _points(":".join((*self.of, *self.name)), series)]


class Cell(NamedTuple):
    """One cell of a grid: its row and column by name, its outcome and colour, its figure; older: by other code."""

    row: str
    column: str
    outcome: str
    color: str
    figure: str
    older: bool = False


def dotted(cells: Sequence[Cell]) -> list[str]:
    """What the dots in cells mean; there are none where other code measured all of them."""
    if cells and all(cell.older for cell in cells):
        return ["Measured by other code than today's."]
    return ["Dot: measured by other code than today's."] if any(cell.older for cell in cells) else []


@dataclass(frozen=True, slots=True, eq=False)
class CellMap:
    """Coloured cells, rows by columns; outcomes: their meanings with colours, in the order of the legend."""

    of: tuple[str, ...]
    name: tuple[str, ...]
    subject: str
    title: str
    cells: Sequence[Cell]
    outcomes: Sequence[tuple[str, str]]
    notes: Sequence[str] = ()
    machine: str = ""

    def rows(self) -> list[Row]:
        """The data as rows of a CSV file."""
        return [{"panel": ":".join((*self.of, *self.name)), **cell._asdict()} for cell in self.cells]


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """A rendered mesh. p (n, 3) [m], triangles (f, 3) or springs (m, 2), strain (n,), limit: of the scale of strain;
    pixels: a picture of width / height `aspect` is rendered by `render(width in pixels, background)`."""

    of: tuple[str, ...]
    name: tuple[str, ...]
    subject: str
    title: str
    p: Values
    springs: NDArray[np.int64]
    triangles: NDArray[np.int64]
    strain: Values
    limit: float
    aspect: float
    render: Renderer
    facts: Sequence[str] = ()
    look: Mark | None = None
    notes: Sequence[str] = ()
    machine: str = ""
    mesh: str = field(default="")

    def rows(self) -> list[Row]:
        """The vertices as rows of a CSV file."""
        panel = ":".join((*self.of, *self.name))
        table = zip(*self.p.T.tolist(), self.strain.tolist(), strict=True)
        return [{"panel": panel, "x": x, "y": y, "z": z, "strain": e} for x, y, z, e in table]


class Renderer:
    """Draws a picture at a width [pixels] on a background, or transparent where that is None."""

    def __call__(self, width: int, background: str | None) -> NDArray[np.uint8]:
        """Pixels (height, width, 3 or 4)."""
        raise NotImplementedError


Panel = Plot | CellMap | Picture


def _points(panel: str, series: Series) -> list[Row]:
    nothing = np.full(len(series.x), np.nan)
    low, high = (nothing if end is None else end for end in (series.low, series.high))
    older = np.zeros(len(series.x), bool) if series.older is None else series.older
    table = zip(series.x, series.y, low, high, older, strict=True)
    return [
        {
            "panel": panel,
            "series": series.label,
            "setting": series.setting,
            "x": float(x),
            "y": float(y),
            "low": float(a),
            "high": float(b),
            "other_code": bool(old),
        }
        for x, y, a, b, old in table
    ]
