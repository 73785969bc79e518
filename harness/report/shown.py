# pyright: reportUnknownMemberType=false
# Matplotlib's stubs do not type most keywords.
"""Preview of a scene at its start.

It shows mesh, obstacles, and the vertices that its effects select, in one colour each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from harness.record.base import Replay
from harness.report.origin import made_by
from harness.report.page import header, new_page, paste, save, text
from harness.report.render import Studio, area_vectors, frame_all, natural_angles
from harness.report.solids import seen
from harness.report.style import HEIGHT, INK, MUTED, RC, WIDTH, numbered

_LEFT, _TOP, _GAP, _ROW = 36, 114, 40, 24
_LEGEND, _TALL = 420, 750
_LETTERS = 52
_LINES = 120
"""Pixels per vertex above which mesh lines are drawn: selections are recognised by their place on the mesh."""


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """Vertices (q,) that an effect selects, and their description."""

    name: str
    how: str
    vertices: NDArray[np.int64]


def draw_scene(
    replay: Replay,
    choices: Sequence[Choice],
    facts: Sequence[str],
    notes: Sequence[tuple[str, str]],
    path: Path,
    *,
    camera: tuple[float, float] | None = None,
) -> None:
    """Draw the preview of a scene as a PNG file, WIDTH pixels wide.

    Args:
        replay: recording of one frame.
        choices: vertices selected by effects.
        facts: phrases below the title.
        notes: further possible selections, as pairs of kind and description.
        path: target file.
        camera: azimuth and elevation [degrees]; None to choose them by the mesh's shape.
    Raises:
        RunFailed: if the system cannot draw.
    """
    wide, p = WIDTH - 2 * _LEFT - _GAP - _LEGEND, replay.positions[0]
    angles = camera or natural_angles(p, area_vectors(replay, 0))
    dots = [(p[one.vertices], numbered(k).color) for k, one in enumerate(choices)]
    with matplotlib.rc_context(RC), Studio(wide, _TALL, mesh_lines=_LINES) as studio:
        page = new_page()
        header(page, replay.title, facts)
        view = frame_all(seen(replay, [0]), aspect=wide / _TALL, angles=angles)
        paste(page, studio.draw(replay, 0, view, dots=dots), _LEFT, _TOP)
        x, y = WIDTH - _LEFT - _LEGEND, _TOP + _ROW
        for k, one in enumerate(choices):
            text(page, x, y, "●", size=13, color=numbered(k).color)
            text(page, x + 24, y, f"{one.name}: {_vertices(len(one.vertices))}", size=12, color=INK)
            y = _paragraph(page, one.how, x + 24, y + 19) + 12
        y += _ROW
        for kind, words in notes:
            text(page, x, y, kind, size=11, color=INK)
            y = _paragraph(page, words, x, y + 19) + 12
        made_by(page, [replay], HEIGHT - 12)
        save(page, path)


def _vertices(count: int) -> str:
    return f"{count:,} {'vertex' if count == 1 else 'vertices'}"


def _paragraph(page: Figure, words: str, x: float, y: float) -> float:
    """Draw small text in a few lines, and return the y position below it."""
    for line in wrap(words, _LETTERS, max_lines=6, placeholder=" …"):
        text(page, x, y, line, size=9.5, color=MUTED)
        y += 16
    return y
