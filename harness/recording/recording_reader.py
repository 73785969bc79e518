# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyarrow's stubs do not state the column types of a schema.
"""Reader of recordings without a viewer, for pictures and for `springbench inspect`.

A complete file is read through the index in its footer. A file without one (its run was killed) is scanned up to the
last complete message. A file that this process has not written is first read in a separate process
(`springbench.harness.recording.recording_integrity`).
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
from typing import Any, cast

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from rerun.chunk import Chunk, LazyStore, RrdReader
from springbench.harness.atomic_files import explain_unreadable_file
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.recording.local_origin import read_origin
from springbench.harness.recording.recorder_interface import LAYOUT_VERSION, RecordingReplay
from springbench.harness.recording.recording_integrity import mark_verified, require_intact, scan_messages

_MAGIC = b"RRF2"
_ROW_ID = "rerun.controls.RowId"
_POSITION_COMPONENTS = ("Mesh3D:vertex_positions", "Points3D:positions")
_SCALAR_COMPONENT = "Scalars:scalars"
_NAME_COMPONENT = "RecordingInfo:name"

SCALAR_SCHEMA = pa.schema(
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
class RecordingSummary:
    """Contents of a recording without its positions.

    Attributes:
        path: path of the file.
        is_complete: whether the run closed the file.
        title: title as recorded.
        run_id: identifier of the run.
        application: application name.
        properties: metadata as recorded.
        frames: indices of the recorded frames (k,).
        timelines: (first, last) by timeline name.
        entities: entity paths.
        scalars: table with schema SCALAR_SCHEMA.
    """

    path: Path
    is_complete: bool
    title: str
    run_id: str
    application: str
    properties: dict[str, Any]
    frames: NDArray[np.int64]
    timelines: dict[str, tuple[float, float]]
    entities: tuple[str, ...]
    scalars: pa.Table


@dataclass(frozen=True, slots=True)
class RecordingSource:
    """An open recording, whose chunks can be iterated repeatedly."""

    path: Path
    store: LazyStore | RrdReader
    is_complete: bool
    application: str
    run_id: str

    def iterate_chunks(self, *, content: str, components: Sequence[str] | None = None) -> Iterator[Chunk]:
        """Iterate over the chunks of some entities.

        Args:
            content: filter of entity paths, such as `/scene/mesh`, or `/**` for all.
            components: names of the components to read; all if None.
        """
        return iter(self.store.stream().filter(content=content, components=components))


def read_replay(path: Path, frames: Collection[int] | None = None) -> RecordingReplay:
    """Read a recording with all frames or a selection of them, in order.

    Args:
        path: path of the recording.
        frames: indices of the frames, -1 for the last; all if omitted.

    Raises:
        InputError: the file is not the recording of a run or lacks a selected frame.
    """
    with open_recording_source(path) as source:
        springs = read_network(source)
        requested = None
        if frames is not None:
            known = np.array([index for index, _, _ in iterate_positions(source)])
            requested = {_resolve_frame(path, frame, known) for frame in frames}
        found = {index: (time, p.copy()) for index, time, p in iterate_positions(source, requested)}
        order = sorted(found)
        times = np.array([found[index][0] for index in order])
        stacked = np.empty((len(order), len(found[order[0]][1]) if order else 0, 3), np.float32)
        for k, index in enumerate(order):
            stacked[k] = found.pop(index)[1]  # so that all frames are never in memory twice
        title, facts = read_properties(source)
        return RecordingReplay(
            title=title,
            run_id=source.run_id,
            frames=np.array(order, np.int64),
            times=times,
            positions=stacked,
            triangles=read_triangles(source),
            springs=springs["springs"].reshape(-1, 2).astype(np.int64),
            rest_lengths=springs["rest_lengths"].astype(np.float64),
            pinned_vertices=springs["pinned_vertices"].astype(np.int64),
            strain_range=float(springs["strain_range"][0]),
            scalars=_group_by_frame(_read_scalars(source)),
            properties=facts,
            origin=read_origin(facts),
        )


def summarise_recording(path: Path) -> RecordingSummary:
    """Read the contents of a recording, of one or several runs, without positions.

    Raises:
        InputError: the file is not a Rerun recording.
    """
    with open_recording_source(path) as source:
        entities: set[str] = set()
        times: dict[str, list[float]] = {}
        for chunk in source.iterate_chunks(content="/**"):
            entities.add(chunk.entity_path)
            batch = chunk.to_record_batch()
            for name in chunk.timeline_names:
                values = read_timeline(batch, name)
                times.setdefault(name, []).extend((values.min(), values.max()))
        title, facts = read_properties(source)
        frames = {index for index, _, _ in iterate_positions(source)}
        return RecordingSummary(
            path=path,
            is_complete=source.is_complete,
            title=title,
            run_id=source.run_id,
            application=source.application,
            properties=facts,
            frames=np.array(sorted(frames), np.int64),
            timelines={name: (float(min(values)), float(max(values))) for name, values in sorted(times.items())},
            entities=tuple(sorted(entities)),
            scalars=_read_scalars(source),
        )


def _try_reading(path: Path) -> None:
    """Read all of a recording; damage raises an exception or ends the process."""
    mark_verified(path, shared=False)
    with open_recording_source(path) as source:
        for chunk in source.iterate_chunks(content="/**"):
            chunk.to_record_batch().validate(full=True)
    summarise_recording(path)
    with suppress(InputError):  # raised for a recording that is not of one run
        read_replay(path)


@contextmanager
def open_recording_source(path: Path) -> Generator[RecordingSource]:
    """Open the recording at `path` for the duration of the context.

    Raises:
        InputError: the file is not a Rerun recording, is damaged, or contains no readable data.
    """
    if not path.is_file():
        raise InputError(InputMistake("there is no such file; expected a Rerun recording (.rrd)", file=path))
    with path.open("rb") as file:
        start = file.read(len(_MAGIC))
    if start != _MAGIC:
        beginning = explain_unreadable_file(path) or f"begins with {start!r}"
        raise InputError(InputMistake(f"{beginning}; it is not a Rerun recording (.rrd)", file=path))
    require_intact(path, _try_reading)
    with ExitStack() as stack, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about files without a footer, which `is_complete` reports
        complete, end = scan_messages(path)
        readable = path
        if not complete and end < path.stat().st_size:  # the library reads nothing of a file cut within a message
            readable = Path(stack.enter_context(tempfile.TemporaryDirectory())) / path.name
            shutil.copyfile(path, readable)
            os.truncate(readable, end)
        try:
            reader = RrdReader(readable)
            runs = reader.recordings()
            store = reader.store() if complete else reader
        except (RuntimeError, ValueError) as error:
            raise InputError(InputMistake(f"cannot be read as a Rerun recording: {error}", file=path)) from error
        if not runs:
            raise InputError(InputMistake("contains no readable data; the file is truncated", file=path))
        yield RecordingSource(path, store, complete, runs[0].application_id, runs[0].recording_id)


def read_network(source: RecordingSource) -> dict[str, NDArray[Any]]:
    """Return the constant arrays.

    They are springs (2m,), rest_lengths (m,), pinned_vertices (q,), strain_range (1,) and time_step (1,).
    """
    for chunk in source.iterate_chunks(content="/network"):
        batch = chunk.to_record_batch()
        names = [name for name in batch.schema.names if name != _ROW_ID]
        # Rerun writes no column for an empty array: a mesh without springs, or without pins.
        none = dict.fromkeys(("springs", "rest_lengths", "pinned_vertices"), np.empty(0))
        if "layout_version" not in names or int(read_cell(batch, "layout_version")[0]) != LAYOUT_VERSION:
            problem = "has the layout of another version of springbench; repeat its run with --rerun"
            raise InputError(InputMistake(problem, file=source.path))
        return none | {name: read_cell(batch, name) for name in names}
    names = f"application {source.application!r}"
    problem = f"is a Rerun recording ({names}) but not of one run: it has no /network and /scene/mesh"
    raise InputError(InputMistake(problem, file=source.path))


def iterate_positions(
    source: RecordingSource, frames: Collection[int] | None = None
) -> Iterator[tuple[int, float, NDArray[np.float32]]]:
    """Iterate over the positions (n, 3) [m] of the selected frames, in file order.

    Args:
        source: open recording.
        frames: indices of the frames; all if omitted.

    Yields:
        Frame, time [s] and positions, which are relative to the origin.
    """
    for chunk in source.iterate_chunks(content="/scene/mesh", components=_POSITION_COMPONENTS):
        batch = chunk.to_record_batch()
        (name,) = set(_POSITION_COMPONENTS) & set(batch.schema.names)
        for k, index in enumerate(read_timeline(batch, "frame")):
            if frames is None or index in frames:
                yield (
                    int(index),
                    float(read_timeline(batch, "time")[k]),
                    read_cell(batch, name, k).reshape(-1, 3),
                )


def read_triangles(source: RecordingSource) -> NDArray[np.int64]:
    """Return the mesh's triangles, shape (f, 3)."""
    for chunk in source.iterate_chunks(content="/scene/mesh", components=["Mesh3D:triangle_indices"]):
        return read_cell(chunk.to_record_batch(), "Mesh3D:triangle_indices").reshape(-1, 3).astype(np.int64)
    return np.empty((0, 3), np.int64)


