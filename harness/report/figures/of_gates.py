"""Panels of stored benchmark results by commit, with levels and changes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from harness.report.figures.entry import Entry, ready
from harness.report.figures.panel import Plot, Scale, Series
from harness.report.history import CHANGED, FEWEST, GateHistory, history, stored_files
from harness.report.style import INK, MUTED, Mark

WANTED = f"{FEWEST} stored results of a gate, by `pytest tests/bench --benchmark-only` at as many commits"


def gates(folder: Path) -> list[Entry]:
    """Build a panel for each benchmark with enough results, the largest change first."""
    return ready(_panel(one) for one in history(stored_files([folder])) if len(one.points) >= FEWEST)


def _panel(gate: GateHistory) -> Plot:
    x = np.arange(len(gate.points), dtype=float)
    y, low, high = (np.array([getattr(point, name) for point in gate.points]) for name in ("value", "low", "high"))
    changed = [f"{100 * (ratio - 1):+.1f} % at {gate.points[at].commit}" for at, ratio in gate.changes]
    dirty = [f"{CHANGED}: with changes beyond the commit."] if any(CHANGED in p.commit for p in gate.points) else []
    words, unit = ("times its yardstick", "plain") if gate.ratio else ("least time", "time")
    return Plot(
        *((gate.gate,), ("history",), gate.gate, ""),
        Scale("stored results, by commit", "names", names=tuple(point.commit for point in gate.points)),
        Scale(words, "linear", unit),
        [
            Series("results, with their 95 % intervals", Mark(MUTED, "o"), x, y, low, high, joined=False),
            *_levels(gate, x),
        ],
        notes=[f"Changed by {', '.join(changed)}." if changed else "No change beyond noise.", *dirty],
        machine=gate.machine,
    )


def _levels(gate: GateHistory, x: np.ndarray) -> Iterator[Series]:
    """Build the series of segment levels, with a gap between segments."""
    ends = (*gate.starts[1:], len(x))
    across = [(start - 0.35, end - 0.65, np.nan) for start, end in zip(gate.starts, ends, strict=True)]
    up = [(level, level, np.nan) for level in gate.levels]
    yield Series("their level", Mark(INK, "None"), np.concatenate(across), np.concatenate(up))
