"""Charts of stored benchmark results by commit, with levels and changes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np
from springbench.harness.report.change_detection import DIRTY_MARK, MIN_RESULTS, BenchmarkHistory, BenchmarkPoint
from springbench.harness.report.charts.chart_description import ChartAxis, ChartDescription, ChartFrame, ChartSeries
from springbench.harness.report.charts.figure_panels import AxisScale
from springbench.harness.report.plot_style import FASTER_COLOUR, MUTED_COLOUR, SLOWER_COLOUR, TEXT_COLOUR, SeriesStyle

RATIO_CHART, TIME_CHART = "benchmarks", "benchmark-times"
"""Names of the charts of ratios to a baseline and of minimum times."""

_CHART_WORDS = {
    RATIO_CHART: ("Benchmarks by commit", AxisScale("times its baseline", "linear", "plain")),
    TIME_CHART: ("Least times by commit", AxisScale("least time", "linear", "time")),
}
_CHART_NOTE = (
    "Stored results of a benchmark with their 95 % intervals, by commit, and the level of each segment of them: where "
    "it changed beyond noise there is a triangle."
)
_RESULTS_STYLE, _LEVEL_STYLE = SeriesStyle(MUTED_COLOUR, "o"), SeriesStyle(TEXT_COLOUR, "None")
_CHANGE_STYLES = {
    "slower from here on": SeriesStyle(SLOWER_COLOUR, "^"),
    "faster from here on": SeriesStyle(FASTER_COLOUR, "v"),
}
_CHANGE_MARKER_SCALE = 1.6


def build_benchmark_chart(name: str, histories: Sequence[BenchmarkHistory]) -> ChartDescription:
    """Build one of the two charts, with a frame for each history of its kind.

    Args:
        name: RATIO_CHART or TIME_CHART.
        histories: benchmark histories; those of the other kind are left out.
    """
    title, scale = _CHART_WORDS[name]
    shown = [one for one in histories if one.is_ratio == (name == RATIO_CHART)]
    machines = Counter(one.benchmark_name for one in shown)
    return ChartDescription(
        title=title,
        note=_CHART_NOTE,
        frames=[_build_frame(one, one.machine_words if machines[one.benchmark_name] > 1 else "") for one in shown],
        x=(ChartAxis("commit", AxisScale("stored results, by commit", "names")),),
        y=(ChartAxis("value", scale),),
        subject_key="benchmark",
        hover=(("commit", "commit"), ("value", scale.label), ("change", "change of the level")),
        machine_words=", ".join(dict.fromkeys(one.machine_words for one in shown)),
        command="pytest tests/bench --benchmark-only",
    )


def _build_frame(history: BenchmarkHistory, title: str) -> ChartFrame:
    changed = [f"{format_level_change(ratio)} at {history.points[at].commit}" for at, ratio in history.level_changes]
    if len(history.points) < MIN_RESULTS:
        found = f"Of fewer than {MIN_RESULTS} results nothing is said."
    else:
        found = f"Changed by {', '.join(changed)}." if changed else "No change beyond noise."
    is_dirty = any(DIRTY_MARK in point.commit for point in history.points)
    return ChartFrame(
        group=(history.benchmark_name,),
        name=("history",),
        subject=history.benchmark_name,
        title=title,
        series=[*_build_series(history)],
        notes=[found, *([f"{DIRTY_MARK}: with changes beyond the commit."] if is_dirty else [])],
        place_names={"commit": _distinguish_commits(history.points)},
    )


def _build_series(history: BenchmarkHistory) -> Iterator[ChartSeries]:
    """Yield the results, the levels of the segments with gaps between them, and the changes."""

    def link_commits(places: Sequence[float]) -> dict[str, object]:
        commits = [None if np.isnan(at) else history.points[round(at)].commit for at in places]
        return {"provenance": [{"commit": commit, "cpu": history.machine_words} for commit in commits]}

    places = [float(at) for at in range(len(history.points))]
    columns = {f"value{end}": [getattr(p, part) for p in history.points] for end, part in _INTERVAL_SUFFIXES}
    yield ChartSeries(
        "results, with their 95 % intervals",
        _RESULTS_STYLE,
        {"commit": places, **columns},
        description=history.benchmark_name,
        is_connected=False,
        links=link_commits(places),
    )
    ends = (*history.segment_starts[1:], len(places))
    across = [x for a, b in zip(history.segment_starts, ends, strict=True) for x in (a - 0.35, b - 0.65, np.nan)]
    levels = [y for level in history.segment_levels for y in (level, level, np.nan)]
    yield ChartSeries(
        "their level",
        _LEVEL_STYLE,
        {"commit": across, "value": levels},
        description=history.benchmark_name,
        links=link_commits(across),
    )
    changes = [
        (*change, level) for change, level in zip(history.level_changes, history.segment_levels[1:], strict=True)
    ]
    for (label, style), is_slower in zip(_CHANGE_STYLES.items(), (True, False), strict=True):
        some = [(float(at), ratio, level) for at, ratio, level in changes if (ratio > 1) == is_slower]
        if some:
            at, ratios, levels = map(list, zip(*some, strict=True))
            yield ChartSeries(
                label,
                style,
                {"commit": at, "value": levels, "change": [format_level_change(ratio) for ratio in ratios]},
                description=history.benchmark_name,
                is_connected=False,
                marker_scale=_CHANGE_MARKER_SCALE,
                links=link_commits(at),
            )


_INTERVAL_SUFFIXES = (("", "value"), ("_low", "low"), ("_high", "high"))


def _distinguish_commits(points: Sequence[BenchmarkPoint]) -> tuple[str, ...]:
    """Return the commits of the points, with a number where a commit was measured repeatedly."""
    seen = Counter[str]()
    names: list[str] = []
    for point in points:
        seen[point.commit] += 1
        names.append(point.commit + (f" ({seen[point.commit]})" if seen[point.commit] > 1 else ""))
    return tuple(names)


def format_level_change(ratio: float) -> str:
    """Format the ratio of a level to the previous one as a change in percent."""
    return f"{100 * (ratio - 1):+.1f} %"
