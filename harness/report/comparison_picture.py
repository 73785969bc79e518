# pyright: reportUnknownMemberType=false
# Matplotlib's stubs do not type most keywords.
"""Side-by-side pictures of solvers: final frames and costs.

For each scene and size, all frames share one camera and one scale.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from math import ceil, sqrt
from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
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
    new_page,
    paste_picture,
    save_page,
    scene_headline,
)
from springbench.harness.report.plot_style import (
    MUTED_COLOUR,
    PAGE_HEIGHT,
    PAGE_RC,
    PAGE_WIDTH,
    RULE_COLOUR,
    SeriesStyle,
    assign_solver_styles,
)
from springbench.harness.report.recorded_strain import mean_rest_length
from springbench.harness.report.self_intersection_notes import describe_self_intersection

_PANELS_LEFT, _PANELS_TOP, _PANELS_RIGHT, _PANELS_BOTTOM = 40, 118, PAGE_WIDTH - 40, PAGE_HEIGHT - 28
_HEADING_HEIGHT, _CAPTION_HEIGHT, _TILE_GAP = 26, 104, 16


class _TileGrid(NamedTuple):
    """Layout of the panels and of the tiles within a panel.

    `width` and `height` are those of a tile [pixels].
    """

    panel_columns: int
    tile_columns: int
    width: int
    height: int


def draw_comparison_picture(replays: Mapping[str, RecordingReplay], path: Path) -> None:
    """Draw the final frames of several runs as one PNG picture.

    The picture is PAGE_WIDTH pixels wide and at most PAGE_HEIGHT high. Distances refer to the run with the lowest
    residual of each scene and size.

    Args:
        replays: runs by label; the label is shown where the solver's name is ambiguous.
        path: target file.

    Raises:
        RunFailed: if the system cannot draw.
        ValueError: if there are no replays.
    """
    if not replays:
        raise ValueError("a comparison needs at least one recording")
    finite = [replay for replay in replays.values() if _has_finite_end(replay)]
    limit = strain_scale_limit(finite, [-1] * len(finite)) if finite else max(r.strain_range for r in replays.values())
    panels: dict[str, list[tuple[str, RecordingReplay]]] = {}
    for label, replay in replays.items():
        panels.setdefault(scene_headline(replay), []).append((label, replace(replay, strain_range=limit)))
    looks = assign_solver_styles(_solver_name(label, replay) for label, replay in replays.items())
    grid = _choose_grid(len(panels), max(map(len, panels.values())), _median_aspect(finite))
    rows = ceil(len(panels) / grid.panel_columns)
    across = (_PANELS_RIGHT - _PANELS_LEFT + 2 * _TILE_GAP) / grid.panel_columns
    tile_rows = ceil(max(map(len, panels.values())) / grid.tile_columns)
    down = min(
        _HEADING_HEIGHT + tile_rows * (grid.height + _CAPTION_HEIGHT) + _TILE_GAP,
        (_PANELS_BOTTOM - _PANELS_TOP + _TILE_GAP) / rows,
    )
    with matplotlib.rc_context(PAGE_RC), OffscreenRenderer(grid.width, grid.height) as studio:
        page = new_page()
        _draw_title(page, panels)
        draw_strain_scale(
            page,
            limit,
            strain_extremes(finite),
            pins=any(len(replay.pinned_vertices) for replay in replays.values()),
        )
        for k, (heading, panel) in enumerate(panels.items()):
            row, column = divmod(k, grid.panel_columns)
            left, top = round(_PANELS_LEFT + column * across), round(_PANELS_TOP + row * down)
            if len(panels) > 1:
                draw_text(page, left + 2, top + 16, shorten_words(heading, int(across / 9)), size=11.5, weight="bold")
            _draw_panel(page, studio, panel, left, top + _HEADING_HEIGHT, grid, looks)
        used = min(_PANELS_TOP + rows * down + 12, PAGE_HEIGHT)
        draw_provenance(page, replays.values(), used - 12)
        save_page(page, path, used_height=used)


def _median_aspect(finite: Sequence[RecordingReplay]) -> float:
    """Return the median ratio of width to height of the final frames."""
    shapes = [
        view_aspect(points_to_frame(r, [-1]), choose_view_angles(r.positions[-1], compute_area_vectors(r, -1)))
        for r in finite
    ]
    return float(np.clip(np.median(shapes), 0.5, 2.2)) if shapes else 1.0


def _choose_grid(panels: int, tiles: int, aspect: float) -> _TileGrid:
    """Return the grid that shows scenes of this aspect ratio largest.

    Empty cells are penalised.
    """

    def grid(panel_columns: int, tile_columns: int) -> _TileGrid:
        columns = panel_columns * tile_columns
        rows = ceil(panels / panel_columns) * ceil(tiles / tile_columns)
        width = (_PANELS_RIGHT - _PANELS_LEFT - (columns + panel_columns) * _TILE_GAP) // columns
        height = (
            _PANELS_BOTTOM - _PANELS_TOP - ceil(panels / panel_columns) * (_HEADING_HEIGHT + _TILE_GAP)
        ) // rows - _CAPTION_HEIGHT
        return _TileGrid(panel_columns, tile_columns, max(width, 48), max(min(height, int(width / aspect)), 48))

    choices = [grid(p, t) for p, t in product(range(1, panels + 1), range(1, tiles + 1))]

    def compute_tile_size(g: _TileGrid) -> float:
        cells = g.tile_columns * ceil(tiles / g.tile_columns) * g.panel_columns * ceil(panels / g.panel_columns)
        return min(g.width, aspect * g.height) * sqrt(panels * tiles / cells)

    return max(choices, key=compute_tile_size)


def _draw_title(page: Figure, panels: Mapping[str, Sequence[tuple[str, RecordingReplay]]]) -> None:
    meaning = "largest strain: all frames; distance: farthest vertex from the run of lowest residual, mean rest lengths"
    if len(panels) > 1:
        draw_header(page, "Solvers side by side", [meaning])
        return
    ((heading, panel),) = panels.items()
    replay = panel[0][1]
    size = f"{format_count(replay.positions.shape[1])} vertices, {format_count(len(replay.springs))} springs"
    draw_header(page, heading, [size, meaning])


def _draw_panel(
    page: Figure,
    studio: OffscreenRenderer,
    panel: Sequence[tuple[str, RecordingReplay]],
    left: int,
    top: int,
    grid: _TileGrid,
    styles: Mapping[str, SeriesStyle],
) -> None:
    """Draw the tiles of one scene and size with the same camera."""
    finite = [replay for _, replay in panel if _has_finite_end(replay)]
    points = np.concatenate([r.positions[-1][framed_vertex_mask(r, [-1])] for r in finite] or [np.zeros((1, 3))])
    areas = np.concatenate([compute_area_vectors(r, -1) for r in finite] or [np.zeros((0, 3))])
    angles = choose_view_angles(points, areas)
    points = np.concatenate([points_to_frame(r, [-1]) for r in finite] or [points])
    view = fit_camera(points, aspect=grid.width / grid.height, angles=angles)
    solvers = [_solver_name(*entry) for entry in panel]
    best = panel[find_reference_run([replay for _, replay in panel])][1]
    for k, (label, replay) in enumerate(panel):
        # Runs of one solver with different settings are shown by their labels.
        name = solvers[k] if solvers.count(solvers[k]) == 1 else label
        row, column = divmod(k, grid.tile_columns)
        x, y = left + column * (grid.width + _TILE_GAP), top + row * (grid.height + _CAPTION_HEIGHT)
        if _has_finite_end(replay):
            paste_picture(page, studio.render_frame(replay, len(replay.frames) - 1, view), x, y)
            warnings = [*describe_outside(framed_vertex_mask(replay, [-1])), *describe_self_intersection(replay, [-1])]
            draw_text(page, x + 3, y + grid.height - 4, ", ".join(warnings), size=9, color=MUTED_COLOUR)
        else:
            first = replay.frames[len(find_drawable_frames(replay))]
            words = f"not finite\nfrom frame {first} on"
            box = {"facecolor": "none", "edgecolor": RULE_COLOUR, "boxstyle": "round,pad=1.2"}
            middle = x + grid.width / 2, y + grid.height / 2
            draw_text(page, *middle, words, size=10.5, ha="center", va="center", bbox=box)
        _draw_caption(page, name, styles[solvers[k]], _collect_facts(replay, best), x, y + grid.height, grid.width)


def _draw_caption(
    page: Figure, solver: str, mark: SeriesStyle, facts: Mapping[str, str], x: int, y: int, width: int
) -> None:
    """Draw the solver's marker and name, and a small table of quantities below them."""
    small = width < 210
    dot = Line2D(
        [(x + 8) / PAGE_WIDTH], [1 - (y + 12) / PAGE_HEIGHT], color=mark.color, marker=mark.marker, markersize=7
    )
    page.add_artist(dot)
    draw_text(
        page, x + 20, y + 16, shorten_words(solver, int((width - 18) / 8.5)), size=9 if small else 10.5, weight="bold"
    )
    size, value_at = (7.5, 78) if small else (9, 112)
    for line, (what, value) in enumerate(facts.items()):
        at = y + 35 + line * (15 if small else 17)
        draw_text(page, x + 3, at, what, size=size, color=MUTED_COLOUR)
        draw_text(page, x + value_at, at, value, size=size)


