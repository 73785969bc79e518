"""Stored benchmark results for the results page: charts, findings and provenance."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from springbench.harness.errors import InputError
from springbench.harness.report.benchmark_comparison import StoredBenchmarks, read_stored_benchmarks
from springbench.harness.report.change_detection import MIN_RESULTS, BenchmarkHistory, build_histories
from springbench.harness.report.charts.benchmark_chart import (
    RATIO_CHART,
    TIME_CHART,
    build_benchmark_chart,
    format_level_change,
)
from springbench.harness.report.site.chart_json import serialise_chart

PrintMessage = Callable[[str], None]
ChartItem = dict[str, Any]


def read_benchmark_files(files: Iterable[Path], print_message: PrintMessage) -> list[StoredBenchmarks]:
    """Read stored benchmark results, with a remark on each damaged file.

    Args:
        files: files of pytest-benchmark.
        print_message: prints a remark.

    Returns:
        The results of the undamaged files, in their order.
    """
    found: list[StoredBenchmarks] = []
    for path in files:
        try:
            found.append(read_stored_benchmarks(path))
        except InputError as error:
            print_message(f"not on the page: {error}")
    return found


def build_benchmark_charts(stored: Sequence[StoredBenchmarks]) -> tuple[dict[str, ChartItem], list[ChartItem]]:
    """Build the charts by their ids, and the findings.

    The charts show ratios and times. The findings are the changes, the largest first.
    """
    found = build_histories(stored)
    made = {name: serialise_chart(build_benchmark_chart(name, found)) for name in (RATIO_CHART, TIME_CHART)}
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


def _describe_changes(histories: Sequence[BenchmarkHistory]) -> Iterable[ChartItem]:
    for one in histories:
        if one.level_changes:
            words = ", then ".join(
                f"{format_level_change(ratio)} at {one.points[at].commit}" for at, ratio in one.level_changes
            )
            plot = RATIO_CHART if one.is_ratio else TIME_CHART
            yield {
                "text": f"{one.benchmark_name} changed by {words}.",
                "plot": plot,
                "filter": {"benchmark": one.benchmark_name},
            }
    known = [one for one in histories if len(one.points) >= MIN_RESULTS]
    still = sum(not one.level_changes for one in known)
    if not histories:
        return
    words = f"{still} of {len(histories)} benchmarks show no change beyond noise."
    if few := len(histories) - len(known):
        words = f"{words[:-1]}; {few} have fewer than the {MIN_RESULTS} results that a verdict needs."
    yield {"text": words}
