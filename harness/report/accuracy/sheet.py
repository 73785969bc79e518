# pyright: reportUnknownMemberType=false
# Matplotlib's stubs do not type most keywords.
"""What the pictures of accuracy share: a page with one legend at its right, logarithmic axes, notes at its foot."""

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

from harness.base.files import replacing
from harness.report.accuracy.times import duration
from harness.report.page import axes, header, new_page, quantity, save, shorten, text, ticks
from harness.report.style import HEIGHT, INK, MUTED, PAGE, RC, WIDTH, Mark

LEFT, TOP, RIGHT, BOTTOM = 40, 118, 1384, HEIGHT - 34
"""Where panels may be, in pixels; right of it stands the legend."""

_LINE, _NOTES, _LETTERS, _WIDE = 17, 5, 21, 220

_END = 0.04
"""Of an axis: a label so near to its end would stand out."""


@contextmanager
def sheet(stem: Path, title: str, facts: Sequence[str]) -> Generator[Figure]:
    """A page that is saved as `stem`.png and `stem`.svg once it is drawn."""
    stem.parent.mkdir(parents=True, exist_ok=True)
    # The salt makes the same picture the same file.
    with matplotlib.rc_context({**RC, "svg.hashsalt": stem.name}):
        page = new_page()
        header(page, title, facts, letters=84)
        yield page
        save(page, stem.with_suffix(".png"))
        with replacing(stem.with_suffix(".svg")) as partial:
            page.savefig(partial, format="svg", metadata={"Date": None})


def files(stem: Path) -> list[Path]:
    """The files that `sheet` leaves."""
    return [stem.with_suffix(".png"), stem.with_suffix(".svg")]


def line(
    ax: Axes, x: ArrayLike, y: ArrayLike, look: Mark, *, spaced: bool = True, older: ArrayLike = False, **more: Any
) -> None:
    """A solver's line; `spaced` markers keep a distance, as iterates lie dense. older: whether other code measured it,
    or which of its points (k,), whose marks are hollow."""
    hollow = np.broadcast_to(np.asarray(older, bool), np.shape(x))
    every: dict[str, Any] = {"markevery": 0.12} if spaced and np.size(x) > 3 else {}
    more = {"linewidth": 1.5, "markersize": 5 * size(look)} | mark(look, hollow=bool(hollow.all())) | every | more
    ax.plot(x, y, color=look.color, linestyle=look.dash, marker=look.marker, **more)
    if hollow.any() and not hollow.all():
        at = np.asarray(x)[hollow], np.asarray(y)[hollow]
        ax.plot(*at, look.marker, markersize=more["markersize"], **mark(look, hollow=True))


def mark(look: Mark, *, hollow: bool) -> dict[str, Any]:
    """How a marker is filled, and its edge; hollow: of what other code measured."""
    return {"mfc": PAGE, "mec": look.color, "mew": 1.3} if hollow else {"mfc": look.color, "mec": PAGE, "mew": 0.5}


def size(look: Mark) -> float:
    """By how much a marker is enlarged so that all look equally large."""
    return {"*": 1.8, "P": 1.35, "X": 1.35, "p": 1.2, "h": 1.15, "d": 1.2}.get(look.marker, 1.0)


def legend(page: Figure, entries: Mapping[str, Mark], *, below: Sequence[tuple[Line2D | Patch, str]] = ()) -> None:
    """The solvers at the page's right, then other marks and their meanings."""
    handles: list[Line2D | Patch] = [
        Line2D(
            [],
            [],
            color=m.color,
            linestyle=m.dash,
            marker=m.marker,
            lw=1.6,
            ms=7 * size(m),
            mec=PAGE,
            label="\n".join(wrap(name, _LETTERS)),
        )
        for name, m in entries.items()
    ]
    for handle, meaning in below:
        handle.set_label("\n".join(wrap(meaning, _LETTERS)))
        handles.append(handle)
    place = ((RIGHT + 10) / WIDTH, 1 - (TOP + 14) / HEIGHT)
    page.legend(
        handles=handles, loc="upper left", bbox_to_anchor=place, frameon=False, fontsize=9.5, handlelength=3.2,
        labelspacing=0.75, borderaxespad=0.0,
    )  # fmt: skip


