# pyright: reportUnknownMemberType=false
# Matplotlib's stubs do not type most keywords.
"""Direct labels to the right of curve ends, where they fit.

They replace a legend.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.text import Annotation, Text

from harness.report.figures.asked import Asked
from harness.report.figures.panel import Panel, Plot, Series
from harness.report.figures.scales import in_points

_MOST, _SHARE = 9, 0.3
"""Maximum number of labels of a frame, and maximum share of the width for them."""
_BESIDE = 7.0
"""Distance from the frame to the labels [points]."""


def label_directly(axes: Sequence[Axes], panels: Sequence[Panel], asked: Asked) -> bool:
    """Add labels to curve ends or points; return whether they make a legend unnecessary.

    Args:
        axes: axes of the panels.
        panels: panels of the figure; only a single one gets direct labels.
        asked: options of the figure.
    """
    panel = panels[0]
    if len(panels) > 1 or not isinstance(panel, Plot):
        return False
    if panel.y.kind == "names":
        return True
    known = [series for series in panel.series if len(_end(series))]
    letters = max((len(series.label) for series in known), default=0)
    wide = 0.6 * asked.small * letters + _BESIDE
    tall = asked.width / 25.4 * 72.0 * panel.aspect * 0.8
    named = any(series.named for series in panel.series)
    fits = len(known) * 1.3 * asked.small <= tall and wide <= _SHARE * asked.width / 25.4 * 72.0
    if named and not fits:
        _name_points(axes[0], panel.series, asked)
        return True
    if not fits or not known or (not named and (panel.bands or len(known) > _MOST)):
        return False
    _Names(axes[0], known, asked)
    return True


def _end(series: Series) -> list[float]:
    known = np.isfinite(series.x) & np.isfinite(series.y)
    return [float(series.x[known][-1]), float(series.y[known][-1])] if known.any() else []


class _Names:
    """Labels at the curve ends of one frame.

    They are created before the layout, which reserves space for them, and positioned after it.
    """

    def __init__(self, ax: Axes, known: Sequence[Series], asked: Asked) -> None:
        self._ax, self._gap = ax, 1.25 * asked.small
        self._ends = [_end(series) for series in known]
        self._names: list[Text] = []
        for series, (x, y) in zip(known, self._ends, strict=True):
            line = {"arrowstyle": "-", "color": series.look.color, "alpha": 0.5, "linewidth": 0.5, "shrinkA": 0}
            name = ax.annotate(
                series.label, (x, y), (1.0, 0.5), textcoords="axes fraction", va="center", fontsize=asked.small,
                color=_dark(series.look.color), arrowprops=line | {"shrinkB": 2.5, "relpos": (0.0, 0.5)},
                annotation_clip=False,
            )  # fmt: skip
            name.set_position((self._beside(), 0.5))
            self._names.append(name)
        setattr(self._names[0], "settle", self.settle)  # noqa: B010 no attribute of Text: done after the layout

    def _beside(self) -> float:
        """Return the x position of the labels, in units of the frame's width."""
        width, _ = in_points(self._ax)
        return 1.0 + _BESIDE / width

    def settle(self) -> None:
        """Move the labels to the heights of their curve ends, and apart."""
        ax = self._ax
        _, points = in_points(ax)
        wanted = [ax.transAxes.inverted().transform(ax.transData.transform(end))[1] * points for end in self._ends]
        order = np.argsort(wanted)
        at = apart([wanted[k] for k in order], self._gap, points)
        beside = self._beside()
        for k, height in zip(order, at, strict=True):
            self._names[k].set_position((beside, height / points))


def apart(wanted: Sequence[float], gap: float, top: float) -> list[float]:
    """Spread sorted heights to be at least `gap` apart, with small displacements.

    Args:
        wanted: preferred heights, ascending.
        gap: minimum distance.
        top: upper limit, exceeded only if the space from 0 is too small.
    """
    at = list(wanted)
    for _ in range(60):
        for k in range(1, len(at)):
            short = gap - (at[k] - at[k - 1])
            if short > 0.0:
                at[k - 1], at[k] = at[k - 1] - short / 2.0, at[k] + short / 2.0
    shift = max(0.0, -at[0]) - max(0.0, at[-1] - top)
    at = [height + shift for height in at]
    for k in range(1, len(at)):
        at[k] = max(at[k], at[k - 1] + gap)
    return at


def _dark(color: str) -> str:
    """Darken a colour until small text in it is readable on white."""
    from matplotlib.colors import to_rgb

    from harness.report.style import shade

    while sum(w * part for w, part in zip((0.3, 0.6, 0.1), to_rgb(color), strict=True)) > 0.5:
        color = shade(color, -0.12)
    return color


def _name_points(ax: Axes, series: Sequence[Series], asked: Asked) -> None:
    """Label single points without overlap.

    A label is on a side of its point where it overlaps no other label and no other point.
    """
    for one in series:
        for x, y in zip(one.x, one.y, strict=True):
            name = ax.annotate(
                one.label, (x, y), (5, 0), textcoords="offset points", va="center", fontsize=asked.small,
                annotation_clip=False,
            )  # fmt: skip
            setattr(name, "settle", lambda name=name: _place(ax, name))  # noqa: B010 as above


_SIDES: tuple[tuple[float, float, Any], ...] = tuple(
    (dx * far, dy * far, ha)
    for far in (1.0, 2.0, 3.0)
    for dx, dy, ha in (
        (5, 0, "left"),
        (-5, 0, "right"),
        (4, 6, "left"),
        (4, -6, "left"),
        (-4, 6, "right"),
        (-4, -6, "right"),
    )
)


def _place(ax: Axes, name: Annotation) -> None:
    """Place a label on the first side without overlap.

    There it is inside the frame and overlaps no earlier label or point.
    """
    before = [other for other in ax.texts[: ax.texts.index(name)] if isinstance(other, Annotation)]
    taken = [other.get_window_extent() for other in before]
    points = [ax.transData.transform(line.get_xydata()) for line in ax.lines if line.get_marker() not in ("None", "")]
    marks = np.concatenate([np.zeros((0, 2)), *points])
    for dx, dy, ha in _SIDES:
        name.set_position((dx, dy))
        name.set_horizontalalignment(ha)
        box = name.get_window_extent()
        met = any(box.overlaps(other) for other in taken) or any(box.contains(x, y) for x, y in marks)
        if not met and box.x0 >= ax.bbox.x0 and box.x1 <= ax.bbox.x1 and box.y0 >= ax.bbox.y0 and box.y1 <= ax.bbox.y1:
            return
