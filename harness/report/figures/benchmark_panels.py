"""Panels of stored benchmark results by commit, with levels and changes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from springbench.harness.report.change_detection import (
    DIRTY_MARK,
    MIN_RESULTS,
    BenchmarkHistory,
    find_stored_files,
    read_histories,
)
from springbench.harness.report.charts.figure_panels import AxisScale, CurvePlot, CurveSeries
from springbench.harness.report.figures.panel_selection import PanelEntry, entries_from_panels
from springbench.harness.report.plot_style import MUTED_COLOUR, TEXT_COLOUR, SeriesStyle

REQUIRED_RESULTS = (
    f"{MIN_RESULTS} stored results of a gate, by `pytest tests/bench --benchmark-only` at as many commits"
)


def benchmark_panels(folder: Path) -> list[PanelEntry]:
    """Build a panel for each benchmark with enough results, the largest change first."""
    return entries_from_panels(
        _build_panel(one) for one in read_histories(find_stored_files([folder])) if len(one.points) >= MIN_RESULTS
    )


def _build_panel(gate: BenchmarkHistory) -> CurvePlot:
    x = np.arange(len(gate.points), dtype=float)
    y, low, high = (np.array([getattr(point, name) for point in gate.points]) for name in ("value", "low", "high"))
    changed = [f"{100 * (ratio - 1):+.1f} % at {gate.points[at].commit}" for at, ratio in gate.level_changes]
    dirty = (
        [f"{DIRTY_MARK}: with changes beyond the commit."] if any(DIRTY_MARK in p.commit for p in gate.points) else []
    )
    words, unit = ("times its yardstick", "plain") if gate.is_ratio else ("least time", "time")
    return CurvePlot(
        *((gate.benchmark_name,), ("history",), gate.benchmark_name, ""),
        AxisScale("stored results, by commit", "names", place_names=tuple(point.commit for point in gate.points)),
        AxisScale(words, "linear", unit),
        [
            CurveSeries(
                "results, with their 95 % intervals",
                SeriesStyle(MUTED_COLOUR, "o"),
                x,
                y,
                low,
                high,
                is_connected=False,
            ),
            *_build_level_series(gate, x),
        ],
        notes=[f"Changed by {', '.join(changed)}." if changed else "No change beyond noise.", *dirty],
        machine_words=gate.machine_words,
    )


def _build_level_series(gate: BenchmarkHistory, x: np.ndarray) -> Iterator[CurveSeries]:
    """Build the series of segment levels, with a gap between segments."""
    ends = (*gate.segment_starts[1:], len(x))
    across = [(start - 0.35, end - 0.65, np.nan) for start, end in zip(gate.segment_starts, ends, strict=True)]
    up = [(level, level, np.nan) for level in gate.segment_levels]
    yield CurveSeries("their level", SeriesStyle(TEXT_COLOUR, "None"), np.concatenate(across), np.concatenate(up))
