"""Panels of a figure as plain data: plots, cell maps and mesh pictures.

The same panel is drawn, written as CSV, and reproduced by the script next to the CSV file.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import TYPE_CHECKING, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from springbench.harness.report.plot_style import SeriesStyle

if TYPE_CHECKING:
    from springbench.harness.recording.recorder_interface import RecordingReplay

FloatArray = NDArray[np.float64]
CsvRow = dict[str, str | float | int | bool]


class AxisScale(NamedTuple):
    """An axis.

    Attributes:
        label: quantity with its unit.
        division: scale of the axis; `sizes` is `log` with a tick at each value.
        tick_format: format of the tick labels.
        place_names: names of the positions 0, 1, ... if `division` is `names`.

    Example:
        >>> springbench.AxisScale("time [s]", "linear").tick_format
        'plain'
    """

    label: str
    division: Literal["log", "sizes", "linear", "iterations", "names"] = "log"
    tick_format: Literal["power", "time", "plain", "percent", "strain"] = "plain"
    place_names: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class CurveSeries:
    """One curve: ordered points x, y (k,); nan is a gap.

    Attributes:
        lower, upper: interval (k,) of y, or of x if `is_horizontal`.
        stale: which points (k,) other code measured; they are drawn hollow.
        is_stepped: whether the curve is constant between points.
        is_connected: whether a line connects the points.
        is_bar: whether horizontal bars with their values are drawn to the points, from 0, or from 1 on a logarithmic
            axis.
        labels_points: whether `label` is drawn at each point.
        setting: distinguishes curves of the same label in the data.
        marker_scale: marker size relative to other curves.
        has_cross: whether a cross marks the end, because the measurement ended early.
        callouts: words at single points, by index.

    Example:
        >>> import numpy as np
        >>> style = springbench.SeriesStyle("#0072b2", "o")
        >>> curve = springbench.CurveSeries("sparse", style, x=np.array([1.0, 2.0]), y=np.array([0.5, 0.25]))
        >>> curve.is_connected
        True
    """

    label: str
    style: SeriesStyle
    x: FloatArray
    y: FloatArray
    lower: FloatArray | None = None
    upper: FloatArray | None = None
    is_horizontal: bool = False
    stale: NDArray[np.bool_] | None = None
    is_stepped: bool = False
    is_connected: bool = True
    is_bar: bool = False
    labels_points: bool = False
    setting: str = ""
    marker_scale: float = 1.0
    has_cross: bool = False
    callouts: Mapping[int, str] = field(default_factory=dict[int, str])


class ShadedBand(NamedTuple):
    """A shaded range of values, and its meaning.

    Example:
        >>> springbench.ShadedBand(0.9, 1.1, "within 10 %").high
        1.1
    """

    low: float
    high: float
    label: str


class MarkedValue(NamedTuple):
    """A value that a line marks, and its meaning.

    Example:
        >>> springbench.MarkedValue(1.0, "equal times").label
        'equal times'
    """

    value: float
    label: str


@dataclass(frozen=True, slots=True, eq=False)
class CurvePlot:
    """Curves in one frame.

    Attributes:
        group: parts of the name that identify the measurement, such as scene and size.
        name: parts of the name that identify the panel within the group; `--panels` selects by group and name.
        subject, title: the same in words.
        bands, lines: shaded ranges and marked values of y.
        x_bands, x_lines: those of x.
        notes: sentences at the foot of the figure.
        machine_words: provenance of the data.

    Example:
        >>> import numpy as np
        >>> style = springbench.SeriesStyle("#0072b2", "o")
        >>> axes = springbench.AxisScale("frame", "linear"), springbench.AxisScale("iterations", "linear")
        >>> def panels(rows):
        ...     curve = springbench.CurveSeries("sparse", style, x=np.arange(3.0), y=np.array(rows))
        ...     return [springbench.CurvePlot(("net",), ("iterations",), "net", "", *axes, [curve])]
        >>> [row["y"] for row in panels([5.0, 4.0, 4.0])[0].csv_rows()]
        [5.0, 4.0, 4.0]
    """

    group: tuple[str, ...]
    name: tuple[str, ...]
    subject: str
    title: str
    x: AxisScale
    y: AxisScale
    series: Sequence[CurveSeries]
    bands: Sequence[ShadedBand] = ()
    lines: Sequence[MarkedValue] = ()
    x_bands: Sequence[ShadedBand] = ()
    x_lines: Sequence[MarkedValue] = ()
    notes: Sequence[str] = ()
    machine_words: str = ""
    aspect: float = 0.72
    """Height / width of the frame."""

    def csv_rows(self) -> list[CsvRow]:
        """Return the data as rows of a CSV file, all with the same keys."""
        return [row for series in self.series for row in _series_rows(":".join((*self.group, *self.name)), series)]


class CellOutcome(NamedTuple):
    """An entry of a map's legend: label, colour and description.

    Example:
        >>> springbench.CellOutcome("right", "#3a9e72").description
        ''
    """

    label: str
    color: str
    description: str = ""


class MapCell(NamedTuple):
    """One cell of a map.

    Attributes:
        row, column: names of its place.
        outcome, color: its class, as in the legend.
        value_text: its value; a map may have several lines in a cell.
        is_stale: whether other code measured it.
        mark: sign or words below or after the value, for cells that differ from others of their class.
        reason: what the page states about the cell.
        run_id: run that the page opens; empty for none.
        is_framed: whether a frame emphasises the cell.

    Example:
        >>> springbench.MapCell("sparse", "net", "right", "#3a9e72", "1e-7", mark="*").marked_text
        '1e-7 *'
    """

    row: str
    column: str
    outcome: str
    color: str
    value_text: str
    is_stale: bool = False
    mark: str = ""
    reason: str = ""
    run_id: str = ""
    is_framed: bool = False

    @property
    def marked_text(self) -> str:
        """The value with its mark."""
        return f"{self.value_text} {self.mark}".strip()


_CELL_COLUMNS = ("row", "column", "outcome", "color", "value_text", "is_stale")
"""Columns of a map's CSV file."""


