"""Chart of the reproduction of Liu et al. 2013: own and published errors."""

from __future__ import annotations

import numpy as np
from springbench.harness.report.accuracy.accuracy_data import AccuracyData, describe_stale_results
from springbench.harness.report.accuracy.liu2013_comparison import (
    LIU2013_FIGURE_2,
    LIU2013_FIGURE_2_NEWTON,
    MAX_ERROR_RATIO,
    PaperComparison,
    compare_with_paper,
    select_long_curves,
    select_own_curves,
)
from springbench.harness.report.charts.accuracy_charts import ACCURACY_COMMAND
from springbench.harness.report.charts.chart_description import ChartAxis, ChartDescription, ChartFrame, ChartSeries
from springbench.harness.report.charts.figure_panels import AxisScale
from springbench.harness.report.plot_style import DASHED_LINE, MUTED_COLOUR, SeriesStyle, assign_label_styles

_OWN_STYLE, _PAPER_STYLE = SeriesStyle("#0072b2", "o"), SeriesStyle(MUTED_COLOUR, "D", DASHED_LINE)
_PAPER_NEWTON_STYLE = SeriesStyle(MUTED_COLOUR, "s", DASHED_LINE)
_FIGURE_2 = "figure 2"


def build_liu2013_chart(table: AccuracyData, newest_fingerprint: str | None = None) -> ChartDescription:
    """Build the chart; it has no frames if no row belongs to the reproduction.

    Args:
        table: data of an accuracy measurement.
        newest_fingerprint: source fingerprint of the newest rows, others are stale; None for that of this version.
    """
    found = compare_with_paper(table)
    frames: list[ChartFrame] = []
    for curve in dict.fromkeys(one.curve for one in found):
        mine = [one for one in found if one.curve == curve]
        parts = curve.replace("figure ", "figure-").replace(" × ", "x").replace(" = ", "").split(", ")
        far = [one for one in mine if not 1 / MAX_ERROR_RATIO <= one.error_ratio <= MAX_ERROR_RATIO]
        frames.append(
            ChartFrame(
                group=(parts[0],),
                name=tuple(parts[1:]),
                subject=curve,
                title="",
                series=[*_build_pair(table, mine), *(_build_other_series(table) if curve == _FIGURE_2 else ())],
                notes=[
                    *(f"Differs by more than {MAX_ERROR_RATIO:g}: {one.description}." for one in far),
                    *describe_stale_results(select_own_curves(table), newest_fingerprint),
                ],
            )
        )
    return ChartDescription(
        title="Liu et al. 2013, reproduced",
        note="Relative error (g − g*) / (g₀ − g*) after iterations of local-global: ours, and as the paper's figures "
        "show it. Their times are of 2012.",
        frames=frames,
        x=(
            ChartAxis("iterations", AxisScale("iterations", "log", "plain"), "iterations"),
            ChartAxis("seconds", AxisScale("wall time, ours and of 2012", "log", "time"), "time"),
        ),
        y=(ChartAxis("error", AxisScale("relative error (g − g*) / (g₀ − g*)", "log", "power")),),
        subject_key="curve",
        hover=(
            *(("iterations", "iterations"), ("error", "relative error"), ("seconds", "wall time")),
            *(("ratio", "ours over theirs"), ("frames", "our frames")),
        ),
        machine_words=", ".join(table.machine_words),
        command=ACCURACY_COMMAND,
    )


def _build_pair(table: AccuracyData, mine: list[PaperComparison]) -> list[ChartSeries]:
    """Build the series of own errors and of the paper's."""
    shared = {"iterations": [one.iterations for one in mine], "ratio": [f"{one.error_ratio:.2g}" for one in mine]}
    own = {**shared, "error": [one.own_error for one in mine], "frames": [one.frames for one in mine]}
    paper = {**shared, "error": [one.published_error for one in mine]}
    if mine[0].curve == _FIGURE_2:
        (curve, *_) = select_long_curves(table)
        at = np.searchsorted(curve.iterations, shared["iterations"], side="right") - 1
        own["seconds"] = np.median(curve.seconds, axis=0)[at].tolist()
        paper["seconds"] = [LIU2013_FIGURE_2[one.iterations][1] for one in mine]
    return [
        ChartSeries("ours", _OWN_STYLE, own, description=mine[0].curve),
        ChartSeries("Liu et al. 2013", _PAPER_STYLE, paper, description=mine[0].curve),
    ]


def _build_other_series(table: AccuracyData) -> list[ChartSeries]:
    """Build the series of the paper's Newton method and of other own solvers."""
    (reference, *_) = select_long_curves(table)
    seconds, errors = zip(*LIU2013_FIGURE_2_NEWTON, strict=True)
    series = [
        ChartSeries("their Newton", _PAPER_NEWTON_STYLE, {"seconds": seconds, "error": errors}, is_connected=False)
    ]
    others = [
        curve
        for curve in table.curves
        if curve.problem is reference.problem
        and curve.initial_guess == reference.initial_guess
        and curve.label != reference.label
        and len(curve.iterations) > 1
    ]
    styles = assign_label_styles((curve.label, curve.solver) for curve in others)
    for curve in others:
        columns = {
            "iterations": curve.iterations[1:],
            "seconds": np.median(curve.seconds, axis=0)[1:],
            "error": np.maximum(curve.gap, curve.problem.roundoff_gap)[1:],
        }
        series.append(ChartSeries(curve.label, styles[curve.label], columns, description=_FIGURE_2))
    return series
