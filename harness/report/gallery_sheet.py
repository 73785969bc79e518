# pyright: reportUnknownMemberType=false
# Matplotlib's stubs do not type most keywords, and PyVista is only partly typed.
"""Gallery of scenes: a title, one tile per scene, and the scale of strains.

All text is readable if the sheet is printed at the width of a column.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import pyvista as pv
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from springbench.harness.recording.camera_framing import describe_outside
from springbench.harness.recording.recorder_interface import RecordingReplay
from springbench.harness.recording.strain_scale import PIN_COLOUR
from springbench.harness.report.drawable_frames import framed_vertex_mask
from springbench.harness.report.mesh_rendering import (
    OffscreenRenderer,
    choose_view_angles,
    compute_area_vectors,
    fit_camera,
)
from springbench.harness.report.obstacle_meshes import points_to_frame
from springbench.harness.report.page_layout import STRAIN_MAP, measure_text, save_page, wrap_to_width
from springbench.harness.report.plot_style import (
    BACKGROUND_COLOUR,
    MUTED_COLOUR,
    PAGE_DPI,
    PAGE_RC,
    PAGE_WIDTH,
    TEXT_COLOUR,
)
from springbench.harness.report.provenance_words import describe_machine_and_commit
from springbench.harness.report.self_intersection_notes import describe_self_intersection

_MAX_COLUMNS, _MIN_COLUMNS = 4, 3
"""Largest and smallest number of tiles in a row."""
_PIXELS_PER_VERTEX = 70
"""Pixels per vertex above which mesh lines are drawn; low, because the mesh should be visible at least as a texture."""
_BALL_RADIUS, _HEAVY_RATIO = 0.03, 20.0
"""Radius of balls [share of the scene's size], drawn at vertices whose mass exceeds this multiple of the median."""
_MARGIN, _TILE_GAP, _BAND_GAP = 24, 24, 30
"""Pixels: margin of the sheet, gap between tiles, gap between title, rows of tiles and foot."""
_TILE_ASPECT, _MAX_TILE_HEIGHT = 1.28, 480
"""Width / height of a tile, and its largest height [pixels]."""
_TEXT_SIZE, _TITLE_SIZE = 27.0, 32.0
"""Font sizes [points]; on a sheet of 1600 pixels that is printed 85 mm wide, they are 5.6 and 6.7 points."""
_LINE_HEIGHT = 48
"""Pixels between the baselines of two lines of _TEXT_SIZE; that of the title is in proportion to its font size."""
_SCALE_WIDTH, _SCALE_HEIGHT = 300, 22
"""Size of the scale of strains [pixels]."""
_FACT_SEPARATOR = "  ·  "


@dataclass(frozen=True, slots=True, eq=False)
class SceneTile:
    """A scene at one time.

    Attributes:
        replay: recording of the start and of the frame to draw; its properties include the processor (`cpu`) and
            `commit`.
        mass: vertex masses (n,) [kg].
        name: name of the scene.
        angles: azimuth and elevation of the camera [degrees]; None to choose them by the mesh's shape.
    """

    replay: RecordingReplay
    mass: NDArray[np.float64]
    name: str
    angles: tuple[float, float] | None


class _PlacedText(NamedTuple):
    """A line of text.

    Attributes:
        words: text of the line.
        x: distance from the left [pixels], to which `options` align the text.
        baseline: distance of the baseline from the top [pixels].
        options: keywords of `Figure.text`.
    """

    words: str
    x: float
    baseline: float
    options: dict[str, Any]


class _PlacedPixels(NamedTuple):
    """An image with its upper left corner [pixels from the upper left of the sheet]."""

    pixels: NDArray[np.uint8]
    left: int
    top: int


class _Sheet:
    """Texts and images from the top downwards; the height of the page follows from them.

    Attributes:
        y: distance of the next content from the top [pixels].
    """

    def __init__(self) -> None:
        self.y = _MARGIN
        self._texts: list[_PlacedText] = []
        self._images: list[_PlacedPixels] = []

    def add_text(self, words: str, x: float, top: float, *, size: float = _TEXT_SIZE, **options: Any) -> None:
        """Add a line of text whose line box starts at `top`."""
        baseline = top + 0.76 * _line_height(size)
        self._texts.append(_PlacedText(words, x, baseline, {"size": size, "color": TEXT_COLOUR, **options}))

    def add_paragraph(self, lines: Sequence[str], *, size: float = _TEXT_SIZE, **options: Any) -> None:
        """Add lines at the left margin, and move below them."""
        for line in lines:
            self.add_text(line, _MARGIN, self.y, size=size, **options)
            self.y += _line_height(size)

    def add_image(self, pixels: NDArray[np.uint8], left: int, top: int) -> None:
        """Add an image, pixel for pixel."""
        self._images.append(_PlacedPixels(pixels, left, top))

    def save_sheet(self, path: Path) -> None:
        """Write the sheet as PNG file."""
        height = self.y + _MARGIN
        page = Figure(figsize=(PAGE_WIDTH / PAGE_DPI, height / PAGE_DPI), dpi=PAGE_DPI, facecolor=BACKGROUND_COLOUR)
        FigureCanvasAgg(page)
        for pixels, left, top in self._images:
            page.figimage(pixels, xo=left, yo=height - top - pixels.shape[0], origin="upper")
        for words, x, baseline, options in self._texts:
            page.text(x / PAGE_WIDTH, 1 - baseline / height, words, parse_math=False, **options)
        save_page(page, path)


def draw_gallery_sheet(tiles: Sequence[SceneTile], path: Path, title: str, facts: Sequence[str] = ()) -> None:
    """Draw the gallery as a PNG file, tile by tile.

    Scale, facts, processor and commit are at the foot.

    Args:
        tiles: scenes in the order in which they are drawn.
        path: target file.
        title: title of the sheet.
        facts: phrases at the foot, before processor and commit.

    Raises:
        RunFailed: if the system cannot draw.
    """
    columns, whole = choose_column_count(len(tiles)), PAGE_WIDTH - 2 * _MARGIN
    width = (whole - (columns - 1) * _TILE_GAP) // columns
    height = min(round(width / _TILE_ASPECT), _MAX_TILE_HEIGHT)
    facts = [*facts, *describe_machine_and_commit([tile.replay.properties for tile in tiles])]
    with matplotlib.rc_context(PAGE_RC), OffscreenRenderer(width, height, mesh_lines=_PIXELS_PER_VERTEX) as studio:
        sheet = _Sheet()
        sheet.add_paragraph(wrap_to_width(title, whole, _TITLE_SIZE, weight="bold"), size=_TITLE_SIZE, weight="bold")
        sheet.y += _BAND_GAP // 2
        for k in range(0, len(tiles), columns):
            below, row = sheet.y + height, tiles[k : k + columns]
            indent = _MARGIN + (columns - len(row)) * (width + _TILE_GAP) // 2
            for column, tile in enumerate(row):
                left = indent + column * (width + _TILE_GAP)
                sheet.add_image(_render_tile(studio, tile, width / height), left, sheet.y)
                below = max(below, _add_caption(sheet, tile, left, sheet.y + height, width))
            sheet.y = below + _BAND_GAP
        _add_strain_scale(sheet, [tile.replay for tile in tiles])
        sheet.add_paragraph(
            wrap_to_width(_FACT_SEPARATOR.join(facts), whole, _TEXT_SIZE, separator=_FACT_SEPARATOR), color=MUTED_COLOUR
        )
        sheet.save_sheet(path)


def choose_column_count(count: int) -> int:
    """Return the number of columns that leaves the fewest cells empty.

    Among equal choices it is the largest number.
    """
    if count < _MIN_COLUMNS:
        return max(count, 1)
    return min(range(_MIN_COLUMNS, _MAX_COLUMNS + 1), key=lambda columns: (-count % columns, -columns))


def _line_height(size: float) -> int:
    """Return the distance of baselines at a font size [pixels]."""
    return round(_LINE_HEIGHT * size / _TEXT_SIZE)


def _add_caption(sheet: _Sheet, tile: SceneTile, left: int, top: int, width: int) -> int:
    """Add name and notes below a tile; return their lower end [pixels from the top]."""
    notes = [
        *describe_outside(framed_vertex_mask(tile.replay, [-1])),
        *describe_self_intersection(tile.replay, [-1]),
    ]
    for words, color in ((tile.name, TEXT_COLOUR), *((note, MUTED_COLOUR) for note in notes)):
        for line in wrap_to_width(words, width, _TEXT_SIZE):
            sheet.add_text(line, left + width / 2, top, ha="center", color=color)
            top += _LINE_HEIGHT
    return top


def _add_strain_scale(sheet: _Sheet, replays: Sequence[RecordingReplay]) -> None:
    """Add the scale of strains, and the legend entry of pinned vertices.

    The ends of the scale have numbers only if all scenes have the same scale.
    """
    limits = {replay.strain_range for replay in replays}
    end = f" {100 * limits.pop():.3g} %" if len(limits) == 1 else ""
    x = float(_MARGIN)
    for words in (f"compressed{end}", "", f"stretched{end}"):  # the empty text stands for the bar
        if words:
            sheet.add_text(words, x, sheet.y)
            x += measure_text(words, _TEXT_SIZE) + 16
            continue
        bar = STRAIN_MAP(np.linspace(0.0, 1.0, _SCALE_WIDTH), bytes=True)
        pixels = np.broadcast_to(bar[None, :, :3], (_SCALE_HEIGHT, _SCALE_WIDTH, 3))
        sheet.add_image(pixels, round(x), sheet.y + (_LINE_HEIGHT - _SCALE_HEIGHT) // 2)
        x += _SCALE_WIDTH + 16
    if any(len(replay.pinned_vertices) for replay in replays):
        right = PAGE_WIDTH - _MARGIN
        sheet.add_text("pinned", right, sheet.y, ha="right")
        sheet.add_text("●", right - measure_text("pinned", _TEXT_SIZE) - 14, sheet.y, ha="right", color=PIN_COLOUR)
    sheet.y += _LINE_HEIGHT


def _render_tile(studio: OffscreenRenderer, tile: SceneTile, aspect: float) -> np.ndarray:
    replay, points = tile.replay, tile.replay.positions[-1][framed_vertex_mask(tile.replay, [-1])]
    radius = _BALL_RADIUS * float(np.linalg.norm(np.ptp(points, axis=0)))
    bobs = [
        pv.Sphere(radius=radius, center=p)
        for p in replay.positions[-1][tile.mass > _HEAVY_RATIO * np.median(tile.mass)]
    ]
    angles = tile.angles or choose_view_angles(points, compute_area_vectors(replay, -1))
    return studio.render_frame(
        replay, -1, fit_camera(points_to_frame(replay, [-1]), aspect=aspect, angles=angles), bobs
    )
