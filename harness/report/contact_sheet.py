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

from harness.record.base import Replay
from harness.record.framing import outside_words
from harness.report.origin import machine_and_commit
from harness.report.page import save
from harness.report.render import Studio, area_vectors, frame_all, natural_angles
from harness.report.self_contact import self_contact_words
from harness.report.solids import framed, seen
from harness.report.style import DPI, INK, MUTED, PAGE, RC, WIDTH

_MOST, _FEWEST = 5, 3
"""Largest and smallest number of tiles in a row."""
_LINES = 70
"""Pixels per vertex above which mesh lines are drawn; low, because the mesh should be visible at least as a texture."""
_BOB, _HEAVY = 0.03, 20.0
"""Radius of balls [share of the scene's size], drawn at vertices whose mass exceeds this multiple of the median."""
_MARGIN, _GAP, _TILE, _CAPTION, _FOOT = 28, 20, 290, 78, 24
"""Pixels: margin of the sheet, gap between tiles, height of a tile, caption below it, text at the foot of the sheet."""


@dataclass(frozen=True, slots=True, eq=False)
class Tile:
    """A scene at one time.

    Attributes:
        replay: recording of the start and of the frame to draw; its properties include the processor (`cpu`) and
            `commit`.
        mass: vertex masses (n,) [kg].
        name: name of the scene.
        effects: effects of the scene, in words.
        angles: azimuth and elevation of the camera [degrees]; None to choose them by the mesh's shape.
    """

    replay: Replay
    mass: NDArray[np.float64]
    name: str
    effects: str
    angles: tuple[float, float] | None


def draw_sheet(tiles: Sequence[Tile], path: Path, facts: Sequence[str] = ()) -> None:
    """Draw the gallery as a PNG file, tile by tile.

    Facts, processor and commit are stated at the foot.

    Args:
        tiles: scenes in the order in which they are drawn.
        path: target file.
        facts: phrases at the foot, before processor and commit.
    Raises:
        RunFailed: if the system cannot draw.
    """
    columns = abreast(len(tiles))
    width = (WIDTH - 2 * _MARGIN - (columns - 1) * _GAP) // columns
    step = _TILE + _CAPTION
    height = 2 * _MARGIN + -(-len(tiles) // columns) * step + _FOOT - _GAP // 2
    with matplotlib.rc_context(RC), Studio(width, _TILE, mesh_lines=_LINES) as studio:
        page = Figure(figsize=(WIDTH / DPI, height / DPI), dpi=DPI, facecolor=PAGE)
        FigureCanvasAgg(page)
        for k, tile in enumerate(tiles):
            row, column = divmod(k, columns)
            left, top = _MARGIN + column * (width + _GAP), _MARGIN + row * step
            page.figimage(_drawn(studio, tile, width / _TILE), xo=left, yo=height - top - _TILE, origin="upper")
            for words, below, size, color in ((tile.name, 20, 15.0, INK), *_lines(_words(tile), width)):
                page.text(left / WIDTH, 1 - (top + _TILE + below) / height, words, size=size, color=color)
        said = "   ·   ".join((*facts, *machine_and_commit([tile.replay.properties for tile in tiles])))
        page.text(_MARGIN / WIDTH, _MARGIN / height, said, size=10.0, color=MUTED)
        save(page, path)


def abreast(count: int) -> int:
    """Return the number of columns that leaves the fewest cells empty.

    Among equal choices it is the number closest to 4.
    """
    if count < _FEWEST:
        return max(count, 1)
    return min(range(_FEWEST, _MOST + 1), key=lambda columns: (-count % columns, abs(columns - 4)))


def _words(tile: Tile) -> str:
    return ", ".join([tile.effects, *outside_words(framed(tile.replay, [-1])), *self_contact_words(tile.replay, [-1])])


def _lines(effects: str, width: int) -> list[tuple[str, int, float, str]]:
    """Wrap the effects into at most two lines with offset, size and colour."""
    lines = wrap(effects, int(width / 7.2), max_lines=2, placeholder=" …")
    return [(words, 40 + 16 * k, 10.0, MUTED) for k, words in enumerate(lines)]


def _drawn(studio: Studio, tile: Tile, aspect: float) -> np.ndarray:
    replay, points = tile.replay, tile.replay.positions[-1][framed(tile.replay, [-1])]
    radius = _BOB * float(np.linalg.norm(np.ptp(points, axis=0)))
    bobs = [pv.Sphere(radius=radius, center=p) for p in replay.positions[-1][tile.mass > _HEAVY * np.median(tile.mass)]]
    angles = tile.angles or natural_angles(points, area_vectors(replay, -1))
    return studio.draw(replay, -1, frame_all(seen(replay, [-1]), aspect=aspect, angles=angles), bobs)
