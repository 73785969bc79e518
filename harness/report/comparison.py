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

from harness.record.base import Replay
from harness.record.framing import outside_words
from harness.report.frames import drawable_frames, largest_strain, shown_limit, strain_ends
from harness.report.origin import made_by
from harness.report.page import (
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
from harness.report.render import Studio, area_vectors, frame_all, natural_angles, shape, spacing
from harness.report.self_contact import self_contact_words
from harness.report.solids import framed, seen
from harness.report.style import HEIGHT, MUTED, RC, RULE, WIDTH, Mark, marks

_LEFT, _TOP, _RIGHT, _BOTTOM = 40, 118, WIDTH - 40, HEIGHT - 28
_HEADING, _CAPTION, _GAP = 26, 104, 16


class _Grid(NamedTuple):
    """Layout of the panels and of the tiles within a panel.

    `width` and `height` are those of a tile [pixels].
    """

    panel_columns: int
    tile_columns: int
    width: int
    height: int


def draw_comparison(replays: Mapping[str, Replay], path: Path) -> None:
    """Draw the final frames of several runs as one PNG picture.

    The picture is WIDTH pixels wide and at most HEIGHT high. Distances refer to the run with the lowest
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
    finite = [replay for replay in replays.values() if _ends_finite(replay)]
    limit = shown_limit(finite, [-1] * len(finite)) if finite else max(r.strain_range for r in replays.values())
    panels: dict[str, list[tuple[str, Replay]]] = {}
    for label, replay in replays.items():
        panels.setdefault(headline(replay), []).append((label, replace(replay, strain_range=limit)))
    looks = marks(_solver(label, replay) for label, replay in replays.items())
    grid = _layout(len(panels), max(map(len, panels.values())), _shape(finite))
    rows = ceil(len(panels) / grid.panel_columns)
    across = (_RIGHT - _LEFT + 2 * _GAP) / grid.panel_columns
    tile_rows = ceil(max(map(len, panels.values())) / grid.tile_columns)
    down = min(_HEADING + tile_rows * (grid.height + _CAPTION) + _GAP, (_BOTTOM - _TOP + _GAP) / rows)
    with matplotlib.rc_context(RC), Studio(grid.width, grid.height) as studio:
        page = new_page()
        _title(page, panels)
        strain_scale(
            page,
            limit,
            strain_ends(finite),
            pins=any(len(replay.pinned) for replay in replays.values()),
        )
        for k, (heading, panel) in enumerate(panels.items()):
            row, column = divmod(k, grid.panel_columns)
            left, top = round(_LEFT + column * across), round(_TOP + row * down)
            if len(panels) > 1:
                text(page, left + 2, top + 16, shorten(heading, int(across / 9)), size=11.5, weight="bold")
            _panel(page, studio, panel, left, top + _HEADING, grid, looks)
        used = min(_TOP + rows * down + 12, HEIGHT)
        made_by(page, replays.values(), used - 12)
        save(page, path, used=used)


def _shape(finite: Sequence[Replay]) -> float:
    """Return the median ratio of width to height of the final frames."""
    shapes = [shape(seen(r, [-1]), natural_angles(r.positions[-1], area_vectors(r, -1))) for r in finite]
    return float(np.clip(np.median(shapes), 0.5, 2.2)) if shapes else 1.0


def _layout(panels: int, tiles: int, aspect: float) -> _Grid:
    """Return the grid that shows scenes of this aspect ratio largest.

    Empty cells are penalised.
    """

    def grid(panel_columns: int, tile_columns: int) -> _Grid:
        columns = panel_columns * tile_columns
        rows = ceil(panels / panel_columns) * ceil(tiles / tile_columns)
        width = (_RIGHT - _LEFT - (columns + panel_columns) * _GAP) // columns
        height = (_BOTTOM - _TOP - ceil(panels / panel_columns) * (_HEADING + _GAP)) // rows - _CAPTION
        return _Grid(panel_columns, tile_columns, max(width, 48), max(min(height, int(width / aspect)), 48))

    choices = [grid(p, t) for p, t in product(range(1, panels + 1), range(1, tiles + 1))]

    def worth(g: _Grid) -> float:
        cells = g.tile_columns * ceil(tiles / g.tile_columns) * g.panel_columns * ceil(panels / g.panel_columns)
        return min(g.width, aspect * g.height) * sqrt(panels * tiles / cells)

    return max(choices, key=worth)


def _title(page: Figure, panels: Mapping[str, Sequence[tuple[str, Replay]]]) -> None:
    meaning = "largest strain: all frames; distance: farthest vertex from the run of lowest residual, mean rest lengths"
    if len(panels) > 1:
        header(page, "Solvers side by side", [meaning])
        return
    ((heading, panel),) = panels.items()
    replay = panel[0][1]
    size = f"{count(replay.positions.shape[1])} vertices, {count(len(replay.springs))} springs"
    header(page, heading, [size, meaning])


def _panel(
    page: Figure,
    studio: Studio,
    panel: Sequence[tuple[str, Replay]],
    left: int,
    top: int,
    grid: _Grid,
    looks: Mapping[str, Mark],
) -> None:
    """Draw the tiles of one scene and size with the same camera."""
    finite = [replay for _, replay in panel if _ends_finite(replay)]
    points = np.concatenate([r.positions[-1][framed(r, [-1])] for r in finite] or [np.zeros((1, 3))])
    areas = np.concatenate([area_vectors(r, -1) for r in finite] or [np.zeros((0, 3))])
    angles = natural_angles(points, areas)
    points = np.concatenate([seen(r, [-1]) for r in finite] or [points])
    view = frame_all(points, aspect=grid.width / grid.height, angles=angles)
    solvers = [_solver(*entry) for entry in panel]
    best = panel[reference([replay for _, replay in panel])][1]
    for k, (label, replay) in enumerate(panel):
        # Runs of one solver with different settings are shown by their labels.
        name = solvers[k] if solvers.count(solvers[k]) == 1 else label
        row, column = divmod(k, grid.tile_columns)
        x, y = left + column * (grid.width + _GAP), top + row * (grid.height + _CAPTION)
        if _ends_finite(replay):
            paste(page, studio.draw(replay, len(replay.frames) - 1, view), x, y)
            warnings = [*outside_words(framed(replay, [-1])), *self_contact_words(replay, [-1])]
            text(page, x + 3, y + grid.height - 4, ", ".join(warnings), size=9, color=MUTED)
        else:
            first = replay.frames[len(drawable_frames(replay))]
            words = f"not finite\nfrom frame {first} on"
            box = {"facecolor": "none", "edgecolor": RULE, "boxstyle": "round,pad=1.2"}
            middle = x + grid.width / 2, y + grid.height / 2
            text(page, *middle, words, size=10.5, ha="center", va="center", bbox=box)
        _caption(page, name, looks[solvers[k]], _facts(replay, best), x, y + grid.height, grid.width)


def _caption(page: Figure, solver: str, mark: Mark, facts: Mapping[str, str], x: int, y: int, width: int) -> None:
    """Draw the solver's marker and name, and a small table of quantities below them."""
    small = width < 210
    dot = Line2D([(x + 8) / WIDTH], [1 - (y + 12) / HEIGHT], color=mark.color, marker=mark.marker, markersize=7)
    page.add_artist(dot)
    text(page, x + 20, y + 16, shorten(solver, int((width - 18) / 8.5)), size=9 if small else 10.5, weight="bold")
    size, value_at = (7.5, 78) if small else (9, 112)
    for line, (what, value) in enumerate(facts.items()):
        at = y + 35 + line * (15 if small else 17)
        text(page, x + 3, at, what, size=size, color=MUTED)
        text(page, x + value_at, at, value, size=size)


def _solver(label: str, replay: Replay) -> str:
    return str(replay.properties.get("solver", label))


def _facts(replay: Replay, best: Replay) -> dict[str, str]:
    strain = largest_strain(replay)
    cost = replay.properties.get("milliseconds_per_step")
    return {
        "ms a step": "–" if cost is None else quantity(float(cost)),
        "largest strain": f"{100 * strain:.3g} %" if np.isfinite(strain) else "–",
        "residual": _last(replay, "residual"),
        "distance": distance_words(replay, best),
    }


def _ends_finite(replay: Replay) -> bool:
    return 0 < len(replay.frames) == len(drawable_frames(replay))


def _distance(replay: Replay, reference: Replay) -> float:
    """Return the largest vertex distance [mean rest lengths].

    The result is NaN if the runs end in different frames or non-finite.
    """
    comparable = (
        _ends_finite(replay)
        and _ends_finite(reference)
        and replay.frames[-1] == reference.frames[-1]
        and replay.positions.shape[1] == reference.positions.shape[1]
    )
    if not comparable:
        return np.nan
    away = replay.absolute_positions(-1) - reference.absolute_positions(-1)
    return float(np.linalg.norm(away, axis=1).max(initial=0.0) / spacing(replay))


def reference(replays: Sequence[Replay]) -> int:
    """Return the index of the run that the distances of one scene refer to.

    It is the run with the lowest last residual among those that end finite, so that the run closest to the minimum is
    the reference, whatever the order of the list. If no run ends finite, it is the first one with the lowest residual.
    """

    def badness(k: int) -> tuple[bool, float]:
        known = "/residual" in replays[k].scalars and len(replays[k].scalars["/residual"][1])
        last = float(replays[k].scalars["/residual"][1][-1]) if known else np.inf
        return not _ends_finite(replays[k]), last if np.isfinite(last) else np.inf

    return min(range(len(replays)), key=badness)


def distance_words(replay: Replay, best: Replay) -> str:
    """Format the distance from the reference run `best`, the one closest to the minimum."""
    distance = _distance(replay, best)
    return "reference" if replay is best else "–" if np.isnan(distance) else f"{distance:.2g}"


def _last(replay: Replay, name: str) -> str:
    """Format the last recorded value of a scalar."""
    if f"/{name}" not in replay.scalars:
        return "–"
    _, values = replay.scalars[f"/{name}"]
    return f"{values[-1]:.1e}" if len(values) else "–"
