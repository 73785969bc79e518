# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyarrow's stubs do not state the column types of a schema.
"""Reader of recordings without a viewer, for pictures and for `springbench inspect`.

A complete file is read through the index in its footer. A file without one (its run was killed) is scanned up to the
last complete message. A file that this process has not written is first read in a separate process
(see `harness.record.sound`).
"""

from __future__ import annotations

import os
import shutil
import tempfile
import warnings
from collections.abc import Collection, Generator, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from rerun.chunk import Chunk, LazyStore, RrdReader

from harness.base.errors import InputError, Mistake
from harness.record import cells
from harness.record.base import LAYOUT, Replay
from harness.record.cells import cell
from harness.record.local_origin import read_origin
from harness.record.sound import require_sound, trust, whole_messages

_MAGIC = b"RRF2"
_ROW_ID = "rerun.controls.RowId"
_POSITIONS = ("Mesh3D:vertex_positions", "Points3D:positions")
_SCALAR = "Scalars:scalars"
_NAME = "RecordingInfo:name"

SCALARS = pa.schema(
    [
        ("entity", pa.string()),
        ("frame", pa.int64()),
        ("iteration", pa.int64()),
        ("time", pa.float64()),
        ("value", pa.float64()),
    ]
)
"""Scalars in long form: entity, frame, iteration (null where there is none), simulated time [s], value."""


@dataclass(frozen=True, slots=True, eq=False)
class Summary:
    """Contents of a recording without its positions.

    Attributes:
      path: path of the file.
      complete: whether the run closed the file.
      title: title as recorded.
      run_id: identifier of the run.
      application: application name.
      properties: metadata as recorded.
      frames: indices of the recorded frames (k,).
      timelines: (first, last) by timeline name.
      entities: entity paths.
      scalars: table with schema SCALARS.
    """

    path: Path
    complete: bool
    title: str
    run_id: str
    application: str
    properties: dict[str, Any]
    frames: NDArray[np.int64]
    timelines: dict[str, tuple[float, float]]
    entities: tuple[str, ...]
    scalars: pa.Table


@dataclass(frozen=True, slots=True)
class Source:
    """An open recording, whose chunks can be iterated repeatedly."""

    path: Path
    store: LazyStore | RrdReader
    complete: bool
    application: str
    run_id: str

    def chunks(self, *, content: str, components: Sequence[str] | None = None) -> Iterator[Chunk]:
        """Iterate over the chunks of the entities that match `content`, with the given components only."""
        return iter(self.store.stream().filter(content=content, components=components))


def read_replay(path: Path, frames: Collection[int] | None = None) -> Replay:
    """Read a recording with all frames or a selection of them, in order.

    Args:
      path: path of the recording.
      frames: indices of the frames, -1 for the last; all if omitted.

    Raises:
      InputError: the file is not the recording of a run or lacks a selected frame.
    """
    with open_recording(path) as source:
        springs = network(source)
        wanted = None
        if frames is not None:
            known = np.array([index for index, _, _ in positions(source)])
            wanted = {_chosen(path, frame, known) for frame in frames}
        found = {index: (time, p.copy()) for index, time, p in positions(source, wanted)}
        order = sorted(found)
        times = np.array([found[index][0] for index in order])
        stacked = np.empty((len(order), len(found[order[0]][1]) if order else 0, 3), np.float32)
        for k, index in enumerate(order):
            stacked[k] = found.pop(index)[1]  # so that memory never holds all frames twice
        title, facts = properties(source)
        return Replay(
            title=title,
            run_id=source.run_id,
            frames=np.array(order, np.int64),
            times=times,
            positions=stacked,
            triangles=triangles(source),
            springs=springs["springs"].reshape(-1, 2).astype(np.int64),
            rest_lengths=springs["rest_lengths"].astype(np.float64),
            pinned=springs["pinned"].astype(np.int64),
            strain_range=float(springs["strain_range"][0]),
            scalars=_by_frame(_scalars(source)),
            properties=facts,
            origin=read_origin(facts),
        )


