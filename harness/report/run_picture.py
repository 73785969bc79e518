# pyright: reportUnknownMemberType=false
# Matplotlib's stubs say nothing of most keywords.
"""The picture of one run: its final frame large, five earlier ones beside it, the scale of strain above."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from harness.record.base import Replay
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
from harness.report.render import Studio, area_vectors, drawable_frames, frame_all, natural_angles
from harness.report.solids import seen
from harness.report.style import HEIGHT, INK, MUTED, PAGE, RC, RULE, WIDTH

_MAIN = (36, 114, 1244, 750)  # left, top, width, height of the final frame [pixels from the top left]
_STRIP_LEFT, _STRIP_WIDTH, _GAP = 1320, 244, 6
_EARLIER = 5


def draw_run(replay: Replay, path: Path, *, camera: tuple[float, float] | None = None) -> None:
    """Draw a run's picture to `path`, WIDTH x HEIGHT pixels, PNG.

    camera: azimuth and elevation [degrees] to look from; chosen by the scene's shape where None.
    Where positions are not finite the picture says so and shows the frames before.
    Raises RunFailed where the system cannot draw.
    """
    good = drawable_frames(replay)
    shown = np.unique(np.linspace(0, len(good) - 1, _EARLIER + 1).round().astype(int)) if len(good) else good
    with matplotlib.rc_context(RC):
        page = new_page()
        header(page, headline(replay), _facts(replay))
        strain_scale(page, replay.strain_range, pins=len(replay.pinned) > 0)
        if len(shown):
            _frames(page, replay, shown, camera)
        total = len(replay.frames)
        if len(good) < total:
            _notice(page, replay, len(good))
        save(page, path)


def _facts(replay: Replay) -> list[str]:
    known = replay.properties
    facts = [shorten(str(known.get("solver", "")), 48)] if "solver" in known else []
    facts.append(f"{count(replay.positions.shape[1])} vertices, {count(len(replay.springs))} springs")
    if "milliseconds_per_step" in known:
        facts.append(f"{quantity(float(known['milliseconds_per_step']))} ms a step")
    return facts


def _frames(page: Figure, replay: Replay, shown: NDArray[np.int64], camera: tuple[float, float] | None) -> None:
    left, top, width, height = _MAIN
    *earlier, final = (int(k) for k in shown)
    points = replay.positions[shown].reshape(-1, 3)
    angles = natural_angles(points, area_vectors(replay, final)) if camera is None else camera
    close = frame_all(seen(replay, [final]), aspect=width / height, angles=angles)
    with Studio(width, height) as studio:
        paste(page, studio.draw(replay, final, close), left, top)
    text(page, left + 4, top + height - 4, clock(replay, final), size=11.5)
    if not earlier:
        return
    tile = (height - (_EARLIER - 1) * _GAP) // _EARLIER
    whole = frame_all(seen(replay, (*earlier, final)), aspect=_STRIP_WIDTH / tile, angles=angles)
    x, ends = (_STRIP_LEFT - 20) / WIDTH, (top + 4, top + height - 4)
    page.add_artist(Line2D([x, x], [1 - y / HEIGHT for y in ends], color=RULE, linewidth=0.8))
    with Studio(_STRIP_WIDTH, tile) as studio:
        for row, frame in enumerate(earlier):
            at = top + row * (tile + _GAP)
            paste(page, studio.draw(replay, frame, whole), _STRIP_LEFT, at)
            text(page, _STRIP_LEFT + 4, at + tile - 4, clock(replay, frame), size=9, color=MUTED)


def _notice(page: Figure, replay: Replay, good: int) -> None:
    """Say in words from where on the positions cannot be drawn."""
    words = f"not finite from frame {int(replay.frames[good])} on"
    below = f"shown: up to the last finite frame, {int(replay.frames[good - 1])}" if good else "no frame can be drawn"
    left, top, width, height = _MAIN
    middle, y = left + width / 2, top + 40 if good else top + height / 2
    box = {"facecolor": PAGE, "edgecolor": INK, "linewidth": 1.0, "boxstyle": "round,pad=0.6"}
    text(page, middle, y, f"Positions are {words}\n{below}", size=13, ha="center", va="center", bbox=box)
