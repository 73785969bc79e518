# pyright: reportUnknownMemberType=false
# Matplotlib's stubs do not type most keywords.
"""Shared layout of accuracy plots.

A page has one legend at the right, logarithmic axes, and notes at the foot.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from textwrap import wrap
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FixedLocator, LogFormatterMathtext, LogLocator, NullLocator
from numpy.typing import ArrayLike
from springbench.harness.atomic_files import atomic_write
from springbench.harness.report.accuracy.time_to_accuracy import format_duration
from springbench.harness.report.number_format import format_quantity, shorten_words
from springbench.harness.report.page_layout import add_axes, draw_header, draw_text, new_page, save_page, tick_formatter
from springbench.harness.report.plot_style import (
    BACKGROUND_COLOUR,
    MUTED_COLOUR,
    PAGE_HEIGHT,
    PAGE_RC,
    PAGE_WIDTH,
    TEXT_COLOUR,
    SeriesStyle,
)

PANEL_LEFT, PANEL_TOP, PANEL_RIGHT, PANEL_BOTTOM = 40, 118, 1384, PAGE_HEIGHT - 34
"""Area of the panels [pixels]; the legend is to the right of it."""

_LINE_HEIGHT, _MAX_NOTES, _LEGEND_LETTERS, _NOTE_LETTERS = 17, 5, 21, 220

_END_MARGIN = 0.04
"""Share of an axis: a label closer to its end than this would extend beyond it."""


@contextmanager
def plot_sheet(stem: Path, title: str, facts: Sequence[str]) -> Generator[Figure]:
    """Yield a page that is saved as `stem`.png and `stem`.svg after drawing.

    Args:
        stem: path of the files without suffix.
        title: title of the page.
        facts: phrases below the title.
    """
    stem.parent.mkdir(parents=True, exist_ok=True)
    # The salt makes SVG ids, and thus files of equal pictures, reproducible.
    with matplotlib.rc_context({**PAGE_RC, "svg.hashsalt": stem.name}):
        page = new_page()
        draw_header(page, title, facts, max_letters=84)
        yield page
        save_page(page, stem.with_suffix(".png"))
        with atomic_write(stem.with_suffix(".svg")) as partial:
            page.savefig(partial, format="svg", metadata={"Date": None})


def sheet_paths(stem: Path) -> list[Path]:
    """Return the paths of the files that `plot_sheet` writes."""
    return [stem.with_suffix(".png"), stem.with_suffix(".svg")]


def draw_line(
    ax: Axes,
    x: ArrayLike,
    y: ArrayLike,
    style: SeriesStyle,
    *,
    spaced_markers: bool = True,
    stale: ArrayLike = False,
    **line_options: Any,
) -> None:
    """Draw a solver's line.

    Args:
        ax: axes.
        x, y: points (k,).
        style: style of the line and its markers.
        spaced_markers: whether markers keep a distance, for dense iterates.
        stale: whether other code than the current version measured it, in total or per point (k,); such markers are
            hollow.
        **line_options: further keywords of `Axes.plot`.
    """
    hollow = np.broadcast_to(np.asarray(stale, bool), np.shape(x))
    every: dict[str, Any] = {"markevery": 0.12} if spaced_markers and np.size(x) > 3 else {}
    more: dict[str, Any] = (
        {"linewidth": 1.5, "markersize": 5 * marker_scale(style)}
        | sheet_marker_style(style, is_stale=bool(hollow.all()))
        | every
        | line_options
    )
    ax.plot(x, y, color=style.color, linestyle=style.dash, marker=style.marker, **more)
    if hollow.any() and not hollow.all():
        at = np.asarray(x)[hollow], np.asarray(y)[hollow]
        ax.plot(*at, style.marker, markersize=more["markersize"], **sheet_marker_style(style, is_stale=True))


def sheet_marker_style(style: SeriesStyle, *, is_stale: bool) -> dict[str, Any]:
    """Return the fill and edge of a marker, hollow for stale results."""
    return (
        {"mfc": BACKGROUND_COLOUR, "mec": style.color, "mew": 1.3}
        if is_stale
        else {"mfc": style.color, "mec": BACKGROUND_COLOUR, "mew": 0.5}
    )


def marker_scale(style: SeriesStyle) -> float:
    """Return the factor that makes all markers appear equally large."""
    return {"*": 1.8, "P": 1.35, "X": 1.35, "p": 1.2, "h": 1.15, "d": 1.2}.get(style.marker, 1.0)


def draw_legend(
    page: Figure, entries: Mapping[str, SeriesStyle], *, extra_entries: Sequence[tuple[Line2D | Patch, str]] = ()
) -> None:
    """Draw the legend at the right: solvers first, then other marks."""
    handles: list[Line2D | Patch] = [
        Line2D(
            [],
            [],
            color=m.color,
            linestyle=m.dash,
            marker=m.marker,
            lw=1.6,
            ms=7 * marker_scale(m),
            mec=BACKGROUND_COLOUR,
            label="\n".join(wrap(name, _LEGEND_LETTERS)),
        )
        for name, m in entries.items()
    ]
    for handle, meaning in extra_entries:
        handle.set_label("\n".join(wrap(meaning, _LEGEND_LETTERS)))
        handles.append(handle)
    place = ((PANEL_RIGHT + 10) / PAGE_WIDTH, 1 - (PANEL_TOP + 14) / PAGE_HEIGHT)
    page.legend(
        handles=handles, loc="upper left", bbox_to_anchor=place, frameon=False, fontsize=9.5, handlelength=3.2,
        labelspacing=0.75, borderaxespad=0.0,
    )  # fmt: skip


def draw_notes(page: Figure, words: Sequence[str]) -> None:
    """Draw notes on failures and doubts at the foot.

    As many lines are drawn as fit, with the number of further ones.
    """
    shown = _wrap_notes(words)
    for k, sentence in enumerate(shown):
        y = PAGE_HEIGHT - 16 - _LINE_HEIGHT * (len(shown) - 1 - k)
        draw_text(page, PANEL_LEFT, y, sentence, size=9, color=MUTED_COLOUR)


def notes_top(words: Sequence[str]) -> float:
    """Return the y position [pixels] above the area of these notes.

    Panels and their axis labels must stay above it.
    """
    return PANEL_BOTTOM - _LINE_HEIGHT * len(_wrap_notes(words))


def _wrap_notes(words: Sequence[str]) -> list[str]:
    """Wrap the notes to the page's width.

    Each note gets up to two lines if there is space for all.
    """
    lines = [line for sentence in words for line in wrap(sentence, _NOTE_LETTERS, max_lines=2, placeholder=" …")]
    if len(lines) > _MAX_NOTES:
        lines = [shorten_words(sentence, _NOTE_LETTERS) for sentence in words]
    return lines if len(lines) <= _MAX_NOTES else [*lines[: _MAX_NOTES - 1], f"and {len(lines) - _MAX_NOTES + 1} more"]


def add_panel(page: Figure, left: float, top: float, width: float, height: float, title: str = "") -> Axes:
    """Add axes with a heading."""
    ax = add_axes(page, left, top, width, height)
    if title:
        draw_text(page, left, top - 8, title, size=10, color=TEXT_COLOUR)
    ax.tick_params(length=3, labelsize=8.5)
    ax.grid(axis="y")
    ax.set_axisbelow(True)
    return ax


def format_log_axis(axis: Axis, low: float, high: float, *, unit: str = "power") -> None:
    """Format a logarithmic axis.

    Args:
        axis: axis to format.
        low, high: limits.
        unit: format of the tick labels: power (of ten), time, plain or percent.
    """
    if axis is axis.axes.xaxis:
        axis.axes.set_xscale("log")
        axis.axes.set_xlim(low, high)
    else:
        axis.axes.set_yscale("log")
        axis.axes.set_ylim(low, high)
    decades = np.log10(high / low)
    subs = (1.0,) if decades > 2.2 else (1.0, 3.0) if decades > 1.2 else (1.0, 2.0, 5.0)
    most = 12 if decades <= 2.2 else 4 if unit == "plain" and decades > 4.0 else 7  # 1 000 and 10 000 take their room
    axis.set_major_locator(LogLocator(subs=subs, numticks=most))
    axis.set_major_formatter(_TICK_FORMATTERS[unit])
    axis.set_minor_locator(NullLocator())
    if axis is axis.axes.xaxis:
        _align_end_labels(axis.axes)


def _align_end_labels(ax: Axes) -> None:
    """Align the labels at the ends of the x-axis inwards.

    Otherwise those of neighbouring panels would overlap.
    """
    for tick, at in zip(ax.xaxis.get_major_ticks(), ax.xaxis.get_majorticklocs(), strict=False):
        x = ax.transAxes.inverted().transform(ax.transData.transform((at, ax.get_ylim()[1])))[0]
        tick.label1.set_horizontalalignment("left" if x < _END_MARGIN else "right" if x > 1 - _END_MARGIN else "center")


def format_iteration_axis(ax: Axes, last: float) -> None:
    """Format a logarithmic axis of iterations that includes the initial guess, iteration 0."""
    ax.set_xscale("symlog", linthresh=1.0, linscale=0.35)
    ax.set_xlim(-0.08, 1.15 * max(last, 10.0))
    decades = [10.0**k for k in range(6) if 10.0**k <= max(last, 10.0)]
    ax.xaxis.set_major_locator(FixedLocator([0.0, *decades]))
    ax.xaxis.set_major_formatter(tick_formatter(format_quantity))
    ax.xaxis.set_minor_locator(NullLocator())
    _align_end_labels(ax)


def log_limits(values: Iterable[float], *, lower_bound: float = 0.0, margin: float = 1.3) -> tuple[float, float]:
    """Return limits of a logarithmic axis around all positive finite values, at least `lower_bound`.

    Args:
        values: values to include.
        lower_bound: minimum of the smallest value.
        margin: factor between the extreme values and the limits.
    """
    array = np.array([value for value in values if np.isfinite(value) and value > 0.0])
    if not len(array):
        return 0.1, 10.0
    low, high = max(float(array.min()), lower_bound) / margin, float(array.max()) * margin
    return (low, high) if high > 10 * low else (np.sqrt(low * high / 10), np.sqrt(low * high * 10))


_TICK_FORMATTERS = {
    "power": LogFormatterMathtext(labelOnlyBase=False),
    "time": tick_formatter(format_duration),
    "plain": tick_formatter(format_quantity),
    "percent": tick_formatter(lambda value: f"{100 * value:.3g} %"),
}