def summary(path: Path) -> Summary:
    """Read the contents of a recording, of one or several runs, without positions.

    Raises:
      InputError: the file is not a Rerun recording.
    """
    with open_recording(path) as source:
        entities: set[str] = set()
        times: dict[str, list[float]] = {}
        for chunk in source.chunks(content="/**"):
            entities.add(chunk.entity_path)
            batch = chunk.to_record_batch()
            for name in chunk.timeline_names:
                values = cells.counted(batch, name)
                times.setdefault(name, []).extend((values.min(), values.max()))
        title, facts = properties(source)
        frames = {index for index, _, _ in positions(source)}
        return Summary(
            path=path,
            complete=source.complete,
            title=title,
            run_id=source.run_id,
            application=source.application,
            properties=facts,
            frames=np.array(sorted(frames), np.int64),
            timelines={name: (float(min(values)), float(max(values))) for name, values in sorted(times.items())},
            entities=tuple(sorted(entities)),
            scalars=_scalars(source),
        )


def _try(path: Path) -> None:
    """Read all of a recording; damage raises an exception or ends the process."""
    trust(path, noted=False)
    with open_recording(path) as source:
        for chunk in source.chunks(content="/**"):
            chunk.to_record_batch().validate(full=True)
    summary(path)
    with suppress(InputError):  # of a recording that is not of one run
        read_replay(path)


@contextmanager
def open_recording(path: Path) -> Generator[Source]:
    """Open the recording at `path` for the duration of the context.

    Raises:
      InputError: the file is not a Rerun recording, is damaged, or contains no readable data.
    """
    if not path.is_file():
        raise InputError(Mistake("there is no such file; a Rerun recording (.rrd) was expected", file=path))
    with path.open("rb") as file:
        start = file.read(len(_MAGIC))
    if start != _MAGIC:
        came = f"begins with {start!r}" if start else "is empty"
        raise InputError(Mistake(f"{came} and so is not a Rerun recording (.rrd)", file=path))
    require_sound(path, _try)
    with ExitStack() as kept, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of files without a footer: `complete` says so
        complete, end = whole_messages(path)
        readable = path
        if not complete and end < path.stat().st_size:  # the library reads nothing of a file cut within a message
            readable = Path(kept.enter_context(tempfile.TemporaryDirectory())) / path.name
            shutil.copyfile(path, readable)
            os.truncate(readable, end)
        try:
            reader = RrdReader(readable)
            runs = reader.recordings()
            store = reader.store() if complete else reader
        except (RuntimeError, ValueError) as error:
            raise InputError(Mistake(f"cannot be read as a Rerun recording: {error}", file=path)) from error
        if not runs:
            raise InputError(Mistake("has nothing in it that can be read: it was cut at its start", file=path))
        yield Source(path, store, complete, runs[0].application_id, runs[0].recording_id)


def network(source: Source) -> dict[str, NDArray[Any]]:
    """Return the constant arrays: springs (2m,), rest_lengths (m,), pinned (q,), strain_range (1,), time_step (1,)."""
    for chunk in source.chunks(content="/network"):
        batch = chunk.to_record_batch()
        names = [name for name in batch.schema.names if name != _ROW_ID]
        # Rerun writes no column for an empty array: a mesh without springs, or without pins.
        none = dict.fromkeys(("springs", "rest_lengths", "pinned"), np.empty(0))
        if "layout" not in names or int(cell(batch, "layout")[0]) != LAYOUT:
            problem = "is laid out as another version of springbench did it; do its run again, with --again"
            raise InputError(Mistake(problem, file=source.path))
        return none | {name: cell(batch, name) for name in names}
    names = f"application {source.application!r}"
    problem = f"is a Rerun recording ({names}) but not of one run: it has no /network and /scene/mesh"
    raise InputError(Mistake(problem, file=source.path))


def positions(
    source: Source, wanted: Collection[int] | None = None
) -> Iterator[tuple[int, float, NDArray[np.float32]]]:
    """Iterate over the positions (n, 3) [m] of the selected frames, in file order.

    Args:
      source: open recording.
      wanted: indices of the frames; all if omitted.

    Returns: tuples of frame, time [s] and positions, which are relative to the origin.
    """
    for chunk in source.chunks(content="/scene/mesh", components=_POSITIONS):
        batch = chunk.to_record_batch()
        (name,) = set(_POSITIONS) & set(batch.schema.names)
        for k, index in enumerate(cells.counted(batch, "frame")):
            if wanted is None or index in wanted:
                yield int(index), float(cells.counted(batch, "time")[k]), cell(batch, name, k).reshape(-1, 3)


