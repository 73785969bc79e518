"""The description of a chart: named columns of numbers, and the possible axes.

A builder makes one from rows; it contains curves or cell maps. Matplotlib draws its panels (`select_panels`) as figures
and sheets. The results page draws its JSON (`springbench.harness.report.site.chart_json`), with Plotly for curves.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from springbench.harness.report.charts.figure_panels import (
    AxisScale,
    CellMap,
    CurvePlot,
    CurveSeries,
    FigurePanel,
    FloatArray,
    MarkedValue,
    ShadedBand,
)
from springbench.harness.report.plot_style import SeriesStyle

LOW_SUFFIX, HIGH_SUFFIX = "_low", "_high"
"""Suffixes of the names of the columns that contain the interval of a column."""


class ChartAxis(NamedTuple):
    """A quantity that a chart can be drawn along.

    Attributes:
        column: column of the series with its values; its interval, if known, is in columns with the suffixes above.
        scale: label, division and tick format.
        name: part of a panel's name that selects the quantity; empty if the chart has no other.
        title: what distinguishes it from others with the same scale.
        is_on_sheets: whether sheets show it too.

    Example:
        >>> springbench.ChartAxis("seconds", springbench.AxisScale("time [s]")).is_on_sheets
        True
    """

    column: str
    scale: AxisScale
    name: str = ""
    title: str = ""
    is_on_sheets: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class ChartSeries:
    """One curve, or a set of points.

    Attributes:
        label, style: entry of the legend.
        columns: values of the k points by column; numbers, or words that are shown for a point.
        description: what was measured, in words.
        stale: whether other code measured the points, in total or for each of them.
        status: "ok", or how the measurement ended; then a cross marks its end.
        is_stepped: whether the curve is constant between points.
        is_connected: whether a line connects the points.
        labels_points: whether `label` is drawn at each point.
        marker_scale: marker size relative to other curves.
        setting: distinguishes curves of the same label in the data.
        callouts: words at points, by index; drawn where the first quantity of y is shown.
        identity: solver and settings, by which the same measurement is found in other results.
        behind: label of the series that it is drawn behind; empty if there is none.
        links: what the page offers for a point, such as a recording.

    Example:
        >>> style = springbench.SeriesStyle("#0072b2", "o")
        >>> series = springbench.ChartSeries("sparse", style, {"size": [8, 16], "seconds": [0.1, 0.4]})
        >>> series.status
        'ok'
    """

    label: str
    style: SeriesStyle
    columns: Mapping[str, Sequence[Any] | FloatArray]
    description: str = ""
    stale: bool | Sequence[bool] = False
    status: str = "ok"
    is_stepped: bool = False
    is_connected: bool = True
    labels_points: bool = False
    marker_scale: float = 1.0
    setting: str = ""
    callouts: Mapping[int, str] = field(default_factory=dict[int, str])
    identity: tuple[str, ...] = ()
    behind: str = ""
    links: Mapping[str, Any] = field(default_factory=dict[str, Any])


@dataclass(frozen=True, slots=True, eq=False)
class ChartFrame:
    """Series that are drawn together.

    Attributes:
        group: parts of the panels' names that identify the measurement, such as scene and size.
        name: parts of the names that identify the panels within the group.
        subject: what was measured, such as a scene; frames of one subject are shown side by side.
        title: what distinguishes the frame from the others of its subject.
        bands, lines: shaded ranges and marked values, by column of x or y.
        notes: sentences about these series.
        place_names: names of the positions by column of x or y, if they are not those of the chart.
        x_label: label of the horizontal axis, if it is not that of the chart.
        sheet: name of the sheet that shows the frame; empty for the sheet of the chart.

    Example:
        >>> style = springbench.SeriesStyle("#0072b2", "o")
        >>> series = springbench.ChartSeries("sparse", style, {"size": [8, 16], "seconds": [0.1, 0.4]})
        >>> len(springbench.ChartFrame(("net",), (), "net", "", [series]).series)
        1
    """

    group: tuple[str, ...]
    name: tuple[str, ...]
    subject: str
    title: str
    series: Sequence[ChartSeries]
    bands: Mapping[str, Sequence[ShadedBand]] = field(default_factory=dict[str, Sequence[ShadedBand]])
    lines: Mapping[str, Sequence[MarkedValue]] = field(default_factory=dict[str, Sequence[MarkedValue]])
    notes: Sequence[str] = ()
    place_names: Mapping[str, tuple[str, ...]] = field(default_factory=dict[str, tuple[str, ...]])
    x_label: str = ""
    sheet: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class ChartDescription:
    """A chart as plain data.

    Attributes:
        title: title of the chart.
        note: how to read it, in sentences.
        frames: its frames, in the order of their appearance.
        x, y: quantities that it can be drawn along; the first ones are drawn by default.
        maps: its cell maps.
        subject_key: what the subjects are: problem, scene, gap, curve or benchmark.
        hover: columns that are stated at a point, with their words.
        machine_words: provenance of the data.
        citations: citation of the method of a series, by label.
        command: command that measures the rows.

    Example:
        >>> style = springbench.SeriesStyle("#0072b2", "o")
        >>> series = springbench.ChartSeries("sparse", style, {"size": [8, 16], "seconds": [0.1, 0.4]})
        >>> frame = springbench.ChartFrame(("net",), (), "net", "", [series])
        >>> x, y = (springbench.ChartAxis(name, springbench.AxisScale(name)) for name in ("size", "seconds"))
        >>> chart = springbench.ChartDescription("Time a step", "", [frame], (x,), (y,))
        >>> chart.subject_key
        'scene'
    """

    title: str
    note: str
    frames: Sequence[ChartFrame] = ()
    x: tuple[ChartAxis, ...] = ()
    y: tuple[ChartAxis, ...] = ()
    subject_key: str = "scene"
    maps: Sequence[CellMap] = ()
    hover: Sequence[tuple[str, str]] = ()
    machine_words: str = ""
    citations: Mapping[str, str] = field(default_factory=dict[str, str])
    command: str = ""


def select_panels(chart: ChartDescription) -> Iterator[FigurePanel]:
    """Yield the maps of a chart, then its plots.

    Example:
        >>> style = springbench.SeriesStyle("#0072b2", "o")
        >>> series = springbench.ChartSeries("sparse", style, {"size": [8, 16], "seconds": [0.1, 0.4]})
        >>> frame = springbench.ChartFrame(("net",), (), "net", "", [series])
        >>> x, y = (springbench.ChartAxis(name, springbench.AxisScale(name)) for name in ("size", "seconds"))
        >>> chart = springbench.ChartDescription("Time a step", "", [frame], (x,), (y,))
        >>> [plot.series[0].y.tolist() for plot in springbench.select_panels(chart)]
        [[0.1, 0.4]]
    """
    yield from chart.maps
    yield from select_curve_plots(chart)


def select_curve_plots(
    chart: ChartDescription, frames: Sequence[ChartFrame] | None = None, y: Sequence[ChartAxis] | None = None
) -> Iterator[CurvePlot]:
    """Yield a plot for each frame and each pair of quantities in its series.

    Args:
        chart: the chart.
        frames: frames to draw; None for all.
        y: quantities of the vertical axis; None for all.
    """
    for frame in chart.frames if frames is None else frames:
        for up in chart.y if y is None else y:
            for across in chart.x:
                curves = [
                    (one.behind or one.label, made)
                    for one in frame.series
                    if (made := _build_curve(one, across, up, up is chart.y[0]))
                ]
                if curves:
                    yield _build_plot(chart, frame, across, up, curves)


def _build_plot(
    chart: ChartDescription, frame: ChartFrame, across: ChartAxis, up: ChartAxis, curves: list[tuple[str, CurveSeries]]
) -> CurvePlot:
    """Build a plot of curves and the labels that they are compared by."""
    series = [curve for _, curve in curves]
    names = [frame.place_names.get(axis.column, axis.scale.place_names) for axis in (across, up)]
    scales = (
        across.scale._replace(label=frame.x_label or across.scale.label, place_names=names[0]),
        up.scale._replace(place_names=names[1]),
    )
    # A single size makes no curve: its values are drawn along x, with a row for each label.
    if across.scale.division == "sizes" and len({float(x) for one in series for x in one.x}) == 1:
        least = {label: float(curve.y[0]) for label, curve in curves}  # published curves precede own ones
        labels = sorted(least, key=lambda label: least[label])
        scales = up.scale, AxisScale("", "names", place_names=tuple(labels))
        series = [_lay_down(one, k) for k, row in enumerate(labels) for label, one in curves if label == row]
    return CurvePlot(
        group=frame.group,
        name=(*frame.name, *filter(None, (up.name, across.name))),
        subject=frame.subject,
        title=", ".join(filter(None, (frame.title, up.title))),
        x=scales[0],
        y=scales[1],
        series=series,
        bands=frame.bands.get(up.column, ()),
        lines=frame.lines.get(up.column, ()),
        x_bands=frame.bands.get(across.column, ()),
        x_lines=frame.lines.get(across.column, ()),
        notes=frame.notes,
        machine_words=chart.machine_words,
    )


def _lay_down(series: CurveSeries, row: int) -> CurveSeries:
    """Turn the point of a series into one in a row of its own."""
    return CurveSeries(
        series.label, series.style, series.y, np.full(len(series.y), float(row)), series.lower, series.upper,
        is_horizontal=True, stale=series.stale, is_connected=False, setting=series.setting, callouts=series.callouts,
    )  # fmt: skip


def _build_curve(one: ChartSeries, across: ChartAxis, up: ChartAxis, with_callouts: bool) -> CurveSeries | None:
    """Build the curve of a series; None if it lacks a quantity."""
    if across.column not in one.columns or up.column not in one.columns:
        return None
    x, y = (as_numbers(one.columns[axis.column]) for axis in (across, up))
    if not (np.isfinite(x) & np.isfinite(y)).any():
        return None
    intervals = [
        (axis, [as_numbers(one.columns[axis.column + end]) for end in (LOW_SUFFIX, HIGH_SUFFIX)])
        for axis in (up, across)
        if axis.column + LOW_SUFFIX in one.columns
    ]
    along, (lower, upper) = intervals[0] if intervals else (up, (None, None))
    return CurveSeries(
        label=one.label,
        style=one.style,
        x=x,
        y=y,
        lower=lower,
        upper=upper,
        is_horizontal=along is across,
        stale=np.broadcast_to(np.asarray(one.stale, bool), x.shape),
        is_stepped=one.is_stepped,
        is_connected=one.is_connected,
        labels_points=one.labels_points,
        setting=one.setting,
        marker_scale=one.marker_scale,
        has_cross=one.status != "ok",
        callouts=one.callouts if with_callouts else {},
    )


def as_numbers(column: Sequence[Any] | FloatArray) -> FloatArray:
    """Convert a column to an array; a missing value is nan."""
    return np.array([np.nan if value is None else value for value in column], float)
