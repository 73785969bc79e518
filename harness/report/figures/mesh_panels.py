"""Pictures of recorded meshes at their last frames.

They show one run, all solvers of a scene, or all scenes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.recording.camera_framing import describe_outside
from springbench.harness.recording.recorder_interface import RecordingReplay
from springbench.harness.report.charts.figure_panels import MeshPicture
from springbench.harness.report.comparison_picture import find_reference_run, format_distance
from springbench.harness.report.drawable_frames import (
    find_drawable_frames,
    framed_vertex_mask,
    max_recorded_strain,
    strain_scale_limit,
)
from springbench.harness.report.figures.panel_selection import PanelEntry
from springbench.harness.report.figures.timing_panels import read_sweep_rows
from springbench.harness.report.mesh_rendering import (
    FittedCamera,
    OffscreenRenderer,
    choose_view_angles,
    compute_area_vectors,
    fit_camera,
    view_aspect,
)
from springbench.harness.report.number_format import format_count, format_quantity
from springbench.harness.report.obstacle_meshes import points_to_frame
from springbench.harness.report.page_layout import format_frame_time
from springbench.harness.report.provenance_words import PROVENANCE_COLUMNS, describe_provenance
from springbench.harness.report.recorded_strain import compute_vertex_strain
from springbench.harness.report.self_intersection_notes import describe_self_intersection
from springbench.harness.report.timing_table import RunTimes, label_runs, read_run_times

_MIN_ASPECT, _MAX_ASPECT = 0.6, 1.9
"""Minimum and maximum aspect ratio, width / height, of a picture."""


class _RecordedRun(NamedTuple):
    """A run with a recording.

    Attributes:
        label: label that distinguishes it from other runs.
        machine_words: provenance of the measurement.
    """

    run: RunTimes
    label: str
    path: Path
    machine_words: str

    @property
    def mesh_key(self) -> tuple[str, str]:
        """Scene and size."""
        return self.run.scene, str(self.run.size)

    @property
    def label_parts(self) -> tuple[str, ...]:
        """The parts of the label."""
        return tuple(self.label.split(", "))

    def build_entry(self, group: tuple[str, ...], name: tuple[str, ...]) -> PanelEntry:
        """Build an entry for the last frame, with this group and name."""
        return PanelEntry(group, name, partial(_build_picture, group, name, self.path, self.label, self.machine_words))


def list_last_frame_panels(folder: Path) -> list[PanelEntry]:
    """Build an entry for the last frame of each recorded run."""
    return [one.build_entry((*one.mesh_key, *one.label_parts), ("mesh",)) for one in _find_recorded_runs(folder)]


def list_solver_comparison_panels(folder: Path) -> list[PanelEntry]:
    """Build entries for the last frames of all solvers of a scene and size.

    `align_pictures` gives those of a scene and size one camera and one scale.
    """
    return [one.build_entry(one.mesh_key, one.label_parts) for one in _find_recorded_runs(folder)]


def list_scene_panels(folder: Path) -> list[PanelEntry]:
    """Build an entry for the last frame of each scene.

    It shows a successful run, if there is one: of the largest size, and of those the one with the lowest residual.
    """
    best = {one.run.scene: one for one in sorted(_find_recorded_runs(folder), key=_run_rank)}
    return [one.build_entry(("scenes",), (scene,)) for scene, one in sorted(best.items())]


def _run_rank(one: _RecordedRun) -> tuple[bool, int, float]:
    residual = np.inf if one.run.residual is None else one.run.residual
    return one.run.status == "ok", one.run.vertices or 0, -residual


def _find_recorded_runs(folder: Path) -> list[_RecordedRun]:
    """Find the recorded runs, the largest first.

    Raises:
        InputError: if there are none.
    """
    table = read_sweep_rows(folder)
    found = read_run_times(table)
    names = label_runs(found)
    provenance = {row["run_id"]: row for row in table.select(["run_id", *PROVENANCE_COLUMNS]).to_pylist()}
    there = [
        _RecordedRun(one, names[one.run_id], path, describe_provenance([provenance[one.run_id]]))
        for one in sorted(found, key=lambda run: -(run.vertices or 0))
        for path in [*(folder / "recordings").glob(f"*-{one.run_id}.rrd")][:1]
    ]
    if not there:
        raise InputError(InputMistake("contains no recordings; run a sweep with `record: true`", folder))
    return there


def _build_picture(
    group: tuple[str, ...], name: tuple[str, ...], path: Path, label: str, machine_words: str
) -> MeshPicture:
    replay = _read_cached_replay(path)
    frames = find_drawable_frames(replay)
    if not len(frames):
        raise InputError(InputMistake("contains no frame whose positions are finite; choose another run", path))
    frame = int(frames[-1])
    lost = f", the last that is finite, of {len(replay.frames)}" if frame + 1 < len(replay.frames) else ""
    points = points_to_frame(replay, [frame])
    angles = choose_view_angles(replay.positions[frame], compute_area_vectors(replay, frame))
    aspect = min(max(view_aspect(points, angles), _MIN_ASPECT), _MAX_ASPECT)
    size = f"{format_count(replay.positions.shape[1])} vertices"
    title = [label, size, f"at {format_frame_time(replay, frame)}{lost}"]
    limit = strain_scale_limit([replay], [frame])
    return MeshPicture(
        *(group, name, _subject_words(replay), ", ".join(title), replay.absolute_positions(frame), replay.springs),
        *(replay.triangles, compute_vertex_strain(replay, frame), limit, aspect),
        render=_FrameRenderer(
            replace(replay, strain_range=limit), frame, fit_camera(points, aspect=aspect, angles=angles), aspect
        ),
        facts=(
            f"largest strain {100 * max_recorded_strain(replay):.3g} %",
            *describe_outside(framed_vertex_mask(replay, [frame])),
            *describe_self_intersection(replay, [frame]),
        ),
        machine_words=machine_words,
    )


@cache
def _read_cached_replay(path: Path) -> RecordingReplay:
    from springbench.harness.recording.recording_reader import read_replay  # slow to load

    return read_replay(path)


def _subject_words(replay: RecordingReplay) -> str:
    scene, size = replay.properties.get("scene", replay.title), replay.properties.get("size")
    return f"{scene}, size {size}" if size else str(scene)


@dataclass(slots=True, eq=False)
class _FrameRenderer:
    """Renders one frame with one camera; a `figure_panels.MeshRenderer`."""

    replay: RecordingReplay
    frame: int
    view: FittedCamera
    aspect: float

    def __call__(self, width: int, background: str | None) -> NDArray[np.uint8]:
        """Return the pixels (height, width, 3 or 4) of the frame.

        Args:
            width: width of the picture [pixels]; the height follows from the aspect.
            background: colour of the background, or None for a transparent one.
        """
        with OffscreenRenderer(width, max(1, round(width / self.aspect)), background=background) as studio:
            return studio.render_frame(self.replay, self.frame, self.view)


def align_pictures(pictures: Sequence[MeshPicture]) -> list[MeshPicture]:
    """Give pictures of one scene the same camera, strain scale and aspect ratio.

    Distances from the reference run are added to their facts.
    """
    renders = [picture.render for picture in pictures]
    replays = [render.replay for render in renders]
    limit = strain_scale_limit(replays, [render.frame for render in renders])
    points = np.concatenate([points_to_frame(r.replay, [r.frame]) for r in renders])
    one = replays[0].positions[renders[0].frame]
    angles = choose_view_angles(one, compute_area_vectors(replays[0], renders[0].frame))
    aspect = min(max(view_aspect(points, angles), _MIN_ASPECT), _MAX_ASPECT)
    view = fit_camera(points, aspect=aspect, angles=angles)
    best = find_reference_run(replays) if len(replays) > 1 else None
    out: list[MeshPicture] = []
    for picture, render in zip(pictures, renders, strict=True):
        facts = list(picture.facts)
        cost = render.replay.properties.get("milliseconds_per_step")
        facts += [] if cost is None else [f"{format_quantity(float(cost))} ms a step"]
        if best is not None:
            facts.append(f"distance: {format_distance(render.replay, replays[best])}")
        made = _FrameRenderer(replace(render.replay, strain_range=limit), render.frame, view, aspect)
        notes = [_DISTANCE_NOTE] if best is not None else []
        out.append(replace(picture, strain_limit=limit, aspect=aspect, render=made, facts=facts, notes=notes))
    return out


_DISTANCE_NOTE = (
    "Distance: of the farthest vertex from the reference, the run of the lowest residual, in mean rest lengths."
)


def build_scene_sheet(pictures: Sequence[MeshPicture]) -> list[MeshPicture]:
    """Build pictures of several scenes with one aspect ratio and strain scale.

    Each picture has its own camera.
    """
    limit = max(picture.strain_limit for picture in pictures)
    aspect = float(np.median([picture.aspect for picture in pictures]))
    out: list[MeshPicture] = []
    for picture in pictures:
        replay, frame = picture.render.replay, picture.render.frame
        angles = choose_view_angles(replay.positions[frame], compute_area_vectors(replay, frame))
        view = fit_camera(points_to_frame(replay, [frame]), aspect=aspect, angles=angles)
        made = _FrameRenderer(replace(replay, strain_range=limit), frame, view, aspect)
        label, *how = picture.title.split(", ")
        facts = [f"{label}, {how[0]}", *how[1:], *picture.facts] if how else [label, *picture.facts]
        scene = picture.name[0].replace("-", " ")
        out.append(
            replace(picture, subject="", title=scene, strain_limit=limit, aspect=aspect, render=made, facts=facts)
        )
    return out
