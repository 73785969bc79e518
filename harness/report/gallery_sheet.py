# pyright: reportUnknownMemberType=false
# Matplotlib's stubs do not type most keywords, and PyVista is only partly typed.
"""Gallery of scenes: one tile per scene with its name and effects.

The provenance is stated at the foot of the sheet. All text of one kind has one size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap

import matplotlib
import numpy as np
import pyvista as pv
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from springbench.harness.recording.camera_framing import describe_outside
from springbench.harness.recording.recorder_interface import RecordingReplay
from springbench.harness.report.drawable_frames import framed_vertex_mask
from springbench.harness.report.mesh_rendering import (
    OffscreenRenderer,
    choose_view_angles,
    compute_area_vectors,
    fit_camera,
)
from springbench.harness.report.obstacle_meshes import points_to_frame
from springbench.harness.report.page_layout import save_page
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

_MAX_COLUMNS, _MIN_COLUMNS = 5, 3
"""Largest and smallest number of tiles in a row."""
_PIXELS_PER_VERTEX = 70
"""Pixels per vertex above which mesh lines are drawn; low, because the mesh should be visible at least as a texture."""
_BALL_RADIUS, _HEAVY_RATIO = 0.03, 20.0
"""Radius of balls [share of the scene's size], drawn at vertices whose mass exceeds this multiple of the median."""
_SHEET_MARGIN, _TILE_GAP, _TILE_HEIGHT, _CAPTION_HEIGHT, _FOOT_HEIGHT = 28, 20, 290, 78, 24
"""Pixels: margin of the sheet, gap between tiles, height of a tile, caption below it, text at the foot of the sheet."""

_MAX_CAPTION_LINES = 2


@dataclass(frozen=True, slots=True, eq=False)
class SceneTile:
    """A scene at one time.

    Attributes:
        replay: recording of the start and of the frame to draw; its properties include the processor (`cpu`) and
            `commit`.
        mass: vertex masses (n,) [kg].
        name: name of the scene.
        effect_words: effects of the scene, in words.
        angles: azimuth and elevation of the camera [degrees]; None to choose them by the mesh's shape.
    """

    replay: RecordingReplay
    mass: NDArray[np.float64]
    name: str
    effect_words: str
    angles: tuple[float, float] | None


def draw_gallery_sheet(tiles: Sequence[SceneTile], path: Path, facts: Sequence[str] = ()) -> None:
    """Draw the gallery as a PNG file, tile by tile.

    Facts, processor and commit are stated at the foot.

    Args:
        tiles: scenes in the order in which they are drawn.
        path: target file.
        facts: phrases at the foot, before processor and commit.
    Raises:
        RunFailed: if the system cannot draw.
    """
    columns = choose_column_count(len(tiles))
    width = (PAGE_WIDTH - 2 * _SHEET_MARGIN - (columns - 1) * _TILE_GAP) // columns
    step = _TILE_HEIGHT + _CAPTION_HEIGHT
    height = 2 * _SHEET_MARGIN + -(-len(tiles) // columns) * step + _FOOT_HEIGHT - _TILE_GAP // 2
    with (
        matplotlib.rc_context(PAGE_RC),
        OffscreenRenderer(width, _TILE_HEIGHT, mesh_lines=_PIXELS_PER_VERTEX) as studio,
    ):
        page = Figure(figsize=(PAGE_WIDTH / PAGE_DPI, height / PAGE_DPI), dpi=PAGE_DPI, facecolor=BACKGROUND_COLOUR)
        FigureCanvasAgg(page)
        for k, tile in enumerate(tiles):
            row, column = divmod(k, columns)
            left, top = _SHEET_MARGIN + column * (width + _TILE_GAP), _SHEET_MARGIN + row * step
            page.figimage(
                _render_tile(studio, tile, width / _TILE_HEIGHT),
                xo=left,
                yo=height - top - _TILE_HEIGHT,
                origin="upper",
            )
            for words, below, size, color in (
                (tile.name, 20, 15.0, TEXT_COLOUR),
                *((line, 40 + 16 * k, 10.0, MUTED_COLOUR) for k, line in enumerate(_fit_caption(tile, width))),
            ):
                page.text(left / PAGE_WIDTH, 1 - (top + _TILE_HEIGHT + below) / height, words, size=size, color=color)
        footer = "   ·   ".join((*facts, *describe_machine_and_commit([tile.replay.properties for tile in tiles])))
        page.text(_SHEET_MARGIN / PAGE_WIDTH, _SHEET_MARGIN / height, footer, size=10.0, color=MUTED_COLOUR)
        save_page(page, path)


def choose_column_count(count: int) -> int:
    """Return the number of columns that leaves the fewest cells empty.

    Among equal choices it is the number closest to 4.
    """
    if count < _MIN_COLUMNS:
        return max(count, 1)
    return min(range(_MIN_COLUMNS, _MAX_COLUMNS + 1), key=lambda columns: (-count % columns, abs(columns - 4)))


def _fit_caption(tile: SceneTile, width: int) -> list[str]:
    """Return the effects and the notes in lines; where they do not fit, the last effects are left out."""
    effects, lines = tile.effect_words.split(", "), list[str]()
    notes = [
        *describe_outside(framed_vertex_mask(tile.replay, [-1])),
        *describe_self_intersection(tile.replay, [-1]),
    ]
    for count in range(len(effects), -1, -1):
        shown = [*effects[:count], *(["…"] if count < len(effects) else []), *notes]
        lines = wrap(", ".join(shown), int(width / 7.2))
        if len(lines) <= _MAX_CAPTION_LINES:
            break
    return lines[:_MAX_CAPTION_LINES]


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
