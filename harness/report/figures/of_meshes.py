"""Pictures of recorded meshes at their last frames.

They show one run, all solvers of a scene, or all scenes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from harness.base.errors import InputError, Mistake
from harness.record.base import Replay
from harness.record.framing import outside_words
from harness.report.comparison import distance_words, reference
from harness.report.figures.entry import Entry
from harness.report.figures.of_runs import sweep_rows
from harness.report.figures.panel import Picture, Renderer
from harness.report.frames import drawable_frames, largest_strain, shown_limit
from harness.report.origin import NEEDED, measured_on
from harness.report.page import clock, count, quantity
from harness.report.render import (
    Studio,
    View,
    area_vectors,
    frame_all,
    natural_angles,
    shape,
    vertex_strain,
)
from harness.report.self_contact import self_contact_words
from harness.report.solids import framed, seen
from harness.report.style import Mark, marks
from harness.report.timing_table import RunTimes, labels, runs

_LEAST, _MOST = 0.6, 1.9
"""Minimum and maximum aspect ratio, width / height, of a picture."""


class _Recorded(NamedTuple):
    """A run with a recording.

    Attributes:
        label: label that distinguishes it from other runs.
        told: provenance of the measurement.
    """

    run: RunTimes
    label: str
    path: Path
    look: Mark
    told: str

    @property
    def mesh(self) -> tuple[str, str]:
        """Scene and size."""
        return self.run.scene, str(self.run.size)

    @property
    def parts(self) -> tuple[str, ...]:
        """The parts of the label."""
        return tuple(self.label.split(", "))

    def entry(self, of: tuple[str, ...], name: tuple[str, ...]) -> Entry:
        """Build an entry for the last frame, with this group and name."""
        return Entry(of, name, partial(_made, of, name, self.path, self.label, self.look, self.told))


def run(folder: Path) -> list[Entry]:
    """Build an entry for the last frame of each recorded run."""
    return [one.entry((*one.mesh, *one.parts), ("mesh",)) for one in _recorded(folder)]


def comparison(folder: Path) -> list[Entry]:
    """Build entries for the last frames of all solvers of a scene and size.

    They share one camera and one scale.
    """
    return [one.entry(one.mesh, one.parts) for one in _recorded(folder)]


def scenes(folder: Path) -> list[Entry]:
    """Build an entry for the last frame of each scene.

    It shows the largest size, and the run with the lowest residual.
    """
    best = {one.run.scene: one for one in sorted(_recorded(folder), key=_worth)}
    return [one.entry(("scenes",), (scene,)) for scene, one in sorted(best.items())]


def _worth(one: _Recorded) -> tuple[bool, int, float]:
    residual = np.inf if one.run.residual is None else one.run.residual
    return one.run.status == "ok", one.run.vertices or 0, -residual


def _recorded(folder: Path) -> list[_Recorded]:
    """Find the recorded runs, the largest first.

    Raises:
        InputError: if there are none.
    """
    table = sweep_rows(folder)
    found = runs(table)
    names, looks = labels(found), marks(run.solver for run in found)
    told = {row["run_id"]: row for row in table.select(["run_id", *NEEDED]).to_pylist()}
    there = [
        _Recorded(one, names[one.run_id], path, looks[one.solver], measured_on([told[one.run_id]]))
        for one in sorted(found, key=lambda run: -(run.vertices or 0))
        for path in [*(folder / "recordings").glob(f"*-{one.run_id}.rrd")][:1]
    ]
    if not there:
        raise InputError(Mistake("holds no recordings; run a sweep with `record: true`", folder))
    return there


def _made(of: tuple[str, ...], name: tuple[str, ...], path: Path, label: str, look: Mark, told: str) -> Picture:
    replay = _replay(path)
    frames = drawable_frames(replay)
    if not len(frames):
        raise InputError(Mistake("holds no frame whose positions are finite; choose another run", path))
    frame = int(frames[-1])
    lost = f", the last that is finite, of {len(replay.frames)}" if frame + 1 < len(replay.frames) else ""
    points = seen(replay, [frame])
    angles = natural_angles(replay.positions[frame], area_vectors(replay, frame))
    aspect = min(max(shape(points, angles), _LEAST), _MOST)
    size = f"{count(replay.positions.shape[1])} vertices"
    title = [label, size, f"at {clock(replay, frame)}{lost}"]
    limit = shown_limit([replay], [frame])
    return Picture(
        *(of, name, _subject(replay), ", ".join(title), replay.absolute_positions(frame), replay.springs),
        *(replay.triangles, vertex_strain(replay, frame), limit, aspect),
        render=_Render(replace(replay, strain_range=limit), frame, frame_all(points, aspect=aspect, angles=angles)),
        facts=(
            f"largest strain {100 * largest_strain(replay):.3g} %",
            *outside_words(framed(replay, [frame])),
            *self_contact_words(replay, [frame]),
        ),
        look=look,
        machine=told,
        mesh=str(path),
    )


@cache
def _replay(path: Path) -> Replay:
    from harness.record.reader import read_replay  # slow to load

    return read_replay(path)


def _subject(replay: Replay) -> str:
    scene, size = replay.properties.get("scene", replay.title), replay.properties.get("size")
    return f"{scene}, size {size}" if size else str(scene)


class _Render(Renderer):
    """Renders one frame with one camera (`panel.Renderer`)."""

    def __init__(self, replay: Replay, frame: int, view: View) -> None:
        self.replay, self.frame, self.view, self.aspect = replay, frame, view, 1.0

    def __call__(self, width: int, background: str | None) -> NDArray[np.uint8]:
        """Render the frame, see `panel.Renderer`."""
        with Studio(width, max(1, round(width / self.aspect)), background=background) as studio:
            return studio.draw(self.replay, self.frame, self.view)


def alike(pictures: Sequence[Picture]) -> list[Picture]:
    """Give pictures of one scene the same camera, strain scale and aspect ratio.

    Distances from the reference run are added to their facts.
    """
    renders: list[Any] = [picture.render for picture in pictures]
    replays = [render.replay for render in renders]
    limit = shown_limit(replays, [render.frame for render in renders])
    points = np.concatenate([seen(r.replay, [r.frame]) for r in renders])
    one = replays[0].positions[renders[0].frame]
    angles = natural_angles(one, area_vectors(replays[0], renders[0].frame))
    aspect = min(max(shape(points, angles), _LEAST), _MOST)
    view = frame_all(points, aspect=aspect, angles=angles)
    best = reference(replays) if len(replays) > 1 else None
    out: list[Picture] = []
    for picture, render in zip(pictures, renders, strict=True):
        facts = list(picture.facts)
        cost = render.replay.properties.get("milliseconds_per_step")
        facts += [] if cost is None else [f"{quantity(float(cost))} ms a step"]
        if best is not None:
            facts.append(f"distance: {distance_words(render.replay, replays[best])}")
        made = _Render(replace(render.replay, strain_range=limit), render.frame, view)
        made.aspect = aspect
        notes = [_FROM] if best is not None else []
        out.append(replace(picture, limit=limit, aspect=aspect, render=made, facts=facts, notes=notes))
    return out


_FROM = "Distance: of the farthest vertex from the reference, the run of the lowest residual, in mean rest lengths."


def sheet(pictures: Sequence[Picture]) -> list[Picture]:
    """Build pictures of several scenes with one aspect ratio and strain scale.

    Each picture has its own camera.
    """
    limit = max(picture.limit for picture in pictures)
    aspect = float(np.median([picture.aspect for picture in pictures]))
    out: list[Picture] = []
    for picture in pictures:
        render: Any = picture.render
        replay, frame = render.replay, render.frame
        angles = natural_angles(replay.positions[frame], area_vectors(replay, frame))
        view = frame_all(seen(replay, [frame]), aspect=aspect, angles=angles)
        made = _Render(replace(replay, strain_range=limit), frame, view)
        made.aspect = aspect
        label, *how = picture.title.split(", ")
        facts = [f"{label}, {how[0]}", *how[1:], *picture.facts] if how else [label, *picture.facts]
        scene = picture.name[0].replace("-", " ")
        out.append(replace(picture, subject="", title=scene, limit=limit, aspect=aspect, render=made, facts=facts))
    return out
