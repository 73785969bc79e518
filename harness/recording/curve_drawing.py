"""Curves over iterations as a drawing that is visible on every timeline of the viewer.

The viewer's own plots show only the active timeline, which is that of the frames. The drawing has a logarithmic axis
with whole decades and numbers. The label of a curve is at its end, next to the data.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

_WIDTH, _HEIGHT = 150.0, 100.0
_TEXT_COLOUR, _RULE_COLOUR = 0xFFFFFFFF, 0x464950FF
_LINE_HEIGHT = 7.0
"""Height of a label, and minimum spacing of the labels at the ends of curves."""
_LABEL_OFFSET = 4.5
"""Distance by which the viewer draws a label below its position."""

_MAX_DECADES = 18
"""Maximum number of decades drawn below the largest value."""

ColourArray = NDArray[np.uint32]
PointArray = NDArray[np.float64]


def pack_colours(numbers: Iterable[int]) -> ColourArray:
    """Return colours 0xRRGGBBAA as an array.

    Rerun reads a list of three or four numbers as the components of one colour.
    """
    return np.array(list(numbers), np.uint32)


def draw_curves(
    stream: rr.RecordingStream, entity: str, curves: Mapping[str, Sequence[float]], colours: ColourArray
) -> None:
    """Log curves over the iterations 1, 2, ... with a logarithmic axis, as a drawing.

    Args:
        stream: open recording.
        entity: entity path under which the drawing is logged.
        curves: values of each iteration by curve name; values that are not positive and finite are omitted.
        colours: colours of the curves.
    """
    found = {name: np.asarray(values, float) for name, values in curves.items()}
    known = np.concatenate([values[np.isfinite(values) & (values > 0)] for values in found.values()] or [np.empty(0)])
    if not len(known):
        return
    top = math.ceil(math.log10(known.max()) + 1e-9)
    bottom = max(min(math.floor(math.log10(known.min())), top - 1), top - _MAX_DECADES)
    last = max(len(values) for values in found.values())
    rules, places, words = _build_axes(bottom, top, last)
    strips, ends = list[PointArray](), list[tuple[float, float]]()
    for values in found.values():
        fine = np.isfinite(values) & (values >= 10.0**bottom)
        x = _scale_iterations(1 + np.flatnonzero(fine), last)
        y = _HEIGHT * (top - np.log10(values[fine])) / (top - bottom)
        strips.append(np.column_stack([x, y]))
        ends.append((float(x[-1]), float(y[-1])) if len(x) else (0.0, _HEIGHT))
    # All lines share one entity and all labels another, since each entity costs about 3 kB.
    radii: Any = [rr.Radius.ui_points(0.5)] * len(rules) + [rr.Radius.ui_points(1.25)] * len(strips)
    lines = rr.LineStrips2D([*rules, *strips], colors=_append_colour(len(rules), _RULE_COLOUR, colours), radii=radii)
    stream.log(f"{entity}/lines", lines, static=True)
    label_positions = np.column_stack([np.full(len(ends), _WIDTH + 14.0), _spread_labels([y for _, y in ends])])
    points = rr.Points2D(
        np.concatenate([places, label_positions]) - (0.0, _LABEL_OFFSET),
        labels=[*words, *found],
        show_labels=True,
        colors=_append_colour(len(words), _TEXT_COLOUR, colours),
        radii=rr.Radius.ui_points(0.1),
    )
    stream.log(f"{entity}/words", points, static=True)


def _append_colour(count: int, colour: int, others: ColourArray) -> ColourArray:
    return np.concatenate([np.full(count, colour, np.uint32), others])


def build_curve_view(origin: str, name: str) -> rrb.Spatial2DView:
    """Build a view of the drawing.

    Args:
        origin: entity path under which `draw_curves` logged the drawing.
        name: title of the view.
    """
    bounds = rrb.VisualBounds2D(x_range=(-18, _WIDTH + 32), y_range=(-8, _HEIGHT + 14))
    return rrb.Spatial2DView(origin=origin, name=name, background=(28, 30, 34), visual_bounds=bounds)


def _build_axes(bottom: int, top: int, last: int) -> tuple[list[PointArray], PointArray, list[str]]:
    """Return the rules, and the positions and texts of their labels."""
    step = -(-(top - bottom) // 6)
    decades = np.arange(top, bottom - 1, -step)
    rows = _HEIGHT * (top - decades) / (top - bottom)
    every = _round_tick_step(last)
    numbers = np.arange(0, last + 1, every) if every < last else np.array([1, last])
    columns = _scale_iterations(np.maximum(numbers, 1), last)
    rules = [np.array([(0.0, y), (_WIDTH, y)]) for y in rows] + [np.array([(x, 0.0), (x, _HEIGHT)]) for x in columns]
    places = np.array([(-9.0, y) for y in rows] + [(x, _HEIGHT + 9.0) for x in columns])
    return rules, places, [f"1e{decade}" for decade in decades] + [str(max(1, number)) for number in numbers]


def _scale_iterations(iterations: NDArray[np.int64], last: int) -> NDArray[np.float64]:
    return _WIDTH * (iterations - 1) / max(1, last - 1)


def _round_tick_step(last: int) -> int:
    """Return 1, 2 or 5 times a power of ten, for about five ticks."""
    power = 10 ** math.floor(math.log10(max(1.0, last / 5)))
    return int(next(f * power for f in (1, 2, 5, 10) if f * power * 5 >= last))


def _spread_labels(heights: list[float]) -> list[float]:
    """Spread label heights at least one line apart, within the drawing and in order."""
    order, placed = sorted(range(len(heights)), key=heights.__getitem__), dict[int, float]()
    height = -math.inf
    for k in order:
        height = placed[k] = max(heights[k], height + _LINE_HEIGHT)
    over = max(0.0, height - _HEIGHT)
    return [max(0.0, placed[k] - over) if over else placed[k] for k in range(len(heights))]