def read_properties(source: RecordingSource) -> tuple[str, dict[str, Any]]:
    """Return the title and the recorded metadata of the run and its machine."""
    title, facts = "", dict[str, Any]()
    for chunk in source.iterate_chunks(content="/__properties/**"):
        batch = chunk.to_record_batch()
        values: dict[str, Any] = {
            name: get_scalar(batch, name, 0).as_py()[0] for name in batch.schema.names if name != _ROW_ID
        }
        if chunk.entity_path == "/__properties/run":
            facts |= values  # properties that changed at the end are last
        title = values.get(_NAME_COMPONENT, title)
    return title, facts


def _read_scalars(source: RecordingSource) -> pa.Table:
    tables = [SCALAR_SCHEMA.empty_table()]
    for chunk in source.iterate_chunks(content="/**", components=[_SCALAR_COMPONENT]):
        batch = chunk.to_record_batch()
        known: dict[str, Any] = {
            name: read_timeline(batch, name) for name in chunk.timeline_names if name in SCALAR_SCHEMA.names
        }
        values = get_column(batch, _SCALAR_COMPONENT).flatten()
        if chunk.entity_path.rpartition("/")[0].endswith("/convergence"):  # each row has a value of every frame
            frames, times = read_convergence_frames(source, chunk.entity_path)
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
            pa.nulls(len(values), SCALAR_SCHEMA.field(name).type)
            if columns[name] is None
            else pa.array(columns[name], SCALAR_SCHEMA.field(name).type)
            for name in SCALAR_SCHEMA.names
        ]
        tables.append(pa.Table.from_arrays(arrays, schema=SCALAR_SCHEMA))
    order: Any = [(name, "ascending") for name in ("entity", "frame", "iteration")]
    return pa.concat_tables(tables).sort_by(order)