def describe_stale_cells(cells: Sequence[MapCell]) -> list[str]:
    """Describe the dots in cells; there are no dots if other code measured all cells."""
    if cells and all(cell.is_stale for cell in cells):
        return ["Measured by other code than today's."]
    return ["Dot: measured by other code than today's."] if any(cell.is_stale for cell in cells) else []


@dataclass(frozen=True, slots=True, eq=False)
class CellMap:
    """Coloured cells in rows and columns.

    Matplotlib draws one (`report.figures.panel_drawing`). On the results page it is an HTML table of the same
    data (`site/static/map.js`): headers, focus and arrow keys then work with a screen reader, and Plotly's heat map has
    none.

    Attributes:
        group, name: parts of the map's name that identify the measurement, and the map within it.
        subject, title: the same in words.
        notes: sentences at the foot of the figure.
        machine_words: provenance of the data.
        cells: cells, by rows.
        outcomes: classes of cells, in the order of the legend.
        row_label, column_label: quantities with units; empty for names.

    Example:
        >>> cell = springbench.MapCell("sparse", "net", "right", "#3a9e72", "1e-7")
        >>> outcomes = [springbench.CellOutcome("right", "#3a9e72")]
        >>> springbench.CellMap(("hard",), ("map",), "hard", "", [cell], outcomes).row_names
        ['sparse']
    """

    group: tuple[str, ...]
    name: tuple[str, ...]
    subject: str
    title: str
    cells: Sequence[MapCell]
    outcomes: Sequence[CellOutcome]
    notes: Sequence[str] = ()
    machine_words: str = ""
    row_label: str = ""
    column_label: str = ""

    @property
    def row_names(self) -> list[str]:
        """Names of the rows, in their order."""
        return list(dict.fromkeys(cell.row for cell in self.cells))

    @property
    def column_names(self) -> list[str]:
        """Names of the columns, in their order."""
        return list(dict.fromkeys(cell.column for cell in self.cells))

    def csv_rows(self) -> list[CsvRow]:
        """Return the data as rows of a CSV file."""
        panel = ":".join((*self.group, *self.name))
        return [{"panel": panel, **{key: getattr(cell, key) for key in _CELL_COLUMNS}} for cell in self.cells]


