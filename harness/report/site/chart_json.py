"""Charts for the results page: a chart description as JSON, which `static/chart.js` draws by Plotly.

An item is a series with the columns of its points. It refers to its frame by number, because bands, lines and notes
belong to frames. Axes and styles are in Plotly's terms. Cell maps are tables, which `static/map.js` shows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
from springbench.harness.report.charts.chart_description import (
    ChartAxis,
    ChartDescription,
    ChartFrame,
    ChartSeries,
)
from springbench.harness.report.charts.figure_panels import AxisScale, CellMap, FloatArray
from springbench.harness.report.plot_style import STALE_NOTE, contrasting_text_colour
from springbench.harness.report.site.data_scripts import round_number
from springbench.harness.report.site.plotly_styles import build_plotly_style
from springbench.harness.report.site.run_table import format_references


def serialise_chart(chart: ChartDescription) -> dict[str, Any]:
    """Return a chart as data that can be represented as JSON."""
    pairs = [(number, frame, series) for number, frame in enumerate(chart.frames) for series in frame.series]
    formats = {axis.column: axis.scale.tick_format for axis in (*chart.x, *chart.y)}
    return {
        "title": chart.title,
        "note": chart.note,
        "filters": [chart.subject_key],
        "x": [_describe_axis(axis) for axis in chart.x],
        "y": [_describe_axis(axis, {"autorange": "reversed"}) for axis in chart.y],
        "hover": [[column, words, formats.get(column, "")] for column, words in chart.hover],
        "frames": [_describe_frame(frame) for frame in chart.frames],
        "maps": [_describe_map(one) for one in chart.maps],
        "items": [_describe_series(chart, number, frame, series) for number, frame, series in pairs],
        "styles": {series.label: build_plotly_style(series.style) for *_, series in reversed(pairs)},
        "citations": format_references(chart.citations.items()),
        "command": chart.command,
    }


def _describe_map(cell_map: CellMap) -> dict[str, Any]:
    """Describe a map; a cell refers to its class by number."""
    labels = [outcome.label for outcome in cell_map.outcomes]
    return {
        "title": ", ".join(filter(None, (cell_map.subject, cell_map.title))),
        "outcomes": [
            outcome._asdict() | {"text_color": contrasting_text_colour(outcome.color)} for outcome in cell_map.outcomes
        ],
        "cells": [
            [one.row, one.column, labels.index(one.outcome), one.marked_text, one.reason, one.run_id, one.is_stale]
            for one in cell_map.cells
        ],
    }


def _describe_axis(axis: ChartAxis, names_layout: Mapping[str, Any] = MappingProxyType({})) -> dict[str, Any]:
    """Describe an axis; `names_layout` is added to the layout of an axis of names."""
    layout = _plotly_axis(axis.scale)
    if axis.scale.division == "names":
        layout |= names_layout
    title = ", ".join(filter(None, (axis.scale.label, axis.title)))
    zero = {"shows_zero": True} if axis.scale.division == "iterations" else {}
    return {"column": axis.column, "title": title, "format": axis.scale.tick_format, "axis": layout, **zero}


_TIME_TICKS = {"tickformat": "$~s"}
"""Ticks of a time with SI prefixes, such as 5ms.

The format `$` appends the currency, which the page defines as "s".
"""


def _plotly_axis(scale: AxisScale) -> dict[str, Any]:
    if scale.division == "names":
        return {"type": "category", "categoryarray": list(scale.place_names)}
    ticks = _TIME_TICKS if scale.tick_format == "time" else {}
    if scale.division != "linear":
        return {"type": "log", **ticks, **({"tickmode": "array"} if scale.division == "sizes" else {})}
    if scale.tick_format in ("percent", "strain"):
        return {"tickformat": ".3~%", "rangemode": "tozero"}
    return {**ticks}


def _describe_frame(frame: ChartFrame) -> dict[str, Any]:
    return {
        "notes": [note for note in frame.notes if note != STALE_NOTE],  # the page explains hollow marks by itself
        "x_label": frame.x_label,
        "place_names": {column: list(names) for column, names in frame.place_names.items()},
        "bands": {column: [list(band) for band in bands] for column, bands in frame.bands.items()},
        "lines": {column: [list(line) for line in lines] for column, lines in frame.lines.items()},
    }


def _describe_series(chart: ChartDescription, number: int, frame: ChartFrame, series: ChartSeries) -> dict[str, Any]:
    columns = {name: _describe_column(values) for name, values in series.columns.items()}
    for axis in (*chart.x, *chart.y):
        if axis.scale.division == "names" and axis.column in columns:
            places = series.columns[axis.column]
            names = frame.place_names.get(axis.column, axis.scale.place_names)
            columns[axis.column] = [_find_place_name(names, place) for place in places]
    length = len(next(iter(columns.values())))
    missing = {axis.column: [None] * length for axis in (*chart.x, *chart.y) if axis.column not in columns}
    return {
        "label": series.label,
        "style": build_plotly_style(series.style),
        "description": series.description,
        chart.subject_key: frame.subject,
        "panel": frame.title,
        "frame": number,
        "shape": "hv" if series.is_stepped else "" if series.is_connected else "points",
        "scale": series.marker_scale,
        "stale": np.broadcast_to(np.asarray(series.stale, bool), length).tolist(),
        "status": series.status,
        "callouts": {str(k): words for k, words in series.callouts.items()},
        "parameters": "{}",
        **series.links,
        **columns,
        **missing,
    }


def _find_place_name(names: Sequence[str], place: Any) -> str | None:
    return None if place is None or np.isnan(place) else names[round(float(place))]


def _describe_column(values: Sequence[Any] | FloatArray) -> list[Any]:
    plain = values.tolist() if isinstance(values, np.ndarray) else values
    return [value if isinstance(value, str) else round_number(value) for value in plain]
