# pyright: reportUnknownMemberType=false
# Matplotlib's stubs do not type most keywords.
"""Layout of a picture: title, strain scale, text and images at pixel positions.

The page has PAGE_WIDTH x PAGE_HEIGHT pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg, RendererAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.patches import Polygon
from matplotlib.ticker import FuncFormatter
from numpy.typing import NDArray
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from springbench.harness.atomic_files import atomic_write
from springbench.harness.recording.recorder_interface import RecordingReplay
from springbench.harness.recording.strain_scale import PIN_COLOUR, STRAIN_COLOURS, format_percent
from springbench.harness.report.number_format import shorten_words
from springbench.harness.report.picture_sources import SOURCES_KEY
from springbench.harness.report.plot_style import (
    BACKGROUND_COLOUR,
    MUTED_COLOUR,
    PAGE_DPI,
    PAGE_HEIGHT,
    PAGE_WIDTH,
    TEXT_COLOUR,
)
from springbench.harness.report.provenance_words import describe_machine_and_commit

STRAIN_MAP = LinearSegmentedColormap.from_list("strain", STRAIN_COLOURS, N=512)
"""Colour map of strains in recordings, from -strain_range to strain_range."""


def new_page() -> Figure:
    """Create an empty page, to be drawn on within `matplotlib.rc_context(PAGE_RC)`."""
    page = Figure(figsize=(PAGE_WIDTH / PAGE_DPI, PAGE_HEIGHT / PAGE_DPI), dpi=PAGE_DPI, facecolor=BACKGROUND_COLOUR)
    FigureCanvasAgg(page)
    return page


def draw_text(
    page: Figure, x: float, y: float, words: str, *, size: float, color: str = TEXT_COLOUR, **text_options: Any
) -> None:
    """Draw text with its baseline at pixel (x, y) from the upper left corner.

    Args:
        page: figure to draw on.
        x: distance from the left edge [pixels].
        y: distance of the baseline from the top [pixels].
        words: text.
        size: font size [points].
        color: colour of the text.
        **text_options: further keywords of `Figure.text`.
    """
    page.text(x / PAGE_WIDTH, 1 - y / PAGE_HEIGHT, words, size=size, color=color, **text_options)


def measure_text(words: str, size: float, *, weight: str = "normal") -> float:
    """Return the width of a line of text [pixels].

    Args:
        words: text, in the font family of the current `matplotlib.rc_context`.
        size: font size [points].
        weight: weight of the font.
    """
    font = FontProperties(size=size, weight=weight)
    return float(RendererAgg(1, 1, PAGE_DPI).get_text_width_height_descent(words, font, ismath=False)[0])


def wrap_to_width(words: str, width: float, size: float, *, weight: str = "normal", separator: str = " ") -> list[str]:
    """Wrap text into lines that are at most `width` wide.

    Args:
        words: text.
        width: largest width of a line [pixels].
        size: font size [points].
        weight: weight of the font.
        separator: where lines break; it is left out there. Parts wider than a line also break between letters.
    """
    lines = [""]
    for part in words.split(separator):
        longer = f"{lines[-1]}{separator}{part}" if lines[-1] else part
        if measure_text(longer, size, weight=weight) <= width:
            lines[-1] = longer
            continue
        lines += [""] if lines[-1] else []
        for letter in part:
            if lines[-1] and measure_text(lines[-1] + letter, size, weight=weight) > width:
                lines.append("")
            lines[-1] += letter
    return lines


def draw_provenance(page: Figure, replays: Iterable[RecordingReplay], y: float) -> None:
    """Draw machine and code version of recordings, right-aligned.

    Args:
        page: figure to draw on.
        replays: recordings.
        y: distance of the baseline from the top [pixels].
    """
    words = describe_machine_and_commit([replay.properties for replay in replays])
    draw_text(page, PAGE_WIDTH - 36, y, "   ·   ".join(words), size=9, color=MUTED_COLOUR, ha="right")


def add_axes(page: Figure, left: float, top: float, width: float, height: float) -> Axes:
    """Add axes in a rectangle given in pixels from the upper left corner.

    Args:
        page: figure of PAGE_WIDTH x PAGE_HEIGHT pixels.
        left, top: upper left corner of the rectangle [pixels].
        width, height: size of the rectangle [pixels].
    """
    return page.add_axes(
        (left / PAGE_WIDTH, 1 - (top + height) / PAGE_HEIGHT, width / PAGE_WIDTH, height / PAGE_HEIGHT)
    )


def tick_formatter(format_value: Callable[[float], str]) -> FuncFormatter:
    """Build a tick formatter from a function that formats a value."""

    def format_tick(value: float, _: int | None) -> str:
        return format_value(value)

    return FuncFormatter(format_tick)


def paste_picture(page: Figure, pixels: NDArray[np.uint8], left: int, top: int) -> None:
    """Paste a picture pixel for pixel.

    Args:
        page: figure of PAGE_WIDTH x PAGE_HEIGHT pixels.
        pixels: picture (height, width, 3 or 4), first row at the top.
        left, top: upper left corner of the picture on the page [pixels].
    """
    page.figimage(pixels, xo=left, yo=PAGE_HEIGHT - top - pixels.shape[0], origin="upper")


def save_page(page: Figure, path: Path, *, used_height: float = PAGE_HEIGHT, sources: str = "") -> None:
    """Write the page as PNG atomically: an interrupted run leaves the whole file or none.

    Args:
        page: figure to write.
        path: target file.
        used_height: height that is drawn on [pixels from the top]; the empty part below is cropped.
        sources: digest of what is drawn, stored in the file (`springbench.harness.report.picture_sources`).

    Raises:
        WriteError: if the file cannot be written.
    """
    with atomic_write(path) as partial:
        page.savefig(partial, format="png", dpi=PAGE_DPI, metadata={SOURCES_KEY: sources})
        if used_height < PAGE_HEIGHT:
            with Image.open(partial) as whole:
                part = whole.crop((0, 0, PAGE_WIDTH, ceil(used_height)))
            text = PngInfo()
            text.add_text(SOURCES_KEY, sources)
            part.save(partial, format="png", pnginfo=text)


def draw_header(page: Figure, headline: str, facts: Sequence[str], *, max_letters: int = 56) -> None:
    """Draw the title in the upper left corner and a line of facts below.

    Args:
        page: figure to draw on.
        headline: title, shortened to `max_letters`.
        facts: phrases of the line, separated by dots.
        max_letters: largest number of letters of the title.
    """
    draw_text(page, 40, 50, shorten_words(headline, max_letters), size=21, weight="bold")
    draw_text(page, 41, 82, "   ·   ".join(facts), size=11.5, color=MUTED_COLOUR)


_MAX_CAPTION_LENGTH = 22
"""Maximum length of the captions at the ends of the strain scale that leaves space for the middle one [characters]."""


def draw_strain_scale(page: Figure, limit: float, ends: tuple[float, float], *, pins: bool) -> None:
    """Draw the colour bar of strains in the upper right corner.

    Ticks in percent are below it, labels above.

    Args:
        page: figure to draw on.
        limit: strain at the ends of the bar.
        ends: smallest and largest spring strain of all frames, stated above the bar; an end outside the bar gets an
            arrow tip.
        pins: whether to draw the legend entry of pinned vertices.
    """
    left, top, width = 1180, 50, 380
    bar = add_axes(page, left, top, width, 12)
    bar.imshow(np.linspace(0, 1, 512)[None], cmap=STRAIN_MAP, aspect="auto", interpolation="bilinear")
    bar.set_axis_off()
    captions = [
        f"{word}, to {format_percent(end)}" if end else f"{word}: none"
        for word, end in zip(("compressed", "stretched"), ends, strict=True)
    ]
    for place, caption, align in ((0.0, captions[0], "left"), (1.0, captions[1], "right")):
        draw_text(page, left + place * width, top - 8, caption, size=9.5, ha=align)
    if max(map(len, captions)) <= _MAX_CAPTION_LENGTH:
        draw_text(page, left + width / 2, top - 8, "at rest", size=9.5, ha="center")
    for place, beyond, tip in ((0.0, ends[0] < -limit, -14), (1.0, ends[1] > limit, 14)):
        if beyond:
            at = left + place * width
            corners = [(at, top), (at, top + 12), (at + tip, top + 6)]
            shape = [(x / PAGE_WIDTH, 1 - y / PAGE_HEIGHT) for x, y in corners]
            page.add_artist(Polygon(shape, closed=True, color=STRAIN_MAP(place), transform=page.transFigure))
    for place in (0.0, 0.25, 0.5, 0.75, 1.0):
        align = {0.0: "left", 1.0: "right"}.get(place, "center")
        label = format_percent(limit * (2 * place - 1)) if place != 0.5 else "0"
        draw_text(page, left + place * width, top + 31, label, size=9, color=MUTED_COLOUR, ha=align)
    if pins:
        draw_text(page, left - 40, top + 12, "pinned", size=10, ha="right")
        draw_text(page, left - 100, top + 11, "●", size=11, color=PIN_COLOUR, ha="right")


def scene_headline(replay: RecordingReplay) -> str:
    """Return the scene and its size as a headline."""
    scene, size = replay.properties.get("scene"), replay.properties.get("size")
    if scene is None:
        return replay.title
    return f"{scene}, size {size}" if size else str(scene)


_TIME_UNITS = (("s", 1.0, 1e-2), ("ms", 1e-3, 1e-3), ("µs", 1e-6, 1e-6), ("ns", 1e-9, 1e-9), ("ps", 1e-12, 1e-12))
"""Units of time: name, length [s], and the smallest time of the last frame [s] for which the unit is used."""


def format_frame_time(replay: RecordingReplay, frame: int) -> str:
    """Format the time of a recorded frame, in a unit chosen by the last time.

    Args:
        replay: recording, whose times [s] are written in seconds if the last one is at least 0.01 s.
        frame: index of a recorded frame.
    """
    last = float(np.abs(replay.times).max(initial=0.0))
    unit, seconds = next(((unit, seconds) for unit, seconds, least in _TIME_UNITS if last >= least), ("s", 1.0))
    return f"{replay.times[frame] / seconds:.2f} {unit}"
