"""Recordings of one scene and size side by side in one file: a view for each solver, one plot for each quantity.

The chunks of each recording are copied as they are, under the name of its solver.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from harness.record import cells, curves
from harness.record.blueprint import panels, plot, scene_view
from harness.record.camera import Extent
from harness.record.partial import PartialFile
from harness.record.reader import Source, looked_at, network, open_recording, positions, properties, triangles

_QUANTITIES = {
    "/residual/log10": "log10 residual [J^(1/2)]",
    "/strain/largest": "Largest strain of a spring",
    "/milliseconds/step": "Milliseconds of a step",
    "/energy/springs": "Elastic energy [J]",
    "/iterations": "Iterations of a step",
}
_SHOWN = 3
"""How many of them are seen at once; the others share tabs with the convergence and the runs."""


class Look(NamedTuple):
    """How a run's lines are drawn: a colour such as `#0072b2`."""

    color: str


def side_by_side(out: Path, recordings: Mapping[str, Path], title: str, looks: Mapping[str, Look]) -> None:
    """Write to `out` the recordings, by solver, side by side on one time line; looks: by the same names.

    Raises InputError for a file that is not the recording of a run, RunFailed when `out` cannot be written.
    """
    file = PartialFile(out, f"springbench side by side {title}", title, title)
    try:
        aspect = 1.0 if len(recordings) < 3 else 0.75
        runs = [_copy(file, path, name, k, looks[name], aspect) for k, (name, path) in enumerate(recordings.items())]
        for frame in sorted(set[int]().union(*(run.curves for run in runs))):
            drawn = {run.name: run.curves[frame] for run in runs if frame in run.curves}
            colours = curves.colours(_colour(looks[name]) for name in drawn)
            curves.draw(file.stream, f"/curves/frame_{frame}", drawn, colours)
        document = rr.TextDocument(_table(title, runs), media_type=rr.MediaType.MARKDOWN)
        file.stream.log("/runs", document, static=True)
        file.finish(_layout(runs))
    finally:
        file.abandon()


class _Run:
    """One recording: where it went and what its views need to know."""

    def __init__(self, name: str, k: int, source: Source, aspect: float) -> None:
        fixed = network(source)
        # Entities take few characters unescaped; the number keeps names apart that differ in others.
        self.name, self.root = name, f"/{k + 1}-{re.sub(r'[^A-Za-z0-9_.]+', '-', name)}"
        self.strain_range, self.time_step = float(fixed["strain_range"][0]), float(fixed["time_step"][0])
        self.properties: dict[str, Any] = properties(source)[1]
        self.triangles = len(triangles(source))
        self.entities: set[str] = set()
        self.box: Extent | None = None
        self.last = 0
        self.curves = residuals(source)
        for frame, _, p in positions(source):
            self.box = self.box or Extent(p, aspect)
            self.box.add(p)
            self.last = max(self.last, frame)


def _copy(file: PartialFile, path: Path, name: str, k: int, look: Look, aspect: float) -> _Run:
    with open_recording(path) as source:
        run = _Run(name, k, source, aspect)
        for chunk in source.chunks(content="/**"):
            run.entities.add(chunk.entity_path)
            file.stream.send_chunks(chunk.with_entity_path(run.root + chunk.entity_path))
    for entity in run.entities & set(_QUANTITIES):
        lines = rr.SeriesLines(names=name, colors=_colour(look), widths=1.5)
        file.stream.log(run.root + entity, lines, static=True)
    if run.box:
        strip, numbers = run.box.scale(run.strain_range)
        file.stream.log(f"{run.root}/scene/scale", strip, static=True)
        file.stream.log(f"{run.root}/scene/scale/numbers", numbers, static=True)
    file.flush()
    return run


def residuals(source: Source) -> dict[int, list[float]]:
    """How the frames converged that were looked at: frame -> the residual [J^(1/2)] after each iteration."""
    found: dict[int, list[float]] = {}
    for chunk in source.chunks(content="/convergence/residual", components=["Scalars:scalars"]):
        frames, _ = looked_at(source, "/convergence/residual")
        values = cells.column(chunk.to_record_batch(), "Scalars:scalars").flatten().to_numpy()
        for frame, of in zip(frames.tolist(), values.reshape(-1, len(frames)).T, strict=True):
            found[frame] = of[~np.isnan(of)].tolist()
    return found


def _colour(look: Look) -> int:
    return int(look.color[1:] + "ff", 16)


def _layout(runs: list[_Run]) -> rrb.Blueprint:
    entities = set[str]().union(*(run.entities for run in runs))
    columns = min(len(runs), 4)
    scenes = [scene_view(run.root, run.name, run.box, springs_visible=not run.triangles) for run in runs if run.box]
    known, last = [entity for entity in _QUANTITIES if entity in entities], max(run.last for run in runs)
    plots = [_plot(runs, entity, _QUANTITIES[entity], last, legend=entity == known[0]) for entity in known]
    frames = sorted(set[int]().union(*(run.curves for run in runs)))
    drawn = [curves.view(f"/curves/frame_{frame}", f"Residual in frame {frame}") for frame in frames]
    table = rrb.TextDocumentView(origin="/runs", name="Runs")
    first = runs[0]
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Grid(*scenes, grid_columns=columns),
            rrb.Horizontal(*plots[:_SHOWN], rrb.Tabs(*drawn, *plots[_SHOWN:], table, active_tab=0)),
            row_shares=[2, 1],
        ),
        *panels(first.time_step),
        auto_views=False,
    )


def _plot(runs: list[_Run], entity: str, name: str, last: int, *, legend: bool) -> rrb.TimeSeriesView:
    return plot(name, [f"+ {run.root}{entity}" for run in runs if entity in run.entities], last=last, legend=legend)


def _table(title: str, runs: list[_Run]) -> str:
    """The runs' properties as Markdown, a column for each run."""
    keys = dict.fromkeys(key for run in runs for key in run.properties)
    rows = [[key, *(f"`{run.properties.get(key, '')}`" for run in runs)] for key in keys]
    head = [["", *(run.name for run in runs)], ["-"] * (len(runs) + 1)]
    return f"# {title}\n\n" + "\n".join(f"| {' | '.join(row)} |" for row in [*head, *rows])
