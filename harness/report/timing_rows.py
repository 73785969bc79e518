# pyright: reportUnknownMemberType=false
# Matplotlib's stubs do not type most keywords.
"""Times of a scene of one size: one row per solver, the fastest first.

Panels of step and preparation are side by side.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from math import log10

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

from harness.report.page import axes, count, quantity, shorten, text, ticks
from harness.report.style import INK, MUTED, PAGE, Mark
from harness.report.timing_table import RunTimes

HEADINGS = "milliseconds a step", "milliseconds to prepare, once a run: marks warm, bars cold"
"""Headings of the two panels of a scene."""
_SHORT = "ms a step", "ms to prepare"
"""Short headings for narrow panels."""
_TICK = 38.0
"""Width of a tick label [pixels]."""

_ROW, _NAMES, _HEAD, _GAP, _LETTER = 42.0, 0.3, 96.0, 48.0, 8.2
"""Row height [pixels], maximum share of the width for names, space above and between panels [pixels], and letter
width [pixels].
"""


def draw_rows(
    page: Figure,
    scene: str,
    found: Sequence[RunTimes],
    names: Mapping[str, str],
    looks: Mapping[str, Mark],
    box: tuple[float, float, float, float],
    older: Collection[str],
) -> float:
    """Draw two panels within a box (left, top, width, height) [pixels].

    A failed run is a cross with its status. Returns the y position of the lower end [pixels].
    """
    left, top, width, height = box
    here = sorted((run for run in found if run.scene == scene), key=lambda run: (run.step is None, run.step or 0.0))
    size = next(run.vertices for run in here if run.vertices)
    text(page, left, top + 14, shorten(f"{scene}, {count(size)} vertices", int(width / 9)), size=12.5, weight="bold")
    letters = max(len(names[run.run_id]) for run in here)
    start = min(_LETTER * letters + 16.0, _NAMES * width)
    tall = min(_ROW * len(here) + 14.0, height - _HEAD - 40.0)
    each = (width - start - _GAP) / 2.0
    panels = [axes(page, left + start + k * (each + _GAP), top + _HEAD, each, tall) for k in range(2)]
    for k, words in enumerate(HEADINGS if each > 6.6 * max(map(len, HEADINGS)) else _SHORT):
        place = left + start + k * (each + _GAP)
        text(page, place, top + _HEAD - 18, shorten(words, int(each / 6.6)), size=9.5, color=MUTED)
    step, prepare = panels
    for row, run in enumerate(here):
        look = looks[run.solver]
        face = PAGE if run.run_id in older else look.color
        if run.step is not None:
            step.hlines(row, run.lower or run.step, run.upper or run.step, color=look.color, alpha=0.5, linewidth=2.5)
            step.plot(run.step, row, marker=look.marker, ls="", color=look.color, mfc=face, mew=1.5, markersize=8)
        else:
            step.plot(0.02, row, "x", color=look.color, transform=step.get_yaxis_transform(), markersize=8, mew=2)
            where = step.get_yaxis_transform()
            step.text(0.05, row, run.status, color=look.color, transform=where, va="center", fontsize=9)
        for value, marker, size in ((run.cold, "|", 13), (run.warm, look.marker, 7)):
            if value is not None:
                prepare.plot(value, row, marker=marker, ls="", color=look.color, mfc=face, mew=1.5, markersize=size)
    labels = [shorten(names[run.run_id], int(start / _LETTER)) for run in here]
    _scales(step, [v for run in here for v in (run.lower, run.upper) if v], labels, each)
    _scales(prepare, [v for run in here for v in (run.cold, run.warm) if v], [""] * len(here), each)
    return top + _HEAD + tall + 52.0


def _scales(ax: Axes, values: Sequence[float], labels: Sequence[str], width: float) -> None:
    """Set a logarithmic time axis over at least a decade.

    Row names are at the left of the first panel; `width` is in pixels.
    """
    low, high = (min(values), max(values)) if values else (0.1, 10.0)
    reach = max((high / low) ** (1.0 + 40.0 / width) * 1.3, 10.0) ** 0.5
    middle, named = (low * high) ** 0.5, 6.0 * log10(reach)
    ax.set_xscale("log")
    ax.set_xlim(middle / reach, middle * reach)
    ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if named * _TICK < width else (1.0,), numticks=10))
    ax.xaxis.set_major_formatter(ticks(quantity))
    ax.xaxis.set_minor_locator(NullLocator())
    ax.set_ylim(len(labels) - 0.5, -0.5)
    ax.set_yticks(range(len(labels)), labels, color=INK)
    ax.tick_params(length=3, labelsize=9.5)
    ax.tick_params(axis="y", length=0)
    ax.grid(axis="x")
    ax.set_axisbelow(True)