def notes(page: Figure, words: Sequence[str]) -> None:
    """What failed or is doubtful, in words at the foot: as many lines as fit, and how many more there are."""
    shown = _lines(words)
    for k, sentence in enumerate(shown):
        y = HEIGHT - 16 - _LINE * (len(shown) - 1 - k)
        text(page, LEFT, y, sentence, size=9, color=MUTED)


def foot(words: Sequence[str]) -> float:
    """The height [pixels] above which panels and their axes' labels must stay for these notes."""
    return BOTTOM - _LINE * len(_lines(words))


def _lines(words: Sequence[str]) -> list[str]:
    """The sentences in lines of the page's width, the first of them in two where there is room."""
    lines = [line for sentence in words for line in wrap(sentence, _WIDE, max_lines=2, placeholder=" …")]
    if len(lines) > _NOTES:
        lines = [shorten(sentence, _WIDE) for sentence in words]
    return lines if len(lines) <= _NOTES else [*lines[: _NOTES - 1], f"and {len(lines) - _NOTES + 1} more"]


def panel(page: Figure, left: float, top: float, width: float, height: float, title: str = "") -> Axes:
    """Axes with a heading."""
    ax = axes(page, left, top, width, height)
    if title:
        text(page, left, top - 8, title, size=10, color=INK)
    ax.tick_params(length=3, labelsize=8.5)
    ax.grid(axis="y")
    ax.set_axisbelow(True)
    return ax


def log_axis(axis: Axis, low: float, high: float, *, unit: str = "power") -> None:
    """A logarithmic axis from low to high; unit: power (of ten), time, plain or percent."""
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
    axis.set_major_formatter(_FORMATTERS[unit])
    axis.set_minor_locator(NullLocator())
    if axis is axis.axes.xaxis:
        _inward(axis.axes)


def _inward(ax: Axes) -> None:
    """Let the labels at the ends of the x axis end there, so that those of two panels side by side do not touch."""
    for tick, at in zip(ax.xaxis.get_major_ticks(), ax.xaxis.get_majorticklocs(), strict=False):
        x = ax.transAxes.inverted().transform(ax.transData.transform((at, ax.get_ylim()[1])))[0]
        tick.label1.set_horizontalalignment("left" if x < _END else "right" if x > 1 - _END else "center")


def iteration_axis(ax: Axes, last: float) -> None:
    """Iterations by logarithms, with a place for the first guess, iteration 0."""
    ax.set_xscale("symlog", linthresh=1.0, linscale=0.35)
    ax.set_xlim(-0.08, 1.15 * max(last, 10.0))
    decades = [10.0**k for k in range(6) if 10.0**k <= max(last, 10.0)]
    ax.xaxis.set_major_locator(FixedLocator([0.0, *decades]))
    ax.xaxis.set_major_formatter(ticks(quantity))
    ax.xaxis.set_minor_locator(NullLocator())
    _inward(ax)


def limits(values: Iterable[float], *, least: float = 0.0, margin: float = 1.3) -> tuple[float, float]:
    """Limits of a logarithmic axis: around all positive and finite values, none of them below `least`."""
    array = np.array([value for value in values if np.isfinite(value) and value > 0.0])
    if not len(array):
        return 0.1, 10.0
    low, high = max(float(array.min()), least) / margin, float(array.max()) * margin
    return (low, high) if high > 10 * low else (np.sqrt(low * high / 10), np.sqrt(low * high * 10))


_FORMATTERS = {
    "power": LogFormatterMathtext(labelOnlyBase=False),
    "time": ticks(duration),
    "plain": ticks(quantity),
    "percent": ticks(lambda value: f"{100 * value:.3g} %"),
}