def read_convergence_frames(source: RecordingSource, entity: str) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the frames with recorded convergence, and their times [s], in stored order.

    Args:
        source: open recording.
        entity: entity path of a convergence curve, such as `/convergence/residual`.

    Returns:
        Frame indices (k,) and times (k,) [s].

    Raises:
        InputError: the recording does not state the frames.
    """
    for chunk in source.iterate_chunks(content=entity.rpartition("/")[0]):
        batch = chunk.to_record_batch()
        return read_cell(batch, "frames").astype(np.int64), read_cell(batch, "times").astype(float)
    raise InputError(InputMistake(f"does not state the frames of {entity}", file=source.path))


def _group_by_frame(table: pa.Table) -> dict[str, tuple[NDArray[np.int64], NDArray[np.float64]]]:
    """Return the scalars that have one value per frame: entity -> (frames, values)."""
    entities, frames, values = (table[name].to_numpy() for name in ("entity", "frame", "value"))
    once = table["iteration"].is_null().to_numpy()
    entities, frames, values = entities[once], frames[once].astype(np.int64), values[once]
    return {str(entity): (frames[of], values[of]) for entity in np.unique(entities) for of in [entities == entity]}


def _resolve_frame(path: Path, frame: int, known: NDArray[np.int64]) -> int:
    """Return the index of a frame among the recorded ones; -1 is the last."""
    if frame == -1 and len(known):
        return int(known[-1])
    if frame in known:
        return frame
    have = f"frames {known[0]} to {known[-1]} are" if len(known) else "no frame is"
    raise InputError(InputMistake(f"there is no frame {frame}; {have} recorded", file=path, key="frame"))


def read_cell(batch: pa.RecordBatch, name: str, row: int = 0) -> NDArray[Any]:
    """Return all numbers of one row of a component as a flat array.

    Args:
        batch: chunk of a recording.
        name: name of the component.
        row: index of the row.
    """
    values = get_scalar(batch, name, row).values
    while pa.types.is_nested(values.type):
        values = values.flatten()
    return values.to_numpy()


def read_timeline(batch: pa.RecordBatch, timeline: str) -> NDArray[Any]:
    """Return a timeline of a batch: frames, iterations, or times [s].

    Args:
        batch: chunk of a recording.
        timeline: name of the timeline: `frame`, `iteration` or `time`.

    Returns:
        Integers, or seconds for `time`, one of each row.
    """
    found = get_column(batch, timeline)
    counts: NDArray[np.int64] = found.cast(pa.int64()).to_numpy()
    return counts / 1e9 if pa.types.is_duration(found.type) else counts


def get_column(batch: pa.RecordBatch, name: str) -> Any:
    """Return a column, untyped.

    pyarrow's stubs do not type arrays that depend on the schema.

    Args:
        batch: chunk of a recording.
        name: name of the component or the timeline.
    """
    return cast(Any, batch[name])


def get_scalar(batch: pa.RecordBatch, name: str, row: int) -> Any:
    """Return one row of a column.

    Args:
        batch: chunk of a recording.
        name: name of the component.
        row: index of the row.

    Returns:
        The scalar of pyarrow, which is a list for most components.
    """
    return get_column(batch, name)[row]


def replace_cells(batch: pa.RecordBatch, name: str, rows: Sequence[NDArray[Any]]) -> pa.RecordBatch:
    """Return the batch with the numbers of a component replaced row by row.

    Args:
        batch: chunk of a recording.
        name: name of the component.
        rows: new numbers of each row, flat.
    """
    at = batch.schema.get_field_index(name)
    return batch.set_column(at, batch.schema.field(at), pa.array(rows, batch.schema.field(at).type))