def _solver_name(label: str, replay: RecordingReplay) -> str:
    return str(replay.properties.get("solver", label))


def _collect_facts(replay: RecordingReplay, best: RecordingReplay) -> dict[str, str]:
    strain = max_recorded_strain(replay)
    cost = replay.properties.get("milliseconds_per_step")
    return {
        "ms a step": "–" if cost is None else format_quantity(float(cost)),
        "largest strain": f"{100 * strain:.3g} %" if np.isfinite(strain) else "–",
        "residual": _format_last_value(replay, "residual"),
        "distance": format_distance(replay, best),
    }


def _has_finite_end(replay: RecordingReplay) -> bool:
    return 0 < len(replay.frames) == len(find_drawable_frames(replay))


def _compute_distance(replay: RecordingReplay, reference: RecordingReplay) -> float:
    """Return the largest vertex distance [mean rest lengths].

    The result is NaN if the runs end in different frames, have different meshes, or have non-finite positions.
    """
    comparable = (
        _has_finite_end(replay)
        and _has_finite_end(reference)
        and replay.frames[-1] == reference.frames[-1]
        and replay.positions.shape[1] == reference.positions.shape[1]
    )
    if not comparable:
        return np.nan
    away = replay.absolute_positions(-1) - reference.absolute_positions(-1)
    return float(np.linalg.norm(away, axis=1).max(initial=0.0) / mean_rest_length(replay))