def merge_cell_maps(maps: Sequence[CellMap]) -> list[CellMap]:
    """Merge adjacent maps with the same columns into one, whose row names include the titles.

    Args:
        maps: maps, in their order.
    """
    merged: list[CellMap] = []
    for _, same in groupby(maps, key=lambda one: one.column_names):
        first, *others = same
        if others:
            members = [first, *others]
            cells = [cell._replace(row=f"{one.title}: {cell.row}") for one in members for cell in one.cells]
            name = tuple(part for one in members for part in one.name)
            own = [note for one in members for note in one.notes if note not in describe_stale_cells(one.cells)]
            notes = [*dict.fromkeys(own), *describe_stale_cells(cells)]
            first = replace(first, name=name, title="", cells=cells, notes=notes)
        merged.append(first)
    return merged


@dataclass(frozen=True, slots=True, eq=False)
class MeshPicture:
    """A rendered mesh.

    Attributes:
        p: vertex positions (n, 3) [m].
        springs: vertex indices (m, 2); drawn if there are no triangles.
        triangles: vertex indices (f, 3).
        strain: strain of each vertex (n,).
        strain_limit: end of the strain scale.
        aspect: width / height of the picture.
        render: returns the pixels, given width [pixels] and background.
        facts: lines below the title.

    Example:
        >>> import numpy as np
        >>> picture = springbench.MeshPicture(
        ...     group=("net",),
        ...     name=("end",),
        ...     subject="net",
        ...     title="",
        ...     p=np.zeros((2, 3)),
        ...     springs=np.array([[0, 1]]),
        ...     triangles=np.empty((0, 3), np.int64),
        ...     strain=np.zeros(2),
        ...     strain_limit=0.1,
        ...     aspect=1.0,
        ...     render=lambda width, background: np.full((width, width, 3), 255, np.uint8),
        ... )
        >>> len(picture.csv_rows())
        2
    """

    group: tuple[str, ...]
    name: tuple[str, ...]
    subject: str
    title: str
    p: FloatArray
    springs: NDArray[np.int64]
    triangles: NDArray[np.int64]
    strain: FloatArray
    strain_limit: float
    aspect: float
    render: MeshRenderer
    facts: Sequence[str] = ()
    notes: Sequence[str] = ()
    machine_words: str = ""

    def csv_rows(self) -> list[CsvRow]:
        """Return the vertices as rows of a CSV file."""
        panel = ":".join((*self.group, *self.name))
        table = zip(*self.p.T.tolist(), self.strain.tolist(), strict=True)
        return [{"panel": panel, "x": x, "y": y, "z": z, "strain": e} for x, y, z, e in table]


class MeshRenderer(Protocol):
    """Renders one frame of a recording with one camera.

    Attributes:
        replay: recording of the mesh.
        frame: index of the frame.
        aspect: width / height of the picture.

    Example:
        >>> class Blank:
        ...     replay, frame, aspect = None, 0, 2.0
        ...     def __call__(self, width, background):
        ...         return np.full((round(width / self.aspect), width, 3), 255, np.uint8)

        >>> import numpy as np
        >>> render: springbench.MeshRenderer = Blank()
        >>> render(4, None).shape
        (2, 4, 3)
    """

    replay: RecordingReplay
    frame: int
    aspect: float

    def __call__(self, width: int, background: str | None) -> NDArray[np.uint8]:
        """Return the pixels (height, width, 3 or 4).

        Args:
            width: width of the picture [pixels]; the height follows from the aspect.
            background: colour of the background, or None for a transparent one.
        """
        ...


FigurePanel = CurvePlot | CellMap | MeshPicture
"""A panel of a figure: a `CurvePlot`, a `CellMap` or a `MeshPicture`; `panels(rows)` of a report returns a list."""


def _series_rows(panel: str, series: CurveSeries) -> list[CsvRow]:
    nothing = np.full(len(series.x), np.nan)
    low, high = (nothing if end is None else end for end in (series.lower, series.upper))
    older = np.zeros(len(series.x), bool) if series.stale is None else series.stale
    table = zip(series.x, series.y, low, high, older, strict=True)
    return [
        {
            "panel": panel,
            "series": series.label,
            "setting": series.setting,
            "x": float(x),
            "y": float(y),
            "lower": float(a),
            "upper": float(b),
            "is_stale": bool(old),
        }
        for x, y, a, b, old in table
    ]
