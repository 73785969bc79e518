# pyright: reportUnknownMemberType=false
# Matplotlib's stubs do not type most keywords.
"""Plot of `springbench history`: one panel per benchmark with results by commit, levels and changes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from harness.base.files import replacing
from harness.report.history import CHANGED, FEWEST, GateHistory
from harness.report.style import DPI, FASTER, INK, MUTED, RC, SLOWER, WIDTH

MOST = 12
"""Maximum number of panels; the benchmarks with the largest changes are shown."""
_ROW = 190
"""Height of a panel [pixels]."""


def draw_history(found: Sequence[GateHistory], path: Path) -> int:
    """Draw at most MOST benchmarks that have enough results, and return how many were drawn.

    Args:
        found: benchmark histories, the largest change first.
        path: target file; its suffix determines the format, PNG by default.
    """
    shown = [series for series in found if len(series.points) >= FEWEST]
    count = len(shown)
    shown = shown[:MOST]
    columns = 1 if len(shown) < 3 else 2
    rows = -(-len(shown) // columns)
    height = (175 + rows * _ROW) / DPI
    with matplotlib.rc_context(RC):
        figure = Figure((WIDTH / DPI, height), DPI)
        axes = figure.subplots(rows, columns, squeeze=False)
        for axis, series in zip(axes.flat, shown, strict=False):
            _panel(axis, series)
        for axis in axes.flat[len(shown) :]:
            axis.set_axis_off()
        changed = sum(bool(series.changes) for series in shown)
        title = f"{changed} of {count} gates changed" if changed else f"None of {count} gates changed"
        figure.text(0.04, 1 - 0.36 / height, title, fontsize=15, color=INK, weight="bold")
        said = "dots: stored results with their 95 % intervals, by commit; lines: their level, until it changed"
        if any(CHANGED in point.commit for series in shown for point in series.points):
            said += f"; {CHANGED}: with changes beyond the commit"
        figure.text(0.04, 1 - 0.62 / height, said, color=MUTED)
        machines = sorted({series.machine for series in shown})
        figure.text(0.04, 0.14 / height, "; ".join(machines), color=MUTED, fontsize=8)
        figure.subplots_adjust(
            left=0.06, right=0.975, top=1 - 1.3 / height, bottom=0.55 / height, hspace=0.75, wspace=0.14
        )
        with replacing(path) as partial:
            figure.savefig(partial, dpi=DPI, format=path.suffix.lstrip(".").lower() or "png")
    return len(shown)


def _panel(axis: Any, series: GateHistory) -> None:
    unit = 1.0 if series.ratio else 1e3
    values = [unit * point.value for point in series.points]
    low = [unit * (p.value - p.low) for p in series.points]
    high = [unit * (p.high - p.value) for p in series.points]
    axis.errorbar(
        range(len(values)), values, (low, high), fmt="o", ms=4, color=MUTED, ecolor=MUTED, elinewidth=0.9, alpha=0.75
    )
    ends = (*series.starts[1:], len(values))
    for start, end, level in zip(series.starts, ends, series.levels, strict=True):
        axis.plot([start - 0.35, end - 1 + 0.35], [unit * level] * 2, color=INK, lw=1.8, solid_capstyle="round")
    for at, ratio in series.changes:
        color = SLOWER if ratio > 1 else FASTER
        axis.axvline(at - 0.5, color=color, lw=1.0, ls=(0, (4, 2)))
        told = {"xycoords": ("data", "axes fraction"), "textcoords": "offset points", "fontsize": 8.5, "color": color}
        axis.annotate(f"{100 * (ratio - 1):+.1f} %", (at - 0.5, 1.0), xytext=(0, 3), ha="center", va="bottom", **told)
    lowest = min(value - below for value, below in zip(values, low, strict=True))
    highest = max(value + above for value, above in zip(values, high, strict=True))
    room = max(highest - lowest, 0.04 * highest)
    axis.set_ylim(lowest - 0.12 * room, highest + 0.12 * room)
    axis.set_xlim(-0.8, len(values) - 0.2)
    axis.set_title(series.gate, loc="left", fontsize=10.5, pad=18, color=INK)
    axis.set_ylabel("of yardstick" if series.ratio else "ms", fontsize=8.5)
    ticks = _ticks(series)
    axis.set_xticks(ticks, [series.points[k].commit for k in ticks])
    colors = {at: SLOWER if ratio > 1 else FASTER for at, ratio in series.changes}
    for at, label in zip(ticks, axis.get_xticklabels(), strict=True):
        label.set_color(colors.get(at, MUTED))
    axis.yaxis.set_major_locator(MaxNLocator(4))
    axis.tick_params(labelsize=8.5)
    axis.grid(axis="y")
    axis.set_axisbelow(True)


def _ticks(series: GateHistory) -> list[int]:
    """Choose the results whose commits are labelled.

    Changes come first, then the last, the first and others that fit.
    """
    count = len(series.points)
    wanted = [*(at for at, _ in series.changes), count - 1, *range(0, count, max(1, count // 8))]
    ticks = list[int]()
    for at in wanted:
        if all(abs(at - other) >= 0.1 * count for other in ticks):
            ticks.append(at)
    return sorted(ticks)
