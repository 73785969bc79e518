"""Recordings of one scene and size side by side in one file: a view for each solver, one plot for each quantity.

The chunks of each recording are copied as they are, under the name of its solver.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import rerun as rr
import rerun.blueprint as rrb

from harness.record.blueprint import Box, panels, plot, scale_view, scene_view
from harness.record.partial import PartialFile
from harness.record.reader import Source, network, open_recording, positions, properties, triangles

_QUANTITIES = {
    "/residual/log10": "log10 of the residual [J^(1/2)]",
    "/strain/largest": "Largest strain of a spring",
    "/milliseconds/step": "Milliseconds of a step",
    "/energy/springs": "Elastic energy [J]",
    "/iterations": "Iterations of a step",
}
_SHOWN = 3
"""How many of them are seen at once; the others share tabs with the convergence and the runs."""

_CURVE = "/convergence/log10_residual/frame_"


_Shape = rr.components.MarkerShape
_SHAPES = {
    "o": _Shape.Circle, "s": _Shape.Square, "D": _Shape.Diamond, "^": _Shape.Up, "v": _Shape.Down, "<": _Shape.Left,
    ">": _Shape.Right, "P": _Shape.Plus, "X": _Shape.Cross, "*": _Shape.Asterisk,
}  # fmt: skip
"""The viewer's markers by Matplotlib's; it has no others, and draws circles for those."""


class Look(NamedTuple):
    """How a run's lines are drawn: a colour such as `#0072b2`, and one of Matplotlib's markers."""

    color: str
    marker: str


def side_by_side(out: Path, recordings: Mapping[str, Path], title: str, looks: Mapping[str, Look]) -> None:
    """Write to `out` the recordings, by solver, side by side on one time line; looks: by the same names.

    Raises InputError for a file that is not the recording of a run, RunFailed when `out` cannot be written.
    """
    file = PartialFile(out, f"springbench side by side {title}", title, title)
    try:
        runs = [_copy(file, path, name, k, looks[name]) for k, (name, path) in enumerate(recordings.items())]
        document = rr.TextDocument(_table(title, runs), media_type=rr.MediaType.MARKDOWN)
        file.stream.log("/runs", document, static=True)
        file.finish(_layout(runs))
    finally:
        file.abandon()


class _Run:
    """One recording: where it went and what its views need to know."""

    def __init__(self, name: str, k: int, source: Source) -> None:
        fixed = network(source)
        # Entities take few characters unescaped; the number keeps names apart that differ in others.
        self.name, self.root = name, f"/{k + 1}-{re.sub(r'[^A-Za-z0-9_.]+', '-', name)}"
        self.strain_range, self.time_step = float(fixed["strain_range"][0]), float(fixed["time_step"][0])
        self.properties: dict[str, Any] = properties(source)[1]
        self.triangles = len(triangles(source))
        self.entities: set[str] = set()
        self.box: Box | None = None
        for _, _, p in positions(source):
            self.box = self.box or Box(p)
            self.box.add(p)


def _copy(file: PartialFile, path: Path, name: str, k: int, look: Look) -> _Run:
    with open_recording(path) as source:
        run = _Run(name, k, source)
        for chunk in source.chunks(content="/**"):
            run.entities.add(chunk.entity_path)
            file.stream.send_chunks(chunk.with_entity_path(run.root + chunk.entity_path))
    colour = int(look.color[1:] + "ff", 16)
    for entity in run.entities:
        if entity in _QUANTITIES or entity.startswith(_CURVE):
            file.stream.log(run.root + entity, rr.SeriesLines(names=name, colors=colour, widths=1.5), static=True)
        if entity.startswith(_CURVE):
            points = rr.SeriesPoints(
                names=name, colors=colour, markers=_SHAPES.get(look.marker, _Shape.Circle), marker_sizes=3
            )
            file.stream.log(run.root + entity, points, static=True)
    file.flush()
    return run


def _layout(runs: list[_Run]) -> rrb.Blueprint:
    entities = set[str]().union(*(run.entities for run in runs))
    columns = min(len(runs), 4)
    scenes = [
        scene_view(run.root, run.name, run.box, springs_visible=not run.triangles, aspect=min(1.0, 3.2 / columns))
        for run in runs
        if run.box
    ]
    known = [entity for entity in _QUANTITIES if entity in entities]
    plots = [_plot(runs, entity, _QUANTITIES[entity], legend=entity == known[0]) for entity in known]
    curves = [
        _plot(
            runs,
            entity,
            f"log10 residual in frame {int(entity.removeprefix(_CURVE))} (timeline: iteration)",
            legend=True,
        )
        for entity in sorted(entities)
        if entity.startswith(_CURVE)
    ]
    table = rrb.TextDocumentView(origin="/runs", name="Runs")
    first = runs[0]
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Grid(*scenes, grid_columns=columns),
            scale_view(first.strain_range, f"{first.root}/legend"),
            rrb.Horizontal(*plots[:_SHOWN], rrb.Tabs(*plots[_SHOWN:], *curves, table, active_tab=0)),
            row_shares=[10, 1.3, 5],
        ),
        *panels(first.time_step),
        auto_views=False,
    )


def _plot(runs: list[_Run], entity: str, name: str, *, legend: bool) -> rrb.TimeSeriesView:
    return plot(name, [f"+ {run.root}{entity}" for run in runs if entity in run.entities], legend=legend)


def _table(title: str, runs: list[_Run]) -> str:
    """The runs' properties as Markdown, a column for each run."""
    keys = dict.fromkeys(key for run in runs for key in run.properties)
    rows = [[key, *(f"`{run.properties.get(key, '')}`" for run in runs)] for key in keys]
    head = [["", *(run.name for run in runs)], ["-"] * (len(runs) + 1)]
    return f"# {title}\n\n" + "\n".join(f"| {' | '.join(row)} |" for row in [*head, *rows])
