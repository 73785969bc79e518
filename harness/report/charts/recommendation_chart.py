"""Chart of a recommendation: all measured candidates, the requested error or time, and the runners-up."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from springbench.harness.report.accuracy.time_to_accuracy import format_duration
from springbench.harness.report.charts.accuracy_charts import COST_LABEL, ERROR_LABEL
from springbench.harness.report.charts.chart_description import ChartAxis, ChartDescription, ChartFrame, ChartSeries
from springbench.harness.report.charts.figure_panels import AxisScale, MarkedValue, ShadedBand
from springbench.harness.report.number_format import format_quantity
from springbench.harness.report.plot_style import SeriesStyle, assign_solver_styles

MAX_RUNNERS_UP = 4
"""Number of runners-up that are described in words."""
MAX_SHOWN_ERROR = 10.0
"""Relative error above which a candidate is not drawn: its motion is unstable, and would compress all others."""


class CandidatePoint(NamedTuple):
    """A candidate: solver, relative error, wall seconds per simulated second, and its description."""

    solver: str
    error: float
    seconds_per_simulated_second: float
    description: str


class RecommendationLimits(NamedTuple):
    """What a candidate must not exceed.

    Attributes:
        error: relative error; None where a cost is given.
        cost: wall seconds per simulated second; None where an error is given.
    """

    error: float | None
    cost: float | None = None

    def is_within(self, point: CandidatePoint) -> bool:
        """Return whether a candidate exceeds no limit."""
        return (self.error is None or point.error <= self.error) and (
            self.cost is None or point.seconds_per_simulated_second <= self.cost
        )


def build_recommendation_chart(
    title: str, facts: Sequence[str], points: Sequence[CandidatePoint], limits: RecommendationLimits
) -> ChartDescription:
    """Build the chart of the candidates of a recommendation.

    The recommended candidate is the cheapest one within the requested error, or the most accurate one within the cost.

    Args:
        title: title of the chart.
        facts: phrases about the search.
        points: candidates, the cheapest first.
        limits: requested error or cost.
    """
    shown = [point for point in points if point.error <= MAX_SHOWN_ERROR] or list(points)
    if len(shown) < len(points):
        hidden = len(points) - len(shown)
        facts = [*facts, f"{hidden} unstable setting{'s' if hidden > 1 else ''} not shown"]
    ranked = [point for point in shown if limits.is_within(point)]
    if limits.error is None:
        ranked.sort(key=lambda point: point.error)
    ranked = ranked[: MAX_RUNNERS_UP + 1]
    styles = assign_solver_styles(point.solver for point in points)
    lines = {
        "error": [MarkedValue(limits.error, f"requested: {100 * limits.error:.3g} %")] if limits.error else [],
        "seconds": [MarkedValue(limits.cost, f"budget: {format_duration(limits.cost)}")] if limits.cost else [],
    }
    frame = ChartFrame(
        group=("recommendation",),
        name=("candidates",),
        subject="",
        title="",
        series=[
            _build_series(solver, [point for point in shown if point.solver == solver], styles[solver], ranked)
            for solver in dict.fromkeys(point.solver for point in shown)
        ],
        bands={name: [ShadedBand(0.0, one.value, "") for one in marked] for name, marked in lines.items()},
        lines=lines,
        notes=["; ".join(facts) + ".", *_describe_ranking(ranked, is_cheapest=limits.error is not None)],
    )
    return ChartDescription(
        title=title,
        note="Candidates in the shaded range are within the request.",
        frames=[frame],
        x=(ChartAxis("seconds", AxisScale(COST_LABEL, "log", "time")),),
        y=(ChartAxis("error", AxisScale(ERROR_LABEL, "log", "percent")),),
        hover=(("candidate", "candidate"), ("error", "relative error"), ("seconds", "seconds a simulated second")),
        command="springbench recommend SCENE",
    )


def _build_series(
    solver: str, points: Sequence[CandidatePoint], style: SeriesStyle, ranked: Sequence[CandidatePoint]
) -> ChartSeries:
    ranks = {k: ranked.index(point) for k, point in enumerate(points) if point in ranked}
    return ChartSeries(
        solver,
        style,
        {
            "seconds": [point.seconds_per_simulated_second for point in points],
            "error": [point.error for point in points],
            "candidate": [point.description for point in points],
        },
        is_connected=False,
        callouts={k: str(rank) if rank else "recommended" for k, rank in ranks.items()},
    )


def _describe_ranking(ranked: Sequence[CandidatePoint], *, is_cheapest: bool) -> list[str]:
    """Describe the recommended candidate and the runners-up.

    With `is_cheapest`, times of the runners-up relative to it are included.
    """
    sentences: list[str] = []
    for k, point in enumerate(ranked):
        cost = point.seconds_per_simulated_second
        ratio = format_quantity(cost / ranked[0].seconds_per_simulated_second)
        times = f", {ratio} times as long" if k and is_cheapest else ""
        name = f"Runner-up {k}" if k else "Recommended"
        words = f"an error of {100 * point.error:.2g} % for {format_duration(cost)} a simulated second{times}"
        sentences.append(f"{name}: {point.description}: {words}.")
    return sentences
