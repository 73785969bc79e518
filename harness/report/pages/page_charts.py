"""Charts of pages as panels: bars by name, lines, and heat maps of shares.

One chart has one message, which its title says. At most a few series have colours and labels; the others are grey.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from springbench.harness.report.charts.figure_panels import (
    AxisScale,
    CellMap,
    CellOutcome,
    CurvePlot,
    CurveSeries,
    FigurePanel,
    MapCell,
    MarkedValue,
)
from springbench.harness.report.plot_style import SeriesStyle

ChartForm = Literal["bars", "lines", "heatmap"]

_ACCENTS = ("#0072b2", "#d55e00", "#00a878", "#cc79a7", "#e69f00", "#7a5fd0")
"""Colours of highlighted series."""
_GREY = SeriesStyle("#c4c7cc", "None")
_OTHERS = "others"
"""Label of the series that are not highlighted."""
_MAX_NAMED_PLACES = 7
"""Largest number of places of a logarithmic x axis that are all written out."""
_SHARE_CLASSES = (
    (0.2, CellOutcome("below 20 %", "#f1efe9")),
    (0.4, CellOutcome("20 to 40 %", "#cfe4d6")),
    (0.6, CellOutcome("40 to 60 %", "#9fd0b8")),
    (0.8, CellOutcome("60 to 80 %", "#5fab88")),
    (np.inf, CellOutcome("80 % and more", "#1f7a55")),
)
"""Upper limits of the classes of shares, and the classes."""


class ChartPoint(NamedTuple):
    """One value of a chart.

    Attributes:
        series: curve, bar, or column of a heat map.
        x: abscissa, or row of a heat map.
        y: value; without one there is no bar, a gap in a line, and an empty cell of a heat map.
        low, high: interval of the value.
    """

    series: str
    x: float | str
    y: float | None
    low: float | None = None
    high: float | None = None


class PageChartOptions(NamedTuple):
    """Options of a chart.

    Attributes:
        x_label, y_label: quantities with units.
        x_scale, y_scale: "log" or "linear"; bars on a logarithmic axis are ratios and start at 1.
        highlights: series in colour; the others are grey. Empty: all of them.
        limit: a value that a line marks, and its meaning.
        is_percentage: whether values are shares, shown in percent; those of heat maps always are.
        notes: sentences below the chart.
    """

    x_label: str = ""
    y_label: str = ""
    x_scale: Literal["log", "linear"] = "linear"
    y_scale: Literal["log", "linear"] = "linear"
    highlights: Sequence[str] = ()
    limit: tuple[float, str] | None = None
    is_percentage: bool = False
    notes: Sequence[str] = ()


def build_page_panel(
    name: str, form: ChartForm, points: Sequence[ChartPoint], options: PageChartOptions
) -> FigurePanel:
    """Build the panel of a chart.

    Args:
        name: name of the picture.
        form: bars by name, lines, or a heat map of shares.
        points: values, in the order of their appearance.
        options: options of the chart.
    """
    build = {"bars": _build_bars, "lines": _build_lines, "heatmap": _build_heat_map}[form]
    return build(name, points, options)


def _build_bars(name: str, points: Sequence[ChartPoint], options: PageChartOptions) -> CurvePlot:
    """Build one horizontal bar per name."""
    known = [point for point in points if point.y is not None]
    return CurvePlot(
        group=("page",),
        name=(name,),
        subject="",
        title="",
        x=AxisScale(options.x_label, options.x_scale, "percent" if options.is_percentage else "plain"),
        y=AxisScale("", "names", place_names=tuple(point.series for point in known)),
        series=[
            CurveSeries(
                point.series,
                SeriesStyle(_ACCENTS[0], "s") if _is_highlighted(point.series, options) else _GREY,
                *(np.array([value], float) for value in (point.y, place, point.low, point.high)),
                is_horizontal=True,
                is_bar=True,
            )
            for place, point in enumerate(known)
        ],
        x_lines=[MarkedValue(*options.limit)] if options.limit else [],
        notes=options.notes,
    )


def _build_lines(name: str, points: Sequence[ChartPoint], options: PageChartOptions) -> CurvePlot:
    """Build one line per series.

    Series that are not highlighted share a label, and are drawn behind the others.
    """
    names = list(dict.fromkeys(point.series for point in points))
    coloured = [one for one in options.highlights or names if one in names]
    series: list[CurveSeries] = []
    for label in sorted(names, key=lambda one: one in coloured):
        own = [point for point in points if point.series == label]
        is_coloured = label in coloured
        style = SeriesStyle(_ACCENTS[coloured.index(label) % len(_ACCENTS)], "o") if is_coloured else _GREY
        x, y = (np.array([getattr(point, key) for point in own], float) for key in ("x", "y"))
        series.append(CurveSeries(label if is_coloured else _OTHERS, style, x, y, setting=label))
    few = len({point.x for point in points}) <= _MAX_NAMED_PLACES
    return CurvePlot(
        group=("page",),
        name=(name,),
        subject="",
        title="",
        x=AxisScale(options.x_label, "sizes" if few and options.x_scale == "log" else options.x_scale),
        y=AxisScale(options.y_label, options.y_scale, "percent" if options.is_percentage else "plain"),
        series=series,
        lines=[MarkedValue(*options.limit)] if options.limit else [],
        notes=options.notes,
    )


def _build_heat_map(name: str, points: Sequence[ChartPoint], options: PageChartOptions) -> CellMap:
    """Build a map of shares: rows are the `x` of the points, columns their series."""
    return CellMap(
        group=("page",),
        name=(name,),
        subject="",
        title="",
        cells=[_build_cell(point) for point in points],
        outcomes=[one for _, one in _SHARE_CLASSES],
        notes=options.notes,
        column_label=options.x_label,
    )


def _build_cell(point: ChartPoint) -> MapCell:
    if point.y is None:
        return MapCell(str(point.x), point.series, "none", "#ffffff", "")
    share = point.y
    outcome = next(one for limit, one in _SHARE_CLASSES if share < limit)
    return MapCell(str(point.x), point.series, outcome.label, outcome.color, f"{100 * share:.0f}")


def _is_highlighted(name: str, options: PageChartOptions) -> bool:
    return not options.highlights or name in options.highlights
