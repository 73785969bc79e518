"""Stored benchmark results for the results page, by commit.

Charts show each benchmark's level and its changes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from springbench.harness.errors import InputError
from springbench.harness.report.benchmark_comparison import StoredBenchmarks, read_stored_benchmarks
from springbench.harness.report.change_detection import (
    DIRTY_MARK,
    MIN_RESULTS,
    BenchmarkHistory,
    BenchmarkPoint,
    build_histories,
)
from springbench.harness.report.plot_style import FASTER_COLOUR, MUTED_COLOUR, SLOWER_COLOUR, TEXT_COLOUR, SeriesStyle
from springbench.harness.report.site.data_scripts import round_number, round_numbers
from springbench.harness.report.site.plotly_styles import axis_choice, plotly_style

PrintMessage = Callable[[str], None]
ChartItem = dict[str, Any]

_RESULTS_LABEL, _LEVEL_LABEL = "results", "their level"
_SLOWER_LABEL, _FASTER_LABEL = "slower from here on", "faster from here on"
_SERIES_STYLES = {
    _RESULTS_LABEL: SeriesStyle(MUTED_COLOUR, "o"),
    _LEVEL_LABEL: SeriesStyle(TEXT_COLOUR, "s"),
    _SLOWER_LABEL: SeriesStyle(SLOWER_COLOUR, "^"),
    _FASTER_LABEL: SeriesStyle(FASTER_COLOUR, "v"),
}
_CHART_NOTE = (
    "Stored results of a benchmark with their 95 % intervals, by commit, and the level of each segment of them: where "
    f"it changed beyond noise there is a triangle. Of fewer than {MIN_RESULTS} results nothing is said. "
    f"{DIRTY_MARK}: with changes beyond the commit."
)
_CHART_KINDS = {
    "gates": ("Gates by commit", "times its yardstick"),
    "gate-times": ("Least times by commit", "ms at the least"),
}


def read_benchmark_files(files: Iterable[Path], print_message: PrintMessage) -> list[StoredBenchmarks]:
    """Read stored benchmark results, with a remark on each damaged file."""
    found: list[StoredBenchmarks] = []
    for path in files:
        try:
            found.append(read_stored_benchmarks(path))
        except InputError as error:
            print_message(f"not on the page: {error}")
    return found


def build_benchmark_charts(stored: Sequence[StoredBenchmarks]) -> tuple[dict[str, ChartItem], list[ChartItem]]:
    """Build the charts by their ids, and the findings.

    Charts are of ratios and of times; findings are the changes, the largest first.
    """
    found = build_histories(stored)
    made = {
        name: _build_chart(name, [one for one in found if one.is_ratio == (name == "gates")]) for name in _CHART_KINDS
    }
    return {name: chart for name, chart in made.items() if chart["items"]}, [*_describe_changes(found)]


def collect_benchmark_provenance(stored: Sequence[StoredBenchmarks]) -> list[ChartItem]:
    """Return commits and machines of the results, the newest first."""
    dates: dict[tuple[str, str | None, int], list[str]] = {}
    for one in stored:
        cpu, cores, usable = one.machine_key
        commit = one.commit_info.id + ("-dirty" if one.commit_info.dirty else "")
        dates.setdefault((commit, cpu, usable or cores or 0), []).append(one.datetime)
    items: list[ChartItem] = [
        {"machine_id": None, "cpu": cpu, "cores": cores, "memory_gib": None, "operating_system": None, "commit": commit}
        | {"source_fingerprints": [], "first_started_at": min(when), "last_started_at": max(when), "count": len(when)}
        for (commit, cpu, cores), when in dates.items()
    ]
    return sorted(items, key=lambda one: str(one["last_started_at"]), reverse=True)


def _build_chart(name: str, gate_histories: Sequence[BenchmarkHistory]) -> ChartItem:
    title, words = _CHART_KINDS[name]
    machines = Counter(one.benchmark_name for one in gate_histories)
    return {
        "title": title,
        "note": _CHART_NOTE,
        "filters": ["benchmark"],
        "shape": "points",
        "x": [axis_choice("commit", "commit", {"type": "category"})],
        "y": [axis_choice("value", words, {})],
        "hover": [["commit", "commit"], ["value", words], ["change", "change of the level"]],
        "items": [
            item
            for one in gate_histories
            for item in _build_items(one, one.machine_words if machines[one.benchmark_name] > 1 else "")
        ],
        "styles": {label: plotly_style(mark) for label, mark in _SERIES_STYLES.items()},
        "command": "pytest tests/bench --benchmark-only",
    }


def _build_items(gate: BenchmarkHistory, panel: str) -> Iterable[ChartItem]:
    """Build the chart items of results, level and changes.

    The level has a gap before each change.
    """
    names = _distinct_commits(gate.points)
    scale = 1.0 if gate.is_ratio else 1e3
    same = {"description": gate.benchmark_name, "benchmark": gate.benchmark_name, "panel": panel, "parameters": "{}"}
    ends = {
        f"value{end}": round_numbers(scale * getattr(p, part) for p in gate.points) for end, part in _INTERVAL_SUFFIXES
    }
    yield same | {"label": _RESULTS_LABEL, "commit": names} | ends | _item_provenance(gate, names)
    stretches = list(zip(gate.segment_starts, (*gate.segment_starts[1:], len(names)), gate.segment_levels, strict=True))
    across = [name for start, end, _ in stretches for name in (names[start], names[end - 1], None)]
    upright = [value for *_, level in stretches for value in (round_number(scale * level),) * 2 + (None,)]
    yield (
        same
        | {"label": _LEVEL_LABEL, "commit": across, "value": upright, "joined": True}
        | _item_provenance(gate, across)
    )
    changes = {
        at: (level, ratio) for (at, ratio), level in zip(gate.level_changes, gate.segment_levels[1:], strict=True)
    }
    for label, slower in ((_SLOWER_LABEL, True), (_FASTER_LABEL, False)):
        some = [(at, level, ratio) for at, (level, ratio) in changes.items() if (ratio > 1) == slower]
        if some:
            commits, levels = [names[at] for at, *_ in some], round_numbers(scale * level for _, level, _ in some)
            columns = {"commit": commits, "value": levels, "change": [_format_change(ratio) for *_, ratio in some]}
            yield same | {"label": label, "large": True} | columns | _item_provenance(gate, commits)


def _item_provenance(gate: BenchmarkHistory, commits: Sequence[str | None]) -> ChartItem:
    return {"provenance": [{"commit": commit, "cpu": gate.machine_words} for commit in commits]}


_INTERVAL_SUFFIXES = (("", "value"), ("_low", "low"), ("_high", "high"))


def _distinct_commits(points: Sequence[BenchmarkPoint]) -> list[str]:
    """Return the commits of the points, with a number where a commit was measured repeatedly."""
    seen = Counter[str]()
    names: list[str] = []
    for point in points:
        seen[point.commit] += 1
        names.append(point.commit + (f" ({seen[point.commit]})" if seen[point.commit] > 1 else ""))
    return names


def _describe_changes(gate_histories: Sequence[BenchmarkHistory]) -> Iterable[ChartItem]:
    for one in gate_histories:
        if one.level_changes:
            words = ", then ".join(
                f"{_format_change(ratio)} at {one.points[at].commit}" for at, ratio in one.level_changes
            )
            plot = "gates" if one.is_ratio else "gate-times"
            yield {
                "text": f"{one.benchmark_name} changed by {words}.",
                "plot": plot,
                "filter": {"benchmark": one.benchmark_name},
            }
    known = [one for one in gate_histories if len(one.points) >= MIN_RESULTS]
    still = sum(not one.level_changes for one in known)
    if not gate_histories:
        return
    words = f"{still} of {len(gate_histories)} gates show no change beyond noise."
    if few := len(gate_histories) - len(known):
        words = f"{words[:-1]}; {few} have fewer than the {MIN_RESULTS} results that it takes to tell."
    yield {"text": words}


def _format_change(ratio: float) -> str:
    return f"{100 * (ratio - 1):+.1f} %"
