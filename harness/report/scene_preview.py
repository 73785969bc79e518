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
from springbench.harness.recording.recorder_interface import RecordingReplay
from springbench.harness.report.mesh_rendering import (
    OffscreenRenderer,
    choose_view_angles,
    compute_area_vectors,
    fit_camera,
)
from springbench.harness.report.obstacle_meshes import points_to_frame
from springbench.harness.report.page_layout import (
    draw_header,
    draw_provenance,
    draw_text,
    new_page,
    paste_picture,
    save_page,
)
from springbench.harness.report.plot_style import (
    MUTED_COLOUR,
    PAGE_HEIGHT,
    PAGE_RC,
    PAGE_WIDTH,
    TEXT_COLOUR,
    build_indexed_style,
)

_VIEW_LEFT, _VIEW_TOP, _COLUMN_GAP, _LEGEND_ROW_HEIGHT = 36, 114, 40, 24
_LEGEND_WIDTH, _VIEW_HEIGHT = 420, 750
_LINE_LETTERS = 52
_PIXELS_PER_VERTEX = 120
"""Pixels per vertex above which mesh lines are drawn: selections are recognised by their place on the mesh."""


@dataclass(frozen=True, slots=True, eq=False)
class MarkedPoints:
    """Points (q, 3) [m] that a preview marks in one colour."""

    label: str
    description: str
    points: NDArray[np.float64]


def draw_scene_preview(
    replay: RecordingReplay,
    marks: Sequence[MarkedPoints],
    facts: Sequence[str],
    notes: Sequence[tuple[str, str]],
    path: Path,
    *,
    camera: tuple[float, float] | None = None,
) -> None:
    """Draw the preview of a scene as a PNG file, PAGE_WIDTH pixels wide.

    Args:
        replay: recording of one frame.
        marks: points to mark, relative to the origin of the recording.
        facts: phrases below the title.
        notes: further possible selections, as pairs of kind and description.
        path: target file.
        camera: azimuth and elevation [degrees]; None to choose them by the mesh's shape.

    Raises:
        RunFailed: if the system cannot draw.
    """
    wide, p = PAGE_WIDTH - 2 * _VIEW_LEFT - _COLUMN_GAP - _LEGEND_WIDTH, replay.positions[0]
    angles = camera or choose_view_angles(p, compute_area_vectors(replay, 0))
    dots = [(one.points, build_indexed_style(k).color) for k, one in enumerate(marks)]
    with matplotlib.rc_context(PAGE_RC), OffscreenRenderer(wide, _VIEW_HEIGHT, mesh_lines=_PIXELS_PER_VERTEX) as studio:
        page = new_page()
        draw_header(page, replay.title, facts)
        view = fit_camera(points_to_frame(replay, [0]), aspect=wide / _VIEW_HEIGHT, angles=angles)
        paste_picture(page, studio.render_frame(replay, 0, view, coloured_points=dots), _VIEW_LEFT, _VIEW_TOP)
        x, y = PAGE_WIDTH - _VIEW_LEFT - _LEGEND_WIDTH, _VIEW_TOP + _LEGEND_ROW_HEIGHT
        for k, one in enumerate(marks):
            draw_text(page, x, y, "●", size=13, color=build_indexed_style(k).color)
            draw_text(page, x + 24, y, one.label, size=12, color=TEXT_COLOUR)
            y = _draw_paragraph(page, one.description, x + 24, y + 19) + 12
        y += _LEGEND_ROW_HEIGHT
        for kind, words in notes:
            draw_text(page, x, y, kind, size=11, color=TEXT_COLOUR)
            y = _draw_paragraph(page, words, x, y + 19) + 12
        draw_provenance(page, [replay], PAGE_HEIGHT - 12)
        save_page(page, path)


def _draw_paragraph(page: Figure, words: str, x: float, y: float) -> float:
    """Draw small text in a few lines, and return the y position below it."""
    for line in wrap(words, _LINE_LETTERS, max_lines=6, placeholder=" …"):
        draw_text(page, x, y, line, size=9.5, color=MUTED_COLOUR)
        y += 16
    return y
