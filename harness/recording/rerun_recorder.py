# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false
# pyarrow's stubs do not type the arrays that the library creates.
"""Recorder of a run as a Rerun file that opens with its own layout.

Topology is written once, positions in batches of FLUSH_INTERVAL frames, scalars in bulk. The stream has no batching
thread of its own, so the file of a killed run lacks only the last few frames. The file has a temporary name until it is
complete and its end mark has been found.

Positions are stored relative to an origin (`springbench.harness.recording.local_origin`).

Entities:
  `/scene/mesh`: positions, exact to float32; also `/scene/pins`, `/scene/springs`, `/scene/obstacles/*`.
  `/scene/forces/*`: arrows, hidden at first.
  `/scene/scale`: strain colour scale.
  `/energy/*`, `/residual`, `/num_iterations`, `/max_strain`, `/milliseconds/*`: scalars by `frame` and `time`.
  `/energy_change/*`: change of each energy, relative to its largest change.
  `/convergence/residual`, `/convergence/objective`: values by `iteration` for each frame listed in `/convergence`.
  `/curves/*`: the convergence curves as drawings.
  `/network`: springs, rest lengths, pins.
  `/run`: metadata as Markdown, also stored as the recording's properties.

In a recording of the iterates of one solve, everything is indexed by `iteration`, and `/solve/*` contains the
convergence curves.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray
from springbench.harness.recording import curve_drawing, viewer_blueprint
from springbench.harness.recording.camera_view import ViewExtent
from springbench.harness.recording.force_arrows import ForceArrows
from springbench.harness.recording.local_origin import build_origin_property, compute_local_origin, store_relative
from springbench.harness.recording.obstacle_shapes import ObstacleRecorder
from springbench.harness.recording.partial_file import PartialFile
from springbench.harness.recording.recorder_interface import (
    INTERSECTION_FREE_PROPERTY,
    LAYOUT_VERSION,
    RecordedFrame,
    RecordingInfo,
    build_obstacles_property,
)
from springbench.harness.recording.strain_scale import PIN_COLOUR, widen_range
from springbench.harness.recording.strain_shading import StrainShading

FLUSH_INTERVAL = 20
"""Maximum number of frames between flushes, the most that a kill can lose. A chunk costs 1.5 kB, plus 0.5 kB of
index."""
_MAX_BUFFERED_ROWS = 100_000
"""Maximum number of buffered vertices, summed over the buffered frames."""

_STYLED_ENTITIES = ("/milliseconds/", "/max_strain", "/residual/log10")
"""Scalars that the layout plots; only these get a line style."""

_STRIP_TYPE: Any = rr.components.LineStrip3DBatch([]).as_arrow_array().type


class RerunRecorder:
    """Recorder of one run to a Rerun file; implements `springbench.harness.recording.recorder_interface.RunRecorder`.

    The scene is written with the first frame, so that this work runs in the thread that delivers the frames.

    Raises:
        WriteError: the file cannot be written or is incomplete at the end.
    """

    def __init__(self, path: Path, info: RecordingInfo) -> None:
        self._info = info
        self._shading = StrainShading(info)
        self._origin = compute_local_origin(info.mesh.rest_positions)
        self._box = ViewExtent(info.mesh.rest_positions - self._origin)
        self._scalars: dict[str, list[tuple[int, float]]] = {}
        self._styled: dict[str, list[str]] = {}
        self._frames = 0
        self._clock: dict[int, float] = {}  # time of each frame [s]
        self._buffered: list[tuple[int, NDArray[np.float32], NDArray[np.uint32]]] = []
        self._pins: NDArray[np.float32] | None = None
        self._unseen = 1e-6 * info.mesh.bounding_box_diagonal
        self._springs_shown = False
        self._ends = (0.0, 0.0)  # the smallest and the largest strain of a spring
        self._ranges: dict[str, tuple[float, float]] = {}  # values of plots with a legend, by group
        self._curves: dict[int, tuple[Sequence[float], Sequence[float]]] = {}  # residual and objective, by frame
        self._energies: dict[str, dict[int, float]] = {}
        self._file = PartialFile(path, viewer_blueprint.format_application_id(info), info.run_id, info.title)
        self._stream = self._file.stream

    @property
    def info(self) -> RecordingInfo:
        """The properties of the recording that are constant over its frames."""
        return self._info

    def record_frame(self, frame: RecordedFrame) -> None:
        """Record one frame; its arrays are not modified."""
        p = store_relative(frame.positions, self._origin)
        if not self._frames:
            self._open_scene()
            self._box = ViewExtent(self._info.mesh.rest_positions - self._origin, initial_positions=p)
        strain, of_vertex = self._shading.compute_strains(frame.positions)
        self._stream.set_time("frame", sequence=frame.index)
        self._stream.set_time("time", duration=frame.time)
        self._clock[frame.index] = frame.time
        # The iterations timeline of a run needs the scene at 0, otherwise it would show no scene at all.
        self._stream.set_time("iteration", sequence=frame.index if self._info.is_solve else 0)
        self._buffered.append((frame.index, p, self._shading.compute_colours(of_vertex)))
        self._obstacles.record_time(frame.time)
        self._log_pins(p)
        self._log_springs(p, strain)
        self._arrows.add_frame(frame.index, p, frame.forces, self._build_scene_times)
        self._add_scalars(frame.index, {f"/energy/{name}": value for name, value in frame.energies.items()})
        for name, value in frame.energies.items():
            self._energies.setdefault(name, {})[frame.index] = value
        largest = float(np.abs(strain).max(initial=0.0))
        self._ends = widen_range(self._ends, strain)
        self._add_scalars(frame.index, {"/max_strain": largest, "/num_iterations": frame.num_iterations})
        crossed = {} if frame.num_intersections is None else {"/num_intersections": frame.num_intersections}
        self._add_scalars(
            frame.index, crossed | {"/residual": frame.residual, "/residual/log10": _log10(frame.residual)}
        )
        self._frames += 1
        if (
            len(self._buffered) >= FLUSH_INTERVAL
            or len(self._buffered) * len(p) >= _MAX_BUFFERED_ROWS
            or self._frames == 1
        ):
            self._box.add_positions(p)
            self._send_mesh()
            if self._frames > 1:
                self._send_scalars()
            self._file.flush_stream()

    def record_convergence(self, frame: int, residuals: Sequence[float], objective: Sequence[float]) -> None:
        """Record the convergence within one frame.

        Args:
            frame: frame index.
            residuals: residual [J^(1/2)] after each iteration, from the first.
            objective: objective [J] after each iteration.
        """
        self._curves[frame] = residuals, objective

    def record_solve(self, numbers: Sequence[int], curves: Mapping[str, Sequence[float]]) -> None:
        """Record log10 of curves over numbered iterates, in a recording of one solve.

        Args:
            numbers: numbers of the iterates (k,).
            curves: values at the iterates (k,) by name.
        """
        for name, values in curves.items():
            entity = f"/solve/{name.replace(' ', '_')}"
            self._style_series(entity, f"log10 of the {name}")
            logarithms = np.array([_log10(value) for value in values])
            self._widen_range("/solve", logarithms)
            columns = rr.Scalars.columns(scalars=logarithms)
            self._stream.send_columns(entity, self._build_time_columns(np.array(numbers)), columns)

    def finish_recording(
        self, milliseconds: Mapping[str, Sequence[float]], final_properties: Mapping[str, str] | None = None
    ) -> Path:
        """Write the phase times and changed properties, finish the file and return its path.

        Args:
            milliseconds: wall time [ms] of each phase by frame, from frame 1.
            final_properties: properties that changed at the end of the run.
        """
        if not self._frames:
            self._open_scene()
        self._send_mesh()
        for phase, values in milliseconds.items():
            self._scalars[f"/milliseconds/{phase}"] = list(enumerate(values, start=1))
            self._widen_range("/milliseconds", np.array([0.0, *values]))
        self._send_scalars()
        self._send_convergence()
        self._send_changes()
        self._arrows.close(self._build_scene_times)
        self._log_scale()
        if final_properties:
            changed: dict[str, Any] = {name: [value] for name, value in final_properties.items()}
            self._stream.send_property("run", rr.AnyValues(**changed))
        return self._file.finish_file(
            viewer_blueprint.build_blueprint(self._info, self._box, max(self._clock, default=0), self._ranges)
        )

    def abandon_recording(self) -> None:
        """Stop and remove the partial file; has no effect after `finish_recording`."""
        self._file.abandon_file()

    def _open_scene(self) -> None:
        self._log_static()
        self._obstacles = ObstacleRecorder(
            self._stream, self._info.obstacles, self._info.mesh.rest_positions, self._origin
        )
        self._arrows = ForceArrows(self._stream, self._info.mesh.bounding_box_diagonal)

    def _log_static(self) -> None:
        info, mesh = self._info, self._info.mesh
        stated = {**info.properties, **build_obstacles_property(info.obstacles), **build_origin_property(self._origin)}
        stated[INTERSECTION_FREE_PROPERTY] = info.has_self_contact
        facts: dict[str, Any] = {k: [v] for k, v in stated.items()}
        self._stream.send_property("run", rr.AnyValues(**facts))
        network: dict[str, Any] = {
            "layout_version": LAYOUT_VERSION,
            "time_step": info.time_step,
            "strain_range": info.strain_range,
            "springs": info.springs.ravel().astype(np.uint32),
            "rest_lengths": info.rest_lengths,
            "pinned_vertices": info.pinned_vertices.astype(np.uint32),
        }
        self._stream.log("/network", rr.AnyValues(**network), static=True)
        document = rr.TextDocument(viewer_blueprint.format_run_document(info), media_type=rr.MediaType.MARKDOWN)
        self._stream.log("/run", document, static=True)
        self._stream.log("/scene", rr.ViewCoordinates.RIGHT_HAND_Y_UP, static=True)
        if len(mesh.triangles):
            triangles = mesh.triangles.astype(np.uint32)
            self._stream.log("/scene/mesh", rr.Mesh3D.from_fields(triangle_indices=triangles), static=True)
        else:
            self._stream.log("/scene/mesh", rr.Points3D.from_fields(radii=rr.Radius.ui_points(3)), static=True)

    def _send_mesh(self) -> None:
        if not self._buffered:
            return
        frames, positions, coloured = zip(*self._buffered, strict=True)
        p, colours = np.concatenate(positions), np.concatenate(coloured)
        if len(self._info.mesh.triangles):
            normals = np.concatenate([self._shading.compute_normals(of_frame) for of_frame in positions])
            columns = rr.Mesh3D.columns(vertex_positions=p, vertex_normals=normals, vertex_colors=colours)
        else:
            columns = rr.Points3D.columns(positions=p, colors=colours)
        self._stream.send_columns(
            "/scene/mesh",
            self._build_scene_times(np.array(frames)),
            columns.partition([len(positions[0])] * len(frames)),
        )
        self._buffered.clear()

    def _log_pins(self, p: NDArray[np.float32]) -> None:
        pins = p[self._info.pinned_vertices]
        with np.errstate(invalid="ignore"):
            moved = np.inf if self._pins is None else np.abs(pins - self._pins).max(initial=0.0)
        if not moved <= self._unseen:  # penalty pins move by less; `not <=` also records NaN
            points = rr.Points3D(pins, radii=rr.Radius.ui_points(5), colors=int(PIN_COLOUR[1:] + "ff", 16))
            self._stream.log("/scene/pins", points)
            self._pins = pins

    def _log_springs(self, p: NDArray[np.float32], strain: NDArray[np.float64]) -> None:
        springs = self._info.springs
        due = self._frames % viewer_blueprint.compute_spring_interval(self._info) == 0
        if due and len(springs):
            colours, radius = self._shading.compute_colours(strain), rr.Radius.ui_points(1.5)
            self._stream.log(
                "/scene/springs", rr.LineStrips3D(_build_line_strips(p[springs]), colors=colours, radii=radius)
            )
        elif self._springs_shown:  # otherwise the viewer would show the springs of an earlier frame
            self._stream.log("/scene/springs", rr.Clear(recursive=False))
        self._springs_shown = due

    def _log_scale(self) -> None:
        strip, numbers = self._box.build_colour_scale(self._info.strain_range, self._ends)
        self._stream.log("/scene/scale", strip, static=True)
        self._stream.log("/scene/scale/numbers", numbers, static=True)

    def _send_convergence(self) -> None:
        frames = sorted(frame for frame, (residuals, _) in self._curves.items() if len(residuals))
        if not frames:  # no frame needed an iteration
            return
        longest = max(len(self._curves[frame][0]) for frame in frames)
        table = np.full((2, longest, len(frames)), np.nan)
        for k, frame in enumerate(frames):
            for which, values in enumerate(self._curves[frame]):
                table[which, : len(values), k] = values
        names, times = [f"frame {frame}" for frame in frames], [self._clock[frame] for frame in frames]
        colours = curve_drawing.pack_colours(
            viewer_blueprint.SERIES_COLOURS[k % len(viewer_blueprint.SERIES_COLOURS)] for k in range(len(frames))
        )
        self._stream.log("/convergence", rr.AnyValues(frames=frames, times=times), static=True)
        self._file.flush_stream()  # the frames precede the values, so that a truncated file states both
        for name, values in {"residual": table[0], "objective": table[1]}.items():
            self._stream.log(f"/convergence/{name}", rr.SeriesLines(names=names, colors=colours), static=True)
            columns = rr.Scalars.columns(scalars=values.ravel()).partition([len(frames)] * longest)
            index = rr.TimeColumn("iteration", sequence=range(1, longest + 1))
            self._stream.send_columns(f"/convergence/{name}", [index], columns)
        residuals = {name: table[0, :, k].tolist() for k, name in enumerate(names)}
        lowest = np.nanmin(table[1], axis=0, initial=np.inf)  # infinite where no objective is known
        above = {name: (table[1, :, k] - lowest[k]).tolist() for k, name in enumerate(names)}
        curve_drawing.draw_curves(self._stream, "/curves/residual", residuals, colours)
        curve_drawing.draw_curves(self._stream, "/curves/objective", above, colours)

    def _send_changes(self) -> None:
        """Write each energy's change from the start, relative to its largest change.

        Small energies thus stay visible.
        """
        for name, by_frame in self._energies.items():
            frames, values = np.array(list(by_frame)), np.array(list(by_frame.values()))
            change = values - values[0]
            largest = float(np.nanmax(np.abs(change))) if np.isfinite(change).any() else 0.0
            if largest > 0.0:
                self._style_series(f"/energy_change/{name}", f"{name}, of {largest:.2g} J")
                self._widen_range("/energy_change", change / largest)
                scaled = rr.Scalars.columns(scalars=change / largest)
                self._stream.send_columns(f"/energy_change/{name}", self._build_time_columns(frames), scaled)

    def _widen_range(self, group: str, values: NDArray[np.float64]) -> None:
        known = values[np.isfinite(values)]
        low, high = self._ranges.get(group, (np.inf, -np.inf))
        self._ranges[group] = float(known.min(initial=low)), float(known.max(initial=high))

    def _add_scalars(self, frame: int, values: Mapping[str, float]) -> None:
        for entity, value in values.items():
            self._scalars.setdefault(entity, []).append((frame, value))

    def _send_scalars(self) -> None:
        for entity, rows in self._scalars.items():
            if rows:
                if entity.startswith(_STYLED_ENTITIES):
                    self._style_series(entity, entity.rsplit("/", 1)[-1])
                frames, values = zip(*rows, strict=True)
                index = self._build_time_columns(np.array(frames))
                self._stream.send_columns(entity, index, rr.Scalars.columns(scalars=np.array(values, float)))
                rows.clear()

    def _build_time_columns(self, frames: NDArray[np.int64]) -> Iterable[rr.TimeColumn]:
        if self._info.is_solve:
            return rr.TimeColumn("frame", sequence=frames), rr.TimeColumn("iteration", sequence=frames)
        return rr.TimeColumn("frame", sequence=frames), self._build_time_column(frames)

    def _build_scene_times(self, frames: NDArray[np.int64]) -> Iterable[rr.TimeColumn]:
        """Build the time columns of scene entities.

        On the iterations timeline of a run the scene is static.
        """
        iterations = frames if self._info.is_solve else np.zeros_like(frames)
        return (
            rr.TimeColumn("frame", sequence=frames),
            self._build_time_column(frames),
            rr.TimeColumn("iteration", sequence=iterations),
        )

    def _build_time_column(self, frames: NDArray[np.int64]) -> rr.TimeColumn:
        return rr.TimeColumn("time", duration=np.array([self._clock[frame] for frame in frames.tolist()]))

    def _style_series(self, entity: str, label: str) -> None:
        group, name = entity.rsplit("/", 1)
        names = self._styled.setdefault(group, [])
        if name not in names:
            colour = viewer_blueprint.SERIES_COLOURS[len(names) % len(viewer_blueprint.SERIES_COLOURS)]
            names.append(name)
            self._stream.log(entity, rr.SeriesLines(names=label, colors=colour, widths=1.5), static=True)


def _build_line_strips(ends: NDArray[np.float32]) -> Any:
    """Build line strips of two points each from (m, 2, 3), without a Python loop."""
    points: Any = rr.components.Position3DBatch(ends.reshape(-1, 3)).as_arrow_array()
    offsets: Any = pa.array(np.arange(0, 2 * len(ends) + 1, 2, dtype=np.int32))
    return pa.ListArray.from_arrays(offsets, points, type=_STRIP_TYPE)


def _log10(value: float) -> float:
    return math.log10(value) if value > 0 else math.nan
