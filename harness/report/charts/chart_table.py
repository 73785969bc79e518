"""The charts of an accuracy measurement by name, for sheets, figures and the results page."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from springbench.harness.report.accuracy.accuracy_data import AccuracyData, without_short_curves
from springbench.harness.report.charts.accuracy_charts import (
    SourceLinks,
    build_convergence_chart,
    build_profile_chart,
    build_scaling_chart,
    build_time_chart,
    build_work_precision_chart,
)
from springbench.harness.report.charts.chart_description import ChartDescription
from springbench.harness.report.charts.engine_chart import build_engine_chart
from springbench.harness.report.charts.liu2013_chart import build_liu2013_chart
from springbench.harness.report.charts.published_curves import (
    COMPARED_CHARTS,
    add_published_curves,
    read_published_data,
)
from springbench.harness.report.charts.winner_chart import build_winner_chart
from springbench.harness.results.published_set import PUBLISHED_FOLDER

ChartBuilder = Callable[[AccuracyData, str | None], ChartDescription]

_BUILDERS: dict[str, ChartBuilder] = {
    "times": build_time_chart,
    "work": build_work_precision_chart,
    "profiles": build_profile_chart,
    "growth": build_scaling_chart,
    "engines": build_engine_chart,
    "winners": build_winner_chart,
}


def build_accuracy_chart(
    name: str,
    everything: AccuracyData,
    newest_fingerprint: str | None = None,
    link_source: SourceLinks = lambda curve: {},
) -> ChartDescription:
    """Build a chart of an accuracy measurement.

    It has no frames and no maps if the rows contain nothing of its kind.

    Args:
        name: name of the chart, one of CHART_NAMES.
        everything: data of an accuracy measurement.
        newest_fingerprint: source fingerprint of the newest rows, others are stale; None for that of this version.
        link_source: returns the links of a curve.
    """
    if name == "liu2013":
        return build_liu2013_chart(everything, newest_fingerprint)
    build = partial(build_convergence_chart, link_source=link_source) if name == "convergence" else _BUILDERS[name]
    return build(without_short_curves(everything), newest_fingerprint)


def build_compared_chart(
    name: str,
    everything: AccuracyData,
    newest_fingerprint: str | None = None,
    link_source: SourceLinks = lambda curve: {},
    published: Path = PUBLISHED_FOLDER,
) -> ChartDescription:
    """Build a chart as `build_accuracy_chart` does, with published curves in grey behind one's own.

    Args:
        name: name of the chart.
        everything: data of an accuracy measurement.
        newest_fingerprint: source fingerprint of the newest rows, others are stale; None for that of this version.
        link_source: returns the links of a curve.
        published: folder of the published set; without one nothing is added.
    """
    chart = build_accuracy_chart(name, everything, newest_fingerprint, link_source)
    if name not in COMPARED_CHARTS:
        return chart
    others = [build_accuracy_chart(name, table) for table in read_published_data(everything, published)]
    return add_published_curves(chart, others)


CHART_NAMES = ("convergence", *_BUILDERS, "liu2013")
"""Names of the charts of an accuracy measurement."""