def triangles(source: Source) -> NDArray[np.int64]:
    """Return the mesh's triangles, shape (f, 3)."""
    for chunk in source.chunks(content="/scene/mesh", components=["Mesh3D:triangle_indices"]):
        return cell(chunk.to_record_batch(), "Mesh3D:triangle_indices").reshape(-1, 3).astype(np.int64)
    return np.empty((0, 3), np.int64)


def properties(source: Source) -> tuple[str, dict[str, Any]]:
    """Return the title and the recorded metadata of the run and its machine."""
    title, facts = "", dict[str, Any]()
    for chunk in source.chunks(content="/__properties/**"):
        batch = chunk.to_record_batch()
        values: dict[str, Any] = {
            name: cells.scalar(batch, name, 0).as_py()[0] for name in batch.schema.names if name != _ROW_ID
        }
        if chunk.entity_path == "/__properties/run":
            facts |= values  # what changed at the end comes last
        title = values.get(_NAME, title)
    return title, facts


def _scalars(source: Source) -> pa.Table:
    tables = [SCALARS.empty_table()]
    for chunk in source.chunks(content="/**", components=[_SCALAR]):
        batch = chunk.to_record_batch()
        known: dict[str, Any] = {
            name: cells.counted(batch, name) for name in chunk.timeline_names if name in SCALARS.names
        }
        values = cells.column(batch, _SCALAR).flatten()
        if chunk.entity_path.rpartition("/")[0].endswith("/convergence"):  # a value for each of the frames
            frames, times = looked_at(source, chunk.entity_path)
            known = {
                "frame": np.tile(frames, batch.num_rows),
                "iteration": np.repeat(known["iteration"], len(frames)),
                "time": np.tile(times, batch.num_rows),
            }
        columns: dict[str, Any] = {
            "entity": [chunk.entity_path] * len(values),
            "frame": known.get("frame"),
            "iteration": known.get("iteration"),
            "time": known.get("time"),
            "value": values,
        }
        arrays: list[Any] = [
            pa.nulls(len(values), SCALARS.field(name).type)
            if columns[name] is None
            else pa.array(columns[name], SCALARS.field(name).type)
            for name in SCALARS.names
        ]
        tables.append(pa.Table.from_arrays(arrays, schema=SCALARS))
    order: Any = [(name, "ascending") for name in ("entity", "frame", "iteration")]
    return pa.concat_tables(tables).sort_by(order)


def looked_at(source: Source, entity: str) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the frames with recorded convergence, and their times [s], in stored order."""
    for chunk in source.chunks(content=entity.rpartition("/")[0]):
        batch = chunk.to_record_batch()
        return cell(batch, "frames").astype(np.int64), cell(batch, "times").astype(float)
    raise InputError(Mistake(f"does not say which frames {entity} is of", file=source.path))


def _by_frame(table: pa.Table) -> dict[str, tuple[NDArray[np.int64], NDArray[np.float64]]]:
    """Return the scalars that have one value per frame: entity -> (frames, values)."""
    entities, frames, values = (table[name].to_numpy() for name in ("entity", "frame", "value"))
    once = table["iteration"].is_null().to_numpy()
    entities, frames, values = entities[once], frames[once].astype(np.int64), values[once]
    return {str(entity): (frames[of], values[of]) for entity in np.unique(entities) for of in [entities == entity]}


def _chosen(path: Path, frame: int, known: NDArray[np.int64]) -> int:
    """Return the index of a frame among the recorded ones; -1 is the last."""
    if frame == -1 and len(known):
        return int(known[-1])
    if frame in known:
        return frame
    have = f"frames {known[0]} to {known[-1]} are" if len(known) else "no frame is"
    raise InputError(Mistake(f"there is no frame {frame}; {have} recorded", file=path, key="frame"))
