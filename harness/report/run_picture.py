# pyright: reportUnknownMemberType=false
# Matplotlib's stubs do not type most keywords.
"""Picture of one run: its final frame large, and four earlier frames.

The strain scale is above them. The scale covers the typical strains of the shown frames. On a scale set by the
neighbours of a pin most of a mesh would be grey, and on a scale that is too short all of it would have one colour.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from math import ceil
from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray
from springbench.harness.execution.forked_call import start_in_fork
from springbench.harness.recording.camera_framing import describe_outside
from springbench.harness.recording.recorder_interface import RecordingReplay
from springbench.harness.report.drawable_frames import (
    find_drawable_frames,
    framed_vertex_mask,
    max_recorded_strain,
    strain_extremes,
    strain_scale_limit,
)
from springbench.harness.report.mesh_rendering import (
    OffscreenRenderer,
    choose_view_angles,
    compute_area_vectors,
    fit_camera,
    view_aspect,
)
from springbench.harness.report.number_format import format_count, format_quantity, shorten_words
from springbench.harness.report.obstacle_meshes import points_to_frame
from springbench.harness.report.page_layout import (
    draw_header,
    draw_provenance,
    draw_strain_scale,
    draw_text,
    format_frame_time,
    new_page,
    paste_picture,
    save_page,
    scene_headline,
)
from springbench.harness.report.plot_style import (
    BACKGROUND_COLOUR,
    MUTED_COLOUR,
    PAGE_HEIGHT,
    PAGE_RC,
    PAGE_WIDTH,
    RULE_COLOUR,
    TEXT_COLOUR,
)
from springbench.harness.report.self_intersection_notes import describe_self_intersection

_FRAMES_LEFT, _FRAMES_TOP, _FRAMES_RIGHT, _FRAMES_HEIGHT = 36, 114, PAGE_WIDTH - 36, 750
_MAX_FINAL_WIDTH, _MIN_FINAL_WIDTH = 1180, 420  # of the final frame; the earlier ones have the rest
_RULE_GAP, _TILE_GAP, _CAPTION_HEIGHT = 44, 12, 24
_EARLIER_FRAMES = 4  # fills a grid of 1, 2 or 4 columns


class PixelBox(NamedTuple):
    """A rectangle on the page [pixels from the top left]."""

    left: int
    top: int
    width: int
    height: int


def layout_frames(final_aspect: float, run_aspect: float, earlier: int) -> tuple[PixelBox, list[PixelBox]]:
    """Lay out the final frame and the earlier ones.

    Scenes of the given aspect ratios fill their boxes.

    Args:
        final_aspect: width / height of the final frame.
        run_aspect: width / height of all frames together.
        earlier: number of earlier frames.

    Returns:
        The box of the final frame, and those of the earlier ones.
    """
    if not earlier:
        return PixelBox(_FRAMES_LEFT, _FRAMES_TOP, _FRAMES_RIGHT - _FRAMES_LEFT, _FRAMES_HEIGHT), []
    main = PixelBox(
        _FRAMES_LEFT,
        _FRAMES_TOP,
        int(min(max(_FRAMES_HEIGHT * final_aspect, _MIN_FINAL_WIDTH), _MAX_FINAL_WIDTH)),
        _FRAMES_HEIGHT,
    )
    start = main.left + main.width + _RULE_GAP
    room = _FRAMES_RIGHT - start

    def tile(columns: int) -> tuple[float, int, int]:
        rows = ceil(earlier / columns)
        width = (room - (columns - 1) * _TILE_GAP) // columns
        height = (_FRAMES_HEIGHT - rows * _CAPTION_HEIGHT) // rows
        return min(float(width), run_aspect * height), width, min(height, int(width / min(run_aspect, 1.0)))

    columns = max(range(1, earlier + 1), key=lambda c: tile(c)[0])
    _, width, height = tile(columns)
    places = [divmod(k, columns) for k in range(earlier)]
    return main, [
        PixelBox(start + column * (width + _TILE_GAP), _FRAMES_TOP + row * (height + _CAPTION_HEIGHT), width, height)
        for row, column in places
    ]


def draw_run_picture(replay: RecordingReplay, path: Path, *, camera: tuple[float, float] | None = None) -> None:
    """Draw the picture of a run as a PNG file of PAGE_WIDTH x PAGE_HEIGHT pixels.

    If positions become non-finite, the picture states it and shows the frames before.

    Args:
        replay: recording.
        path: target file.
        camera: azimuth and elevation [degrees]; None to choose them by the scene's shape.

    Raises:
        RunFailed: if the system cannot draw.
    """
    good = find_drawable_frames(replay)
    shown = np.unique(np.linspace(0, len(good) - 1, _EARLIER_FRAMES + 1).round().astype(int)) if len(good) else good
    if len(shown):
        replay = replace(replay, strain_range=strain_scale_limit([replay] * len(shown), shown.tolist()))
    with matplotlib.rc_context(PAGE_RC):
        page = new_page()
        draw_header(
            page,
            scene_headline(replay),
            [*_collect_facts(replay), *(_collect_warnings(replay, shown.tolist()) if len(shown) else [])],
        )
        draw_strain_scale(page, replay.strain_range, strain_extremes([replay]), pins=len(replay.pinned_vertices) > 0)
        draw_provenance(page, [replay], PAGE_HEIGHT - 12)
        if len(shown):
            _draw_frames(page, replay, shown, camera)
        total = len(replay.frames)
        if len(good) < total:
            _draw_blow_up_notice(page, replay, len(good))
        save_page(page, path)


def _collect_warnings(replay: RecordingReplay, shown: list[int]) -> list[str]:
    return [*describe_outside(framed_vertex_mask(replay, shown)), *describe_self_intersection(replay, shown)]


def _collect_facts(replay: RecordingReplay) -> list[str]:
    known = replay.properties
    facts = [shorten_words(str(known.get("solver", "")), 48)] if "solver" in known else []
    facts.append(f"{format_count(replay.positions.shape[1])} vertices, {format_count(len(replay.springs))} springs")
    if "milliseconds_per_step" in known:
        facts.append(f"{format_quantity(float(known['milliseconds_per_step']))} ms a step")
    if np.isfinite(strain := max_recorded_strain(replay)):
        facts.append(f"largest strain {100 * strain:.3g} %")
    return facts


def _draw_frames(
    page: Figure, replay: RecordingReplay, shown: NDArray[np.int64], camera: tuple[float, float] | None
) -> None:
    *earlier, final = (int(k) for k in shown)
    points = replay.positions[shown][:, framed_vertex_mask(replay, shown)].reshape(-1, 3)
    angles = choose_view_angles(points, compute_area_vectors(replay, final)) if camera is None else camera
    last, every = points_to_frame(replay, [final]), points_to_frame(replay, (*earlier, final))
    main, tiles = layout_frames(view_aspect(last, angles), view_aspect(every, angles), len(earlier))
    render_tiles = partial(_render_frames, replay, earlier, every, angles, tiles)
    # The first picture of a process is rendered on two cores; OpenGL, once it is used, does not survive a fork.
    wait_for_tiles = render_tiles if OffscreenRenderer.was_opened else start_in_fork(render_tiles)
    (picture,) = _render_frames(replay, [final], last, angles, [main])
    paste_picture(page, picture, main.left, main.top)
    draw_text(page, main.left + 4, main.top + main.height - 4, format_frame_time(replay, final), size=11.5)
    if not tiles:
        return
    x, ends = (tiles[0].left - _RULE_GAP / 2) / PAGE_WIDTH, (main.top + 4, main.top + main.height - 4)
    page.add_artist(Line2D([x, x], [1 - y / PAGE_HEIGHT for y in ends], color=RULE_COLOUR, linewidth=0.8))
    for frame, tile, pixels in zip(earlier, tiles, wait_for_tiles(), strict=True):
        paste_picture(page, pixels, tile.left, tile.top)
        words = format_frame_time(replay, frame)
        draw_text(page, tile.left + 4, tile.top + tile.height + 14, words, size=10, color=MUTED_COLOUR)


def _render_frames(
    replay: RecordingReplay,
    frames: Sequence[int],
    points: NDArray[np.floating],
    angles: tuple[float, float],
    boxes: Sequence[PixelBox],
) -> list[NDArray[np.uint8]]:
    """Render frames for boxes of one size, with a camera that sees the points (q, 3) [m]."""
    if not boxes:
        return []
    box = boxes[0]
    view = fit_camera(points, aspect=box.width / box.height, angles=angles)
    with OffscreenRenderer(box.width, box.height) as studio:
        return [studio.render_frame(replay, frame, view) for frame in frames]


def _draw_blow_up_notice(page: Figure, replay: RecordingReplay, good: int) -> None:
    """Draw a notice with the frame from which on positions cannot be drawn."""
    words = f"not finite from frame {int(replay.frames[good])} on"
    below = f"shown: up to the last finite frame, {int(replay.frames[good - 1])}" if good else "no frame can be drawn"
    middle, y = PAGE_WIDTH / 2, _FRAMES_TOP + 40 if good else _FRAMES_TOP + _FRAMES_HEIGHT / 2
    box = {"facecolor": BACKGROUND_COLOUR, "edgecolor": TEXT_COLOUR, "linewidth": 1.0, "boxstyle": "round,pad=0.6"}
    draw_text(page, middle, y, f"Positions are {words}\n{below}", size=13, ha="center", va="center", bbox=box)
