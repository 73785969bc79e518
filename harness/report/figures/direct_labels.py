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
from springbench.harness.report.charts.figure_panels import CurvePlot, CurveSeries, FigurePanel
from springbench.harness.report.figures.axis_scales import frame_size_points
from springbench.harness.report.figures.figure_options import FigureOptions
from springbench.harness.report.plot_style import TEXT_COLOUR

_MAX_LABELS, _MAX_WIDTH_SHARE = 9, 0.3
"""Maximum number of labels of a frame, and maximum share of the width for them."""
_CALLOUT_RADIUS = 5.0
"""Initial distance of a callout from its point [points]; the radius of the ring is 1.05 times that."""
_RING_DISTANCE = 1.6
"""Distance of a callout relative to that of a label without a ring."""
_LABEL_DISTANCE = 7.0
"""Distance from the frame to the labels [points]."""


def add_direct_labels(axes: Sequence[Axes], panels: Sequence[FigurePanel], options: FigureOptions) -> bool:
    """Add labels to curve ends or points; return whether they make a legend unnecessary.

    Args:
        axes: axes of the panels.
        panels: panels of the figure; only a single one gets direct labels.
        options: options of the figure.
    """
    for ax, one in zip(axes, panels, strict=True):
        if isinstance(one, CurvePlot):
            _add_callouts(ax, one.series, options)
    panel = panels[0]
    if len(panels) > 1 or not isinstance(panel, CurvePlot):
        return False
    if panel.y.division == "names":
        return True
    ending = [series for series in panel.series if len(_end_point(series))]
    plain = {series.label: series for series in ending if series.style.marker == "None"}
    known = [*(series for series in ending if series.style.marker != "None"), *plain.values()]
    letters = max((len(series.label) for series in known), default=0)
    wide = 0.6 * options.small_font_size * letters + _LABEL_DISTANCE
    tall = options.width_mm / 25.4 * 72.0 * panel.aspect * 0.8
    named = any(series.labels_points for series in panel.series)
    fits = (
        len(known) * 1.3 * options.small_font_size <= tall and wide <= _MAX_WIDTH_SHARE * options.width_mm / 25.4 * 72.0
    )
    if named:
        _label_points(axes[0], panel.series, options)
        return True
    if not fits or not known or panel.bands or panel.x_bands or len(known) > _MAX_LABELS:
        return False
    _EndLabels(axes[0], known, options)
    return True


def _end_point(series: CurveSeries) -> list[float]:
    known = np.isfinite(series.x) & np.isfinite(series.y)
    return [float(series.x[known][-1]), float(series.y[known][-1])] if known.any() else []


class _EndLabels:
    """Labels at the curve ends of one frame.

    They are created before the layout, which reserves space for them, and positioned after it.
    """

    def __init__(self, ax: Axes, known: Sequence[CurveSeries], options: FigureOptions) -> None:
        self._ax, self._gap = ax, 1.25 * options.small_font_size
        self._ends = [_end_point(series) for series in known]
        self._names: list[Text] = []
        for series, (x, y) in zip(known, self._ends, strict=True):
            line = {"arrowstyle": "-", "color": series.style.color, "alpha": 0.5, "linewidth": 0.5, "shrinkA": 0}
            name = ax.annotate(
                series.label, (x, y), (1.0, 0.5), textcoords="axes fraction", va="center",
                fontsize=options.small_font_size, color=_darken_colour(series.style.color),
                arrowprops=line | {"shrinkB": 2.5, "relpos": (0.0, 0.5)},
                annotation_clip=False,
            )  # fmt: skip
            name.set_position((self._label_position(), 0.5))
            self._names.append(name)
        setattr(self._names[0], "settle", self.place_labels)  # noqa: B010 no attribute of Text: done after the layout

    def _label_position(self) -> float:
        """Return the x position of the labels, in units of the frame's width."""
        width, _ = frame_size_points(self._ax)
        return 1.0 + _LABEL_DISTANCE / width

    def place_labels(self) -> None:
        """Move the labels to the heights of their curve ends, and apart."""
        ax = self._ax
        _, points = frame_size_points(ax)
        heights = [ax.transAxes.inverted().transform(ax.transData.transform(end))[1] * points for end in self._ends]
        order = np.argsort(heights)
        at = spread_positions([heights[k] for k in order], self._gap, points)
        label_position = self._label_position()
        for k, height in zip(order, at, strict=True):
            self._names[k].set_position((label_position, height / points))


