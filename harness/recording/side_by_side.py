"""Recordings of one scene and size side by side in one file, with shared plots.

Each solver has its own view, and each quantity one plot. The chunks of each recording are copied unchanged under the
name of its solver. Where the strain scales differ, all recordings are coloured by the widest scale.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray
from rerun.chunk import Chunk
from springbench.harness.recording import curve_drawing, recording_reader
from springbench.harness.recording.camera_view import ViewExtent
from springbench.harness.recording.partial_file import PartialFile
from springbench.harness.recording.recording_reader import (
    RecordingSource,
    iterate_positions,
    open_recording_source,
    read_convergence_frames,
    read_network,
    read_properties,
    read_triangles,
)
from springbench.harness.recording.strain_scale import compute_strain_colours, widen_range
from springbench.harness.recording.viewer_blueprint import build_panels, build_plot, build_scene_view
from springbench.harness.scenes.spring_strains import compute_strains

_QUANTITIES = {
    "/residual/log10": "log10 residual [J^(1/2)]",
    "/max_strain": "Largest strain of a spring",
    "/milliseconds/step": "Milliseconds of a step",
    "/energy/springs": "Elastic energy [J]",
    "/num_iterations": "Iterations of a step",
}
_MAX_VISIBLE_PLOTS = 3
"""Number of quantities shown at once; the others are in another tab."""


_MAX_VIEWS_PER_ROW = 4
"""Maximum number of scenes in a row; with this many, each view is higher than wide."""

_STRAIN_ENTITIES = ("/scene/mesh", "/scene/springs")
_COLOURED_COMPONENTS = (
    ("Mesh3D:vertex_positions", "Mesh3D:vertex_colors"),
    ("Points3D:positions", "Points3D:colors"),
    ("LineStrips3D:strips", "LineStrips3D:colors"),
)
"""Pairs of a component with positions and the one with the strain colours at these positions."""


class LineStyle(NamedTuple):
    """Line style of a run.

    `color` is a colour such as `#0072b2`, which is lightened in side-by-side recordings where it is dark.
    """

    color: str


def write_side_by_side(out: Path, recordings: Mapping[str, Path], title: str, styles: Mapping[str, LineStyle]) -> None:
    """Write several recordings side by side on one timeline to one file.

    Args:
        out: path of the new file.
        recordings: paths of the recordings by solver name.
        title: title of the new recording.
        styles: line styles by solver name.

    Raises:
        InputError: a file is not the recording of a run.
        WriteError: `out` cannot be written.
    """
    file = PartialFile(out, f"springbench side by side {title}", title, title)
    try:
        with ExitStack() as opened:
            sources = {name: opened.enter_context(open_recording_source(path)) for name, path in recordings.items()}
            strain_range = max(float(read_network(source)["strain_range"][0]) for source in sources.values())
            box: ViewExtent | None = None  # of all recordings, so that all views have one camera
            runs = list[_SourceRun]()
            for name, source in sources.items():
                runs.append(_SourceRun(name, len(runs), source, strain_range))
                box = runs[-1].widen_extent(source, box, 0.75 if len(sources) == _MAX_VIEWS_PER_ROW else 1.0)
            for run, source in zip(runs, sources.values(), strict=True):
                _copy_chunks(file, run, source, styles[run.name], box)
        for frame in sorted(set[int]().union(*(run.curves for run in runs))):
            drawn = {run.name: run.curves[frame] for run in runs if frame in run.curves}
            colours = curve_drawing.pack_colours(_pack_colour(styles[name]) for name in drawn)
            curve_drawing.draw_curves(file.stream, f"/curves/frame_{frame}", drawn, colours)
        document = rr.TextDocument(_format_table(title, runs), media_type=rr.MediaType.MARKDOWN)
        file.stream.log("/runs", document, static=True)
        file.finish_file(_build_layout(runs, box))
    finally:
        file.abandon_file()


class _SourceRun:
    """One source recording: its root entity and the data its views need."""

    def __init__(self, name: str, k: int, source: RecordingSource, strain_range: float) -> None:
        fixed = read_network(source)
        self.strain_range, self._anew = strain_range, float(fixed["strain_range"][0]) != strain_range
        self._springs = fixed["springs"].reshape(-1, 2).astype(np.int64)
        self._rest_lengths = fixed["rest_lengths"].astype(float)
        self.ends = (0.0, 0.0)  # the smallest and the largest strain of a spring
        # Entity paths allow few unescaped characters; the number separates names that differ only in the replaced ones.
        self.name, self.root = name, f"/{k + 1}-{re.sub(r'[^A-Za-z0-9_.]+', '-', name)}"
        self.time_step = float(fixed["time_step"][0])
        self.properties: dict[str, Any] = read_properties(source)[1]
        self.triangles = len(read_triangles(source))
        self.entities: set[str] = set()
        self.last_frame = self._vertices = 0
        self.curves = read_residuals(source)
        self.ranges: dict[str, tuple[float, float]] = {}  # smallest and largest value of each compared quantity

    def widen_extent(self, source: RecordingSource, box: ViewExtent | None, aspect: float) -> ViewExtent | None:
        """Return the extent, widened to the recording's positions, for a given aspect ratio."""
        for frame, _, p in iterate_positions(source):
            box = box or ViewExtent(p, aspect)
            box.add_positions(p)
            self.last_frame = max(self.last_frame, frame)
            self._vertices = len(p)
            self.ends = widen_range(self.ends, self._compute_strains(p)[0])
        return box

    def _compute_strains(self, p: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the strains of the springs and of the vertices."""
        return compute_strains(p.astype(float), self._springs, self._rest_lengths)

    def widen_ranges(self, chunk: Chunk) -> None:
        """Widen the range of a compared quantity to the values of a chunk."""
        if chunk.entity_path in _QUANTITIES:
            batch = chunk.to_record_batch()
            if "Scalars:scalars" in batch.schema.names:
                values = recording_reader.get_column(batch, "Scalars:scalars").flatten().to_numpy()
                known = values[np.isfinite(values)]
                low, high = self.ranges.get(chunk.entity_path, (np.inf, -np.inf))
                self.ranges[chunk.entity_path] = float(known.min(initial=low)), float(known.max(initial=high))

    def recolour_chunk(self, chunk: Chunk) -> Chunk:
        """Return a chunk in which strain colours use the common scale."""
        batch = chunk.to_record_batch() if self._anew and chunk.entity_path in _STRAIN_ENTITIES else None
        for places, painted in _COLOURED_COMPONENTS if batch else ():
            if batch and {places, painted} <= set(batch.schema.names):
                rows = [
                    self._compute_colours(recording_reader.read_cell(batch, places, k)) for k in range(batch.num_rows)
                ]
                (chunk,) = Chunk.from_record_batch(recording_reader.replace_cells(batch, painted, rows))
        return chunk

    def _compute_colours(self, places: NDArray[np.float32]) -> NDArray[np.uint32]:
        """Return the colours of vertices, or of springs, for which both end points were recorded."""
        p = places.reshape(-1, 3).astype(float)
        if len(p) == self._vertices:
            return compute_strain_colours(self._compute_strains(p)[1], self.strain_range)
        length = np.linalg.norm(p[1::2] - p[::2], axis=1)
        with np.errstate(all="ignore"):
            strain = np.where(self._rest_lengths > 0.0, length / self._rest_lengths - 1.0, 0.0)
        return compute_strain_colours(strain, self.strain_range)


def _copy_chunks(
    file: PartialFile, run: _SourceRun, source: RecordingSource, look: LineStyle, box: ViewExtent | None
) -> None:
    for chunk in source.iterate_chunks(content="/**"):
        run.entities.add(chunk.entity_path)
        run.widen_ranges(chunk)
        file.stream.send_chunks(run.recolour_chunk(chunk).with_entity_path(run.root + chunk.entity_path))
    for entity in run.entities & set(_QUANTITIES):
        lines = rr.SeriesLines(names=run.name, colors=_pack_colour(look), widths=1.5)
        file.stream.log(run.root + entity, lines, static=True)
    if box:
        strip, numbers = box.build_colour_scale(run.strain_range, run.ends)
        file.stream.log(f"{run.root}/scene/scale", strip, static=True)
        file.stream.log(f"{run.root}/scene/scale/numbers", numbers, static=True)
    file.flush_stream()


def read_residuals(source: RecordingSource) -> dict[int, list[float]]:
    """Return the residuals [J^(1/2)] after each iteration of the frames with recorded convergence, by frame."""
    found: dict[int, list[float]] = {}
    for chunk in source.iterate_chunks(content="/convergence/residual", components=["Scalars:scalars"]):
        frames, _ = read_convergence_frames(source, "/convergence/residual")
        values = recording_reader.get_column(chunk.to_record_batch(), "Scalars:scalars").flatten().to_numpy()
        for frame, of in zip(frames.tolist(), values.reshape(-1, len(frames)).T, strict=True):
            found[frame] = of[~np.isnan(of)].tolist()
    return found


def lighten_for_dark(color: str) -> str:
    """Return a colour such as `#0072b2`, mixed with white where it is dark.

    The mixture is that of the dark results page.
    """
    parts = [int(color[k : k + 2], 16) for k in (1, 3, 5)]
    by = max(0.0, 0.5 - float(np.dot((0.2126, 0.7152, 0.0722), parts)) / 255)
    return "#" + "".join(f"{round(part + (255 - part) * by):02x}" for part in parts)


def _pack_colour(look: LineStyle) -> int:
    return int(lighten_for_dark(look.color)[1:] + "ff", 16)


def _build_layout(runs: list[_SourceRun], box: ViewExtent | None) -> rrb.Blueprint:
    entities = set[str]().union(*(run.entities for run in runs))
    columns = min(len(runs), _MAX_VIEWS_PER_ROW)
    scenes = [build_scene_view(run.root, run.name, box, springs_visible=not run.triangles) for run in runs if box]
    known, last = [entity for entity in _QUANTITIES if entity in entities], max(run.last_frame for run in runs)
    plots = [_build_plot(runs, entity, _QUANTITIES[entity], last, legend=entity == known[0]) for entity in known]
    frames = sorted(set[int]().union(*(run.curves for run in runs)))
    drawn = [
        curve_drawing.build_curve_view(f"/curves/frame_{frame}", f"Residual in frame {frame}, by iteration")
        for frame in frames
    ]
    table = rrb.TextDocumentView(origin="/runs", name="Runs")
    first = runs[0]
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Grid(*scenes, grid_columns=columns),
            # Each group is in a tab of its own over the whole width, so that no title is truncated.
            rrb.Tabs(
                *_name_rows(
                    {
                        "By frame": plots[:_MAX_VISIBLE_PLOTS],
                        "Convergence": drawn,
                        "More": plots[_MAX_VISIBLE_PLOTS:],
                    }
                ),
                table,
            ),
            row_shares=[2, 1],
        ),
        *build_panels(first.time_step),
        auto_views=False,
    )


def _name_rows(rows: Mapping[str, Sequence[Any]]) -> Iterator[rrb.Horizontal]:
    return (rrb.Horizontal(*views, name=name) for name, views in rows.items() if views)


def _build_plot(runs: list[_SourceRun], entity: str, name: str, last: int, *, legend: bool) -> rrb.TimeSeriesView:
    drawn = [run for run in runs if entity in run.entities]
    ends = [run.ranges[entity] for run in drawn if entity in run.ranges] if legend else []
    low, high = (min(end[0] for end in ends), max(end[1] for end in ends)) if ends else (0.0, 0.0)
    return build_plot(
        name, [f"+ {run.root}{entity}" for run in drawn], last=last, value_range=(low, high) if legend else None
    )


def _format_table(title: str, runs: list[_SourceRun]) -> str:
    """Return the runs' properties as a Markdown table with one column per run."""
    keys = dict.fromkeys(key for run in runs for key in run.properties)
    rows = [[key, *(f"`{run.properties.get(key, '')}`" for run in runs)] for key in keys]
    head = [["", *(run.name for run in runs)], ["-"] * (len(runs) + 1)]
    return f"# {title}\n\n" + "\n".join(f"| {' | '.join(row)} |" for row in [*head, *rows])
