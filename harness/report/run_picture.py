"""The picture of one run: its final frame large, five earlier ones beside it, the scale of strain above."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from harness.record.base import Replay
from harness.report.render import Studio, drawable_frames, frame_all
from harness.report.style import DPI, HEIGHT, INK, MUTED, PAGE, RC, RULE, STRAIN_MAP, WIDTH, figure

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
        page = figure()
        header(page, _headline(replay), _facts(replay))
        strain_scale(page, replay.strain_range, pins=len(replay.pinned) > 0)
        if len(shown):
            _frames(page, replay, shown, camera)
        total = len(replay.frames)
        if len(good) < total:
            _notice(page, replay, len(good))
        save(page, path)


def header(page: Figure, headline: str, facts: Sequence[str]) -> None:
    """The title in the upper left corner and a line of facts below it."""
    text(page, 40, 50, shorten(headline, 58), size=21, weight="bold")
    text(page, 41, 82, "   ·   ".join(facts), size=11.5, color=MUTED)


def strain_scale(page: Figure, limit: float, *, pins: bool) -> None:
    """The colour bar in the upper right corner: percent ticks below, what they mean in words above."""
    left, top, width = 1180, 50, 380
    bar = axes(page, left, top, width, 12)
    bar.imshow(np.linspace(0, 1, 512)[None], cmap=STRAIN_MAP, aspect="auto", interpolation="bilinear")
    bar.set_axis_off()
    for place, word, align in ((0.0, "compressed", "left"), (0.5, "at rest", "center"), (1.0, "stretched", "right")):
        text(page, left + place * width, top - 8, word, size=10, ha=align)
    for place in (0.0, 0.25, 0.5, 0.75, 1.0):
        percent = 100 * limit * (2 * place - 1)
        align = {0.0: "left", 1.0: "right"}.get(place, "center")
        label = f"{percent:+.3g} %".replace("-", "−") if percent else "0"
        text(page, left + place * width, top + 31, label, size=9, color=MUTED, ha=align)
    if pins:
        text(page, left - 36, top + 12, "pinned", size=10, ha="right")
        text(page, left - 96, top + 11, "●", size=11, ha="right")


def _headline(replay: Replay) -> str:
    scene, size = replay.properties.get("scene"), replay.properties.get("size")
    if scene is None:
        return replay.title
    return f"{scene}, size {size}" if size else str(scene)


def _facts(replay: Replay) -> list[str]:
    known = replay.properties
    facts = [shorten(str(known.get("solver", "")), 48)] if "solver" in known else []
    facts.append(f"{count(replay.positions.shape[1])} vertices, {count(len(replay.springs))} springs")
    if "milliseconds_per_step" in known:
        facts.append(f"{quantity(float(known['milliseconds_per_step']))} ms a step")
    return facts


def _frames(
    page: Figure, replay: Replay, shown: NDArray[np.int64], camera: tuple[float, float] | None
) -> None:
    left, top, width, height = _MAIN
    points = replay.positions[shown].reshape(-1, 3)
    view = frame_all(points, aspect=width / height, angles=camera)
    *earlier, final = (int(k) for k in shown)
    with Studio(width, height) as studio:
        paste(page, studio.draw(replay, final, view), left, top)
    text(page, left + 4, top + height - 4, clock(replay, final), size=11.5)
    if not earlier:
        return
    tile = (height - (_EARLIER - 1) * _GAP) // _EARLIER
    rule = page.add_artist(matplotlib.lines.Line2D([0, 0], [0, 0], color=RULE, linewidth=0.8))
    rule.set_data(
        [(_STRIP_LEFT - 20) / WIDTH] * 2, [1 - (top + 4) / HEIGHT, 1 - (top + height - 4) / HEIGHT]
    )
    with Studio(_STRIP_WIDTH, tile) as studio:
        for row, frame in enumerate(earlier):
            at = top + row * (tile + _GAP)
            paste(page, studio.draw(replay, frame, view), _STRIP_LEFT, at)
            text(page, _STRIP_LEFT + 4, at + tile - 4, clock(replay, frame), size=9, color=MUTED)


def _notice(page: Figure, replay: Replay, good: int) -> None:
    """Say in words from where on the positions cannot be drawn."""
    words = f"not finite from frame {int(replay.frames[good])} on"
    below = f"shown: up to the last finite frame, {int(replay.frames[good - 1])}" if good else "no frame can be drawn"
    left, top, width, height = _MAIN
    middle, y = left + width / 2, top + 40 if good else top + height / 2
    box = {"facecolor": PAGE, "edgecolor": INK, "linewidth": 1.0, "boxstyle": "round,pad=0.6"}
    text(page, middle, y, f"Positions are {words}\n{below}", size=13, ha="center", va="center", bbox=box)


def text(page: Figure, x: float, y: float, words: str, *, size: float, color: str = INK, **more) -> None:
    """Type with its baseline at pixel (x, y) from the upper left corner; size in points."""
    page.text(x / WIDTH, 1 - y / HEIGHT, words, size=size, color=color, **more)


def axes(page: Figure, left: float, top: float, width: float, height: float):
    """Axes in a rectangle given in pixels from the upper left corner."""
    return page.add_axes((left / WIDTH, 1 - (top + height) / HEIGHT, width / WIDTH, height / HEIGHT))


def paste(page: Figure, pixels: NDArray[np.uint8], left: int, top: int) -> None:
    """Put a picture on the page, pixel for pixel, with its upper left corner at (left, top)."""
    page.figimage(pixels, xo=left, yo=HEIGHT - top - pixels.shape[0], origin="upper")


def save(page: Figure, path: Path) -> None:
    """Write the page under a partial name and rename it: a kill leaves the whole picture or none."""
    partial = path.with_name(f".{path.name}.partial")
    page.savefig(partial, format="png", dpi=DPI)
    os.replace(partial, path)


def clock(replay: Replay, frame: int) -> str:
    """The time of a recorded frame in words."""
    return f"{replay.times[frame]:.2f} s"


def count(number: int) -> str:
    """A whole number with thin spaces between thousands."""
    return f"{number:,}".replace(",", "\u2009")


def quantity(value: float) -> str:
    """A number to three significant digits, without an exponent where people would not write one."""
    return f"{value:.3g}" if value < 1000 else count(round(value))


def shorten(words: str, limit: int) -> str:
    """The words, or as many of their letters as fit into `limit` with an ellipsis."""
    return words if len(words) <= limit else words[: limit - 1].rstrip() + "…"
