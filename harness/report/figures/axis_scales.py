# pyright: reportUnknownMemberType=false
# Matplotlib's stubs do not type most keywords.
"""Axes of figures for print: limits, tick positions and tick labels.

Tick labels do not overlap. Exponents are superscript characters instead of math text, which has a smaller font size.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.ticker import FixedLocator, LogLocator, MaxNLocator, NullLocator
from matplotlib.transforms import Bbox
from springbench.harness.report.accuracy.time_to_accuracy import format_duration
from springbench.harness.report.charts.figure_panels import AxisScale, CurvePlot, FloatArray
from springbench.harness.report.number_format import format_count, format_power, format_quantity
from springbench.harness.report.page_layout import tick_formatter

_SHARED_DIVISIONS = ("log", "iterations", "linear")
"""Divisions of x axes that panels share; sizes are those of a scene."""
_AXIS_MARGIN = 0.06
"""Share of the axis that is empty at each end."""


def frame_size_points(ax: Axes) -> tuple[float, float]:
    """Return width and height of a frame [points]."""
    figure = ax.get_figure(root=True)
    assert figure
    return ax.bbox.width / figure.dpi * 72.0, ax.bbox.height / figure.dpi * 72.0


def _format_percent(value: float) -> str:
    return f"{100 * value:.3g} %".replace("-", "−")


_TICK_FORMATS: dict[str, Callable[[float], str]] = {
    "power": format_power,
    "time": lambda value: format_duration(value) if value else "0",
    "plain": lambda value: format_quantity(value) if abs(value) < 1000 else format_count(round(value)),
    "percent": _format_percent,
    "strain": _format_percent,
}


def set_axis_scales(ax: Axes, panel: CurvePlot, panels: Sequence[CurvePlot]) -> None:
    """Set limits and ticks of both axes.

    Panels of a figure that show the same quantity have the same limits, so that they can be compared.

    Args:
        ax: axes of the panel.
        panel: panel to draw.
        panels: all panels of the figure.
    """
    across = [_data_extent(one)[0] for one in panels if one.x == panel.x and panel.x.division in _SHARED_DIVISIONS]
    up = [_data_extent(one)[1] for one in panels if one.y == panel.y]
    points = np.concatenate(across or [_data_extent(panel)[0]]), np.concatenate(up)
    for axis, scale, values in zip((ax.xaxis, ax.yaxis), (panel.x, panel.y), points, strict=True):
        _AXIS_SETTERS[scale.division](axis, scale, values)
    ax.tick_params(length=2.5, width=0.5, pad=2)


def bar_base(scale: AxisScale) -> float:
    """Return where bars along an axis begin."""
    return 1.0 if scale.division == "log" else 0.0  # from a ratio of 1, so that r and 1 / r are equally long


def _data_extent(panel: CurvePlot) -> tuple[FloatArray, FloatArray]:
    """Return all finite x and y values, including interval ends and marked lines."""
    found: tuple[list[FloatArray], list[FloatArray]] = ([], [])
    for series in panel.series:
        ends = [end for end in (series.lower, series.upper) if end is not None]
        found[0].extend([series.x, *(ends if series.is_horizontal else [])])
        found[1].extend([series.y, *([] if series.is_horizontal else ends)])
    if any(series.is_bar for series in panel.series):
        found[0].append(np.array([bar_base(panel.x)]))
    for values, marked in zip(found, (panel.x_lines, panel.lines), strict=True):
        values.append(np.array([line.value for line in marked], float))
    x, y = (np.concatenate([np.zeros(0), *values]) for values in found)
    return x[np.isfinite(x)], y[np.isfinite(y)]


def _set_log_axis(axis: Axis, scale: AxisScale, values: FloatArray) -> None:
    values = values[values > 0.0]
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.1, 10.0)
    if high < 8.0 * low:  # at least a factor of 8, so that noise does not fill the frame
        low, high = (np.sqrt(low * high / 8.0), np.sqrt(low * high * 8.0))
    room = (high / low) ** _AXIS_MARGIN
    _set_limits(axis, "log", low / room, high * room)
    decades = np.log10(high / low)
    subs = (1.0,) if decades > 2.0 else (1.0, 3.0) if decades > 1.3 else (1.0, 2.0, 5.0)
    axis.set_major_locator(LogLocator(subs=subs, numticks=9 if decades > 2.0 else 12))
    _set_tick_labels(axis, scale)


def _set_size_axis(axis: Axis, scale: AxisScale, values: FloatArray) -> None:
    """Set a logarithmic axis with a tick at each value."""
    _set_log_axis(axis, scale, values)
    axis.set_major_locator(FixedLocator(np.unique(values).tolist()))


def _set_linear_axis(axis: Axis, scale: AxisScale, values: FloatArray) -> None:
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
    if scale.tick_format == "percent" and low >= 0.0 and high <= 1.0:
        low, high = 0.0, 1.0
    room = _AXIS_MARGIN * ((high - low) or 1.0)
    _set_limits(axis, "linear", low - room, high + room)
    axis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
    _set_tick_labels(axis, scale)


def _set_iteration_axis(axis: Axis, scale: AxisScale, values: FloatArray) -> None:
    last = max(float(values.max(initial=10.0)), 10.0)
    # Logarithmic from 1 on, with a linear part that shows iteration 0.
    axis.axes.set_xscale("symlog", linthresh=1.0, linscale=0.35)
    axis.axes.set_xlim(-0.08, 1.2 * last)
    axis.set_major_locator(FixedLocator([0.0, *(10.0**k for k in range(7) if 10.0**k <= last)]))
    _set_tick_labels(axis, scale)


def _set_name_axis(axis: Axis, scale: AxisScale, values: FloatArray) -> None:
    last = len(scale.place_names) - 0.5
    if axis is axis.axes.xaxis:
        axis.axes.set_xlim(-0.5, last)
    else:
        axis.axes.set_ylim(last, -0.5)
    axis.set_major_locator(FixedLocator(range(len(scale.place_names))))
    axis.set_major_formatter(
        tick_formatter(lambda value: scale.place_names[round(value)] if 0 <= value < len(scale.place_names) else "")
    )
    axis.set_minor_locator(NullLocator())


_AXIS_SETTERS: dict[str, Callable[[Axis, AxisScale, FloatArray], None]] = {
    "log": _set_log_axis,
    "sizes": _set_size_axis,
    "linear": _set_linear_axis,
    "iterations": _set_iteration_axis,
    "names": _set_name_axis,
}


def _set_limits(axis: Axis, kind: Any, low: float, high: float) -> None:
    if axis is axis.axes.xaxis:
        axis.axes.set_xscale(kind)
        axis.axes.set_xlim(low, high)
    else:
        axis.axes.set_yscale(kind)
        axis.axes.set_ylim(low, high)


def _set_tick_labels(axis: Axis, scale: AxisScale) -> None:
    axis.set_major_formatter(tick_formatter(_TICK_FORMATS[scale.tick_format]))
    axis.set_minor_locator(NullLocator())


def thin_ticks(ax: Axes) -> None:
    """Remove ticks until their labels do not overlap.

    Every second tick remains, or every third, and so on. The axes must have been drawn.
    """
    for axis in (ax.xaxis, ax.yaxis):
        places = [float(at) for at in np.asarray(axis.get_majorticklocs()) if _is_visible(axis, float(at))]
        for every in range(1, max(2, len(places))):
            axis.set_major_locator(FixedLocator(places[::every]))
            if not _labels_overlap(_label_boxes(axis)):
                break


def _is_visible(axis: Axis, at: float) -> bool:
    low, high = sorted(axis.get_view_interval())
    return low <= at <= high


def _label_boxes(axis: Axis) -> list[Bbox]:
    return [label.get_window_extent() for label in axis.get_ticklabels() if label.get_text() and label.get_visible()]


def _labels_overlap(boxes: Sequence[Bbox]) -> bool:
    """Return whether two neighbouring labels are closer than a gap of 2 pixels."""
    gap = 2.0
    overlaps = (measure_overlap(a, b) for a, b in pairwise(boxes))
    return any(across > -gap and up > 0.0 for across, up in overlaps)


def measure_overlap(one: Bbox, other: Bbox) -> tuple[float, float]:
    """Return the horizontal and vertical overlap of two boxes, negative where there is a gap.

    Args:
        one, other: the boxes, in the same unit.
    """
    return float(min(one.x1, other.x1) - max(one.x0, other.x0)), float(min(one.y1, other.y1) - max(one.y0, other.y0))
