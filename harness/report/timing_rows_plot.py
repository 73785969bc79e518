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
from springbench.harness.report.number_format import format_count, format_quantity, shorten_words
from springbench.harness.report.page_layout import add_axes, draw_text, tick_formatter
from springbench.harness.report.plot_style import BACKGROUND_COLOUR, MUTED_COLOUR, TEXT_COLOUR, SeriesStyle
from springbench.harness.report.timing_table import RunTimes

PANEL_TITLES = "milliseconds a step", "milliseconds to prepare, once a run: marks warm, bars cold"
"""Headings of the two panels of a scene."""
_SHORT_TITLES = "ms a step", "ms to prepare"
"""Short headings for narrow panels."""
_TICK_WIDTH = 38.0
"""Width of a tick label [pixels]."""

_ROW_HEIGHT, _MAX_NAME_SHARE, _HEAD_HEIGHT, _PANEL_GAP, _LETTER_WIDTH = 42.0, 0.3, 96.0, 48.0, 8.2
"""Row height [pixels], maximum share of the width for names, space above and between panels [pixels], and letter
width [pixels].
"""


def draw_timing_rows(
    page: Figure,
    scene: str,
    timed_runs: Sequence[RunTimes],
    names: Mapping[str, str],
    styles: Mapping[str, SeriesStyle],
    box: tuple[float, float, float, float],
    stale_ids: Collection[str],
) -> float:
    """Draw two panels within a box (left, top, width, height) [pixels].

    A failed run is a cross with its status. Returns the y position of the lower end [pixels].
    """
    left, top, width, height = box
    here = sorted(
        (run for run in timed_runs if run.scene == scene), key=lambda run: (run.step is None, run.step or 0.0)
    )
    size = next(run.vertices for run in here if run.vertices)
    draw_text(
        page,
        left,
        top + 14,
        shorten_words(f"{scene}, {format_count(size)} vertices", int(width / 9)),
        size=12.5,
        weight="bold",
    )
    letters = max(len(names[run.run_id]) for run in here)
    start = min(_LETTER_WIDTH * letters + 16.0, _MAX_NAME_SHARE * width)
    tall = min(_ROW_HEIGHT * len(here) + 14.0, height - _HEAD_HEIGHT - 40.0)
    each = (width - start - _PANEL_GAP) / 2.0
    panels = [add_axes(page, left + start + k * (each + _PANEL_GAP), top + _HEAD_HEIGHT, each, tall) for k in range(2)]
    for k, words in enumerate(PANEL_TITLES if each > 6.6 * max(map(len, PANEL_TITLES)) else _SHORT_TITLES):
        place = left + start + k * (each + _PANEL_GAP)
        draw_text(
            page, place, top + _HEAD_HEIGHT - 18, shorten_words(words, int(each / 6.6)), size=9.5, color=MUTED_COLOUR
        )
    step, prepare = panels
    for row, run in enumerate(here):
        look = styles[run.solver]
        face = BACKGROUND_COLOUR if run.run_id in stale_ids else look.color
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
    labels = [shorten_words(names[run.run_id], int(start / _LETTER_WIDTH)) for run in here]
    _format_axes(step, [v for run in here for v in (run.lower, run.upper) if v], labels, each)
    _format_axes(prepare, [v for run in here for v in (run.cold, run.warm) if v], [""] * len(here), each)
    return top + _HEAD_HEIGHT + tall + 52.0


def _format_axes(ax: Axes, values: Sequence[float], labels: Sequence[str], width: float) -> None:
    """Set a logarithmic time axis over at least a decade.

    Row names are at the left of the first panel; `width` is in pixels.
    """
    low, high = (min(values), max(values)) if values else (0.1, 10.0)
    reach = max((high / low) ** (1.0 + 40.0 / width) * 1.3, 10.0) ** 0.5
    middle, named = (low * high) ** 0.5, 6.0 * log10(reach)
    ax.set_xscale("log")
    ax.set_xlim(middle / reach, middle * reach)
    ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if named * _TICK_WIDTH < width else (1.0,), numticks=10))
    ax.xaxis.set_major_formatter(tick_formatter(format_quantity))
    ax.xaxis.set_minor_locator(NullLocator())
    ax.set_ylim(len(labels) - 0.5, -0.5)
    ax.set_yticks(range(len(labels)), labels, color=TEXT_COLOUR)
    ax.tick_params(length=3, labelsize=9.5)
    ax.tick_params(axis="y", length=0)
    ax.grid(axis="x")
    ax.set_axisbelow(True)