def spread_positions(targets: Sequence[float], gap: float, top: float) -> list[float]:
    """Spread sorted heights to be at least `gap` apart, with small displacements.

    Args:
        targets: preferred heights, ascending.
        gap: minimum distance.
        top: upper limit, exceeded only if the space from 0 is too small.
    """
    at = list(targets)
    # Relaxation: two neighbours that are too close both move by half of the missing distance.
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


def _darken_colour(color: str) -> str:
    """Darken a colour until small text in it is readable on white."""
    from matplotlib.colors import to_rgb
    from springbench.harness.report.plot_style import shade_colour

    while sum(w * part for w, part in zip((0.3, 0.6, 0.1), to_rgb(color), strict=True)) > 0.5:
        color = shade_colour(color, -0.12)
    return color


def _label_points(ax: Axes, series: Sequence[CurveSeries], options: FigureOptions) -> None:
    """Label single points without overlap.

    A label is on a side of its point where it overlaps no other label and no other point, if possible not on its line.
    """
    offsets = sorted(_LABEL_OFFSETS, key=lambda offset: offset[1] == 0.0)
    for one in series:
        for x, y in zip(one.x, one.y, strict=True):
            name = ax.annotate(
                one.label, (x, y), (5, 0), textcoords="offset points", va="center", fontsize=options.small_font_size,
                annotation_clip=False,
            )  # fmt: skip
            setattr(name, "settle", lambda name=name: _place_label(ax, name, offsets))  # noqa: B010 as above


def _add_callouts(ax: Axes, series: Sequence[CurveSeries], options: FigureOptions) -> None:
    """Draw a ring and words at each point that has a callout."""
    offsets = [(_RING_DISTANCE * dx, _RING_DISTANCE * dy, ha) for dx, dy, ha in _LABEL_OFFSETS]
    for one in series:
        for k, words in one.callouts.items():
            x, y = float(one.x[k]), float(one.y[k])
            ring = 4.2 * _CALLOUT_RADIUS / 2.0
            ax.plot(x, y, "o", mfc="none", mec=TEXT_COLOUR, ms=ring, mew=0.8, zorder=5)
            name = ax.annotate(
                words, (x, y), (_CALLOUT_RADIUS, 0), textcoords="offset points", va="center",
                fontsize=options.small_font_size, color=TEXT_COLOUR, annotation_clip=False,
            )  # fmt: skip
            setattr(name, "settle", lambda name=name: _place_label(ax, name, offsets))  # noqa: B010 as above


_LABEL_OFFSETS: tuple[tuple[float, float, Any], ...] = tuple(
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


def _place_label(ax: Axes, name: Annotation, offsets: Sequence[tuple[float, float, Any]]) -> None:
    """Place a label at the first offset where it fits, otherwise at the last one.

    It fits if it is inside the frame, overlaps no earlier label, and contains no point.
    """
    before = [other for other in ax.texts[: ax.texts.index(name)] if isinstance(other, Annotation)]
    taken = [other.get_window_extent() for other in before]
    points = [ax.transData.transform(line.get_xydata()) for line in ax.lines if line.get_marker() not in ("None", "")]
    marks = np.concatenate([np.zeros((0, 2)), *points])
    for dx, dy, ha in offsets:
        name.set_position((dx, dy))
        name.set_horizontalalignment(ha)
        box = name.get_window_extent()
        met = any(box.overlaps(other) for other in taken) or any(box.contains(x, y) for x, y in marks)
        if not met and box.x0 >= ax.bbox.x0 and box.x1 <= ax.bbox.x1 and box.y0 >= ax.bbox.y0 and box.y1 <= ax.bbox.y1:
            return
