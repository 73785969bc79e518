# pyright: reportUnknownMemberType=false
# Matplotlib's stubs do not type most keywords.
"""Plot of a recommendation: all measured candidates, the requested error, and the runners-up."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from harness.report.accuracy.sheet import LEFT, RIGHT, TOP, files, foot, legend, limits, log_axis, mark, notes, panel
from harness.report.accuracy.sheet import sheet as page_of
from harness.report.accuracy.sheet import size as sized
from harness.report.accuracy.times import duration
from harness.report.page import quantity
from harness.report.style import INK, MUTED, RULE, marks

SHOWN = 4
"""Number of runners-up that are described in words."""


class RunnerUp(NamedTuple):
    """A candidate: solver, relative error, wall seconds per simulated second, and its description."""

    solver: str
    error: float
    cost: float
    words: str


def draw_ways(stem: Path, title: str, facts: Sequence[str], points: Sequence[RunnerUp], asked: float) -> list[Path]:
    """Draw the candidates of a recommendation, and return the files.

    The recommended candidate is the first one within the requested error.

    Args:
        stem: path of the files without suffix.
        title: title of the picture.
        facts: phrases below the title.
        points: candidates, the cheapest first.
        asked: relative error.
    """
    within = [point for point in points if point.error <= asked]
    words = [f"recommended: {_told(within[0])}"] if within else []
    words += [f"{k}. runner-up: {_told(point, within[0])}" for k, point in enumerate(within[1 : SHOWN + 1], 1)]
    looks = marks(point.solver for point in points)
    with page_of(stem, title, facts) as page:
        ax = panel(page, LEFT + 62, TOP + 30, RIGHT - LEFT - 82, foot(words) - TOP - 96,
                   "error of the positions, relative to the way from the start")  # fmt: skip
        down = limits([*(point.error for point in points), asked], margin=1.8)
        ax.axhspan(down[0], asked, color=RULE, alpha=0.45, zorder=0, lw=0)
        for point in points:
            look = looks[point.solver]
            style: dict[str, Any] = mark(look, hollow=False) | {"alpha": 1.0 if point.error <= asked else 0.35}
            style |= {"marker": look.marker, "ls": "", "color": look.color, "ms": 6.5 * sized(look)}
            ax.plot(point.cost, point.error, zorder=3, **style)
        for k, point in enumerate(within[: SHOWN + 1]):
            ring: dict[str, Any] = {"mec": INK, "mew": 1.8, "ms": 18} if not k else {"mec": MUTED, "mew": 0.9, "ms": 14}
            ax.plot(point.cost, point.error, "o", mfc="none", zorder=4, **ring)
            ax.annotate(
                "recommended" if not k else str(k), (point.cost, point.error), (0, 10 if k else -22),
                textcoords="offset points", ha="center", fontsize=9, color=INK if not k else MUTED,
            )  # fmt: skip
        log_axis(ax.xaxis, *limits([point.cost for point in points], margin=1.8), unit="time")
        log_axis(ax.yaxis, *down, unit="percent")
        ax.set_xlabel("wall time a simulated second", fontsize=9, loc="left")
        ax.annotate(
            f"asked: {100 * asked:.3g} %", (1.0, asked), (-6, 4), xycoords=("axes fraction", "data"),
            textcoords="offset points", ha="right", fontsize=9, color=MUTED,
        )  # fmt: skip
        legend(page, {solver: looks[solver]._replace(dash="") for solver in dict.fromkeys(p.solver for p in points)})
        notes(page, words)
    return files(stem)


def _told(point: RunnerUp, best: RunnerUp | None = None) -> str:
    times = f", {quantity(point.cost / best.cost)} times as long" if best else ""
    return f"{point.words}: an error of {100 * point.error:.2g} % for {duration(point.cost)} a simulated second{times}"
