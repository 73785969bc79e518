# pyright: reportUnknownMemberType=false
# Matplotlib's stubs do not type most keywords.
"""Picture of one run: its final frame large, and four earlier frames.

The strain scale is above them. The scale covers the typical strains of the shown frames. On a scale set by the
neighbours of a pin most of a mesh would be grey, and on a scale that is too short all of it would have one colour.
"""

from __future__ import annotations

from dataclasses import replace
from math import ceil
from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from harness.record.base import Replay
from harness.record.framing import outside_words
from harness.report.frames import drawable_frames, largest_strain, shown_limit, strain_ends
from harness.report.origin import made_by
from harness.report.page import (
    clock,
    count,
    header,
    headline,
    new_page,
    paste,
    quantity,
    save,
    shorten,
    strain_scale,
    text,
)
from harness.report.render import Studio, area_vectors, frame_all, natural_angles, shape
from harness.report.self_contact import self_contact_words
from harness.report.solids import framed, seen
from harness.report.style import HEIGHT, INK, MUTED, PAGE, RC, RULE, WIDTH

_LEFT, _TOP, _RIGHT, _HEIGHT = 36, 114, WIDTH - 36, 750
_WIDEST, _SLIMMEST = 1180, 420  # of the final frame; the earlier ones have the rest
_RULE, _GAP, _CAPTION = 44, 12, 24
_EARLIER = 4  # any grid that they are put in is full


class PixelBox(NamedTuple):
    """A rectangle on the page [pixels from the top left]."""

    left: int
    top: int
    width: int
    height: int


def layout(final: float, whole: float, earlier: int) -> tuple[PixelBox, list[PixelBox]]:
    """Lay out the final frame and the earlier ones.

    Scenes of the given aspect ratios fill their boxes.

    Args:
        final: width / height of the final frame.
        whole: width / height of all frames together.
        earlier: number of earlier frames.
    Returns: the box of the final frame, and those of the earlier ones.
    """
    if not earlier:
        return PixelBox(_LEFT, _TOP, _RIGHT - _LEFT, _HEIGHT), []
    main = PixelBox(_LEFT, _TOP, int(min(max(_HEIGHT * final, _SLIMMEST), _WIDEST)), _HEIGHT)
    start = main.left + main.width + _RULE
    room = _RIGHT - start

    def tile(columns: int) -> tuple[float, int, int]:
        rows = ceil(earlier / columns)
        width = (room - (columns - 1) * _GAP) // columns
        height = (_HEIGHT - rows * _CAPTION) // rows
        return min(float(width), whole * height), width, min(height, int(width / min(whole, 1.0)))

    columns = max(range(1, earlier + 1), key=lambda c: tile(c)[0])
    _, width, height = tile(columns)
    places = [divmod(k, columns) for k in range(earlier)]
    return main, [
        PixelBox(start + column * (width + _GAP), _TOP + row * (height + _CAPTION), width, height)
        for row, column in places
    ]


def draw_run(replay: Replay, path: Path, *, camera: tuple[float, float] | None = None) -> None:
    """Draw the picture of a run as a PNG file of WIDTH x HEIGHT pixels.

    If positions become non-finite, the picture states it and shows the frames before.

    Args:
        replay: recording.
        path: target file.
        camera: azimuth and elevation [degrees]; None to choose them by the scene's shape.
    Raises:
        RunFailed: if the system cannot draw.
    """
    good = drawable_frames(replay)
    shown = np.unique(np.linspace(0, len(good) - 1, _EARLIER + 1).round().astype(int)) if len(good) else good
    if len(shown):
        replay = replace(replay, strain_range=shown_limit([replay] * len(shown), shown.tolist()))
    with matplotlib.rc_context(RC):
        page = new_page()
        header(page, headline(replay), [*_facts(replay), *(_warnings(replay, shown.tolist()) if len(shown) else [])])
        strain_scale(page, replay.strain_range, strain_ends([replay]), pins=len(replay.pinned) > 0)
        made_by(page, [replay], HEIGHT - 12)
        if len(shown):
            _frames(page, replay, shown, camera)
        total = len(replay.frames)
        if len(good) < total:
            _notice(page, replay, len(good))
        save(page, path)


def _warnings(replay: Replay, shown: list[int]) -> list[str]:
    return [*outside_words(framed(replay, shown)), *self_contact_words(replay, shown)]


def _facts(replay: Replay) -> list[str]:
    known = replay.properties
    facts = [shorten(str(known.get("solver", "")), 48)] if "solver" in known else []
    facts.append(f"{count(replay.positions.shape[1])} vertices, {count(len(replay.springs))} springs")
    if "milliseconds_per_step" in known:
        facts.append(f"{quantity(float(known['milliseconds_per_step']))} ms a step")
    if np.isfinite(strain := largest_strain(replay)):
        facts.append(f"largest strain {100 * strain:.3g} %")
    return facts


def _frames(page: Figure, replay: Replay, shown: NDArray[np.int64], camera: tuple[float, float] | None) -> None:
    *earlier, final = (int(k) for k in shown)
    points = replay.positions[shown][:, framed(replay, shown)].reshape(-1, 3)
    angles = natural_angles(points, area_vectors(replay, final)) if camera is None else camera
    last, every = seen(replay, [final]), seen(replay, (*earlier, final))
    main, tiles = layout(shape(last, angles), shape(every, angles), len(earlier))
    close = frame_all(last, aspect=main.width / main.height, angles=angles)
    with Studio(main.width, main.height) as studio:
        paste(page, studio.draw(replay, final, close), main.left, main.top)
    text(page, main.left + 4, main.top + main.height - 4, clock(replay, final), size=11.5)
    if not tiles:
        return
    whole = frame_all(every, aspect=tiles[0].width / tiles[0].height, angles=angles)
    x, ends = (tiles[0].left - _RULE / 2) / WIDTH, (main.top + 4, main.top + main.height - 4)
    page.add_artist(Line2D([x, x], [1 - y / HEIGHT for y in ends], color=RULE, linewidth=0.8))
    with Studio(tiles[0].width, tiles[0].height) as studio:
        for frame, tile in zip(earlier, tiles, strict=True):
            paste(page, studio.draw(replay, frame, whole), tile.left, tile.top)
            words = clock(replay, frame)
            text(page, tile.left + 4, tile.top + tile.height + 14, words, size=10, color=MUTED)


def _notice(page: Figure, replay: Replay, good: int) -> None:
    """Draw a notice with the frame from which on positions cannot be drawn."""
    words = f"not finite from frame {int(replay.frames[good])} on"
    below = f"shown: up to the last finite frame, {int(replay.frames[good - 1])}" if good else "no frame can be drawn"
    middle, y = WIDTH / 2, _TOP + 40 if good else _TOP + _HEIGHT / 2
    box = {"facecolor": PAGE, "edgecolor": INK, "linewidth": 1.0, "boxstyle": "round,pad=0.6"}
    text(page, middle, y, f"Positions are {words}\n{below}", size=13, ha="center", va="center", bbox=box)