def find_reference_run(replays: Sequence[RecordingReplay]) -> int:
    """Return the index of the run that the distances of one scene refer to.

    It is the run with the lowest last residual among those that end finite, so that the run closest to the minimum is
    the reference, whatever the order of the list. If no run ends finite, it is the first one with the lowest residual.
    """

    def badness(k: int) -> tuple[bool, float]:
        known = "/residual" in replays[k].scalars and len(replays[k].scalars["/residual"][1])
        last = float(replays[k].scalars["/residual"][1][-1]) if known else np.inf
        return not _has_finite_end(replays[k]), last if np.isfinite(last) else np.inf

    return min(range(len(replays)), key=badness)


def format_distance(replay: RecordingReplay, best: RecordingReplay) -> str:
    """Format the largest distance of a vertex from the reference run [mean rest lengths].

    Args:
        replay: recording whose last frame is compared.
        best: recording of the reference run, the one closest to the minimum.

    Returns:
        The distance; "reference" for that run itself, and a dash if the runs are not comparable.
    """
    distance = _compute_distance(replay, best)
    return "reference" if replay is best else "–" if np.isnan(distance) else f"{distance:.2g}"


def _format_last_value(replay: RecordingReplay, name: str) -> str:
    """Format the last recorded value of a scalar."""
    if f"/{name}" not in replay.scalars:
        return "–"
    _, values = replay.scalars[f"/{name}"]
    return f"{values[-1]:.1e}" if len(values) else "–"
