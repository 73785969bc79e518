"""Panels of a figure as plain data: plots, cell maps and mesh pictures.

The same panel is drawn, written as CSV, and reproduced by the script next to the CSV file.
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
    """An axis.

    Attributes:
        words: quantity with its unit.
        kind: scale of the axis; `sizes` is `log` with a tick at each value.
        unit: format of the tick labels.
        names: names of the positions 0, 1, ... if `kind` is `names`.
    """

    words: str
    kind: Literal["log", "sizes", "linear", "iterations", "names"] = "log"
    unit: Literal["power", "time", "plain", "percent", "strain"] = "plain"
    names: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """One curve: ordered points x, y (k,); nan is a gap.

    Attributes:
        low, high: interval (k,) of y, or of x if `across`.
        older: which points (k,) other code measured; they are drawn hollow.
        steps: whether the curve is constant between points.
        joined: whether a line connects the points.
        named: whether `label` is drawn at each point.
        setting: distinguishes curves of the same label in the data.
        grown: marker size relative to other curves.
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
    """A shaded range of y, and its meaning."""

    low: float
    high: float
    words: str


class Line(NamedTuple):
    """A value of y that a line marks, and its meaning."""

    y: float
    words: str


@dataclass(frozen=True, slots=True, eq=False)
class Plot:
    """Curves in one frame.

    Attributes:
        of: parts of the name that identify the measurement, such as scene and size.
        name: parts of the name that identify the panel within the group; `--panels` selects by group and name.
        subject, title: the same in words.
        notes: sentences at the foot of the figure.
        machine: provenance of the data.
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
    """Height / width of the frame."""

    def rows(self) -> list[Row]:
        """Return the data as rows of a CSV file, all with the same keys."""
        return [row for series in self.series for row in _points(":".join((*self.of, *self.name)), series)]


class Cell(NamedTuple):
    """One cell of a map: row, column, outcome, colour and value.

    `older` states whether other code measured it.
    """

    row: str
    column: str
    outcome: str
    color: str
    figure: str
    older: bool = False


def dotted(cells: Sequence[Cell]) -> list[str]:
    """Describe the dots in cells; there are no dots if other code measured all cells."""
    if cells and all(cell.older for cell in cells):
        return ["Measured by other code than today's."]
    return ["Dot: measured by other code than today's."] if any(cell.older for cell in cells) else []


@dataclass(frozen=True, slots=True, eq=False)
class CellMap:
    """Coloured cells in rows and columns.

    `outcomes` are pairs of meaning and colour, in the order of the legend.
    """

    of: tuple[str, ...]
    name: tuple[str, ...]
    subject: str
    title: str
    cells: Sequence[Cell]
    outcomes: Sequence[tuple[str, str]]
    notes: Sequence[str] = ()
    machine: str = ""

    def rows(self) -> list[Row]:
        """Return the data as rows of a CSV file."""
        return [{"panel": ":".join((*self.of, *self.name)), **cell._asdict()} for cell in self.cells]


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """A rendered mesh.

    Attributes:
        p: vertex positions (n, 3) [m].
        springs: vertex indices (m, 2); drawn if there are no triangles.
        triangles: vertex indices (f, 3).
        strain: strain of each vertex (n,).
        limit: end of the strain scale.
        aspect: width / height of the picture.
        render: returns the pixels, given width [pixels] and background.
    """

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
        """Return the vertices as rows of a CSV file."""
        panel = ":".join((*self.of, *self.name))
        table = zip(*self.p.T.tolist(), self.strain.tolist(), strict=True)
        return [{"panel": panel, "x": x, "y": y, "z": z, "strain": e} for x, y, z, e in table]


class Renderer:
    """Draws a picture at a width [pixels] on a background colour, or transparently for None."""

    def __call__(self, width: int, background: str | None) -> NDArray[np.uint8]:
        """Return the pixels (height, width, 3 or 4)."""
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
