"""Curves over iterations as a drawing, which is seen whatever timeline the viewer shows.

The viewer's own plots show nothing but the timeline that is active, which is that of the frames. The drawing has a
logarithmic axis, whole decades and numbers; the words on a curve stand at its end, beside the data.
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
_PALE, _RULE = 0xFFFFFFFF, 0x464950FF
_LINE = 7.0
"""The height of a word, by which those at the ends of curves are kept apart."""
_LOWER = 4.5
"""How far below its place the viewer writes a word."""

_DEEPEST = 18
"""Decades below the largest value that are drawn."""

Colours = NDArray[np.uint32]
Points = NDArray[np.float64]


def colours(numbers: Iterable[int]) -> Colours:
    """As an array, of 0xRRGGBBAA: Rerun takes three or four numbers in a list for the parts of one colour."""
    return np.array(list(numbers), np.uint32)


def draw(stream: rr.RecordingStream, entity: str, curves: Mapping[str, Sequence[float]], colours: Colours) -> None:
    """Log curves by name over the iterations 1, 2, ..., the logarithms of their values, as a drawing under `entity`."""
    found = {name: np.asarray(values, float) for name, values in curves.items()}
    known = np.concatenate([values[np.isfinite(values) & (values > 0)] for values in found.values()] or [np.empty(0)])
    if not len(known):
        return
    top = math.ceil(math.log10(known.max()) + 1e-9)
    bottom = max(min(math.floor(math.log10(known.min())), top - 1), top - _DEEPEST)
    last = max(len(values) for values in found.values())
    rules, places, words = _axes(bottom, top, last)
    strips, ends = list[Points](), list[tuple[float, float]]()
    for values in found.values():
        fine = np.isfinite(values) & (values >= 10.0**bottom)
        x = _across(1 + np.flatnonzero(fine), last)
        y = _HEIGHT * (top - np.log10(values[fine])) / (top - bottom)
        strips.append(np.column_stack([x, y]))
        ends.append((float(x[-1]), float(y[-1])) if len(x) else (0.0, _HEIGHT))
    # All lines are one entity and all words another: each entity costs some 3 kB.
    radii: Any = [rr.Radius.ui_points(0.5)] * len(rules) + [rr.Radius.ui_points(1.25)] * len(strips)
    lines = rr.LineStrips2D([*rules, *strips], colors=_painted(len(rules), _RULE, colours), radii=radii)
    stream.log(f"{entity}/lines", lines, static=True)
    beside = np.column_stack([np.full(len(ends), _WIDTH + 14.0), _apart([y for _, y in ends])])
    points = rr.Points2D(
        np.concatenate([places, beside]) - (0.0, _LOWER),
        labels=[*words, *found],
        show_labels=True,
        colors=_painted(len(words), _PALE, colours),
        radii=rr.Radius.ui_points(0.1),
    )
    stream.log(f"{entity}/words", points, static=True)


def _painted(count: int, colour: int, others: Colours) -> Colours:
    return np.concatenate([np.full(count, colour, np.uint32), others])


def view(origin: str, name: str) -> rrb.Spatial2DView:
    """A view of the drawing."""
    bounds = rrb.VisualBounds2D(x_range=(-18, _WIDTH + 32), y_range=(-8, _HEIGHT + 14))
    return rrb.Spatial2DView(origin=origin, name=name, background=(28, 30, 34), visual_bounds=bounds)


def _axes(bottom: int, top: int, last: int) -> tuple[list[Points], Points, list[str]]:
    """Rules, and the places of the words beside them."""
    step = -(-(top - bottom) // 6)
    decades = np.arange(top, bottom - 1, -step)
    rows = _HEIGHT * (top - decades) / (top - bottom)
    every = _round(last)
    numbers = np.arange(0, last + 1, every) if every < last else np.array([1, last])
    columns = _across(np.maximum(numbers, 1), last)
    rules = [np.array([(0.0, y), (_WIDTH, y)]) for y in rows] + [np.array([(x, 0.0), (x, _HEIGHT)]) for x in columns]
    places = np.array([(-9.0, y) for y in rows] + [(x, _HEIGHT + 9.0) for x in columns])
    return rules, places, [f"1e{decade}" for decade in decades] + [str(max(1, number)) for number in numbers]


def _across(iterations: NDArray[np.int64], last: int) -> NDArray[np.float64]:
    return _WIDTH * (iterations - 1) / max(1, last - 1)


def _round(last: int) -> int:
    """About five steps of 1, 2 or 5 times a power of ten."""
    power = 10 ** math.floor(math.log10(max(1.0, last / 5)))
    return int(next(f * power for f in (1, 2, 5, 10) if f * power * 5 >= last))


def _apart(wanted: list[float]) -> list[float]:
    """Heights in the order of the wanted ones, a line apart at least, and none below the drawing."""
    order, placed = sorted(range(len(wanted)), key=wanted.__getitem__), dict[int, float]()
    height = -math.inf
    for k in order:
        height = placed[k] = max(wanted[k], height + _LINE)
    over = max(0.0, height - _HEIGHT)
    return [max(0.0, placed[k] - over) if over else placed[k] for k in range(len(wanted))]
