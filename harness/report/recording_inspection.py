# pyright: reportUnknownMemberType=false
# PyVista's filters and meshes are only partly typed.
"""Inspection of recordings: `springbench inspect` prints a summary, `springbench view` opens the viewer."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import rerun_cli  # pyright: ignore[reportMissingTypeStubs]
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from rich.text import Text
from springbench.harness.errors import InputError, InputMistake, RunFailed
from springbench.harness.recording.recorder_interface import RecordingReplay
from springbench.harness.recording.recording_reader import (
    RecordingSummary,
    open_recording_source,
    read_replay,
    summarise_recording,
)
from springbench.harness.report.number_format import format_quantity
from springbench.harness.results.quantities import compute_slowdown

_SURFACE_SUFFIXES = (".obj", ".ply", ".stl", ".vtk", ".vtp")
_LINE_SUFFIXES = (".vtk", ".vtp")
_FLOAT32_SUFFIXES = (".ply", ".stl")
"""Formats with single precision, which does not resolve a mesh far from the origin."""
_MAX_VIEWED = 50
"""Maximum number of recordings of a folder that are opened together."""
_MILLISECONDS_PATH = "/milliseconds/"


def inspect_recordings(
    paths: list[Path], *, frame: int | None, export: Path | None, csv: Path | None, console: Console
) -> None:
    """Print the contents of each recording, and the differences between two.

    Args:
        paths: recordings, or folders of recordings.
        frame: frame that `export` writes; None for the last one.
        export: mesh file of that frame; its suffix determines the format.
        csv: file for the scalars in long form.
        console: console that the summary is printed on.

    Raises:
        InputError: if a file is not a recording, a frame is missing, a suffix is unknown, or `export` or `csv` is given
            for several recordings.
    """
    paths = find_recordings(paths)
    if len(paths) != 1 and (export or csv):
        raise InputError(f"--export and --csv take one recording, not {len(paths)}")
    if frame is not None and export is None:
        raise InputError(InputMistake("chooses the frame to export; name a file with --export too", key="--frame"))
    for path in paths:
        found = summarise_recording(path)
        _print_summary(found, console)
        if csv:
            _write_export(csv, lambda target, table=found.scalars: pyarrow.csv.write_csv(table, target))
            console.print(f"wrote {found.scalars.num_rows} values to {csv}", markup=False)
    if export:
        replay = read_replay(paths[0], [-1 if frame is None else frame])
        _export_mesh(replay, paths[0], export)
        console.print(f"wrote frame {replay.frames[0]} to {export}", markup=False)
    if len(paths) == 2:
        _print_difference(paths, console)


def find_recordings(paths: Sequence[Path]) -> list[Path]:
    """Return the paths, with each folder replaced by the recordings below it.

    Raises:
        InputError: if a folder has no recordings, or more than a viewer can show.
    """
    found: list[Path] = []
    for path in paths:
        below = sorted(path.rglob("*.rrd")) if path.is_dir() else [path]
        if not below:
            raise InputError(InputMistake("this folder has no Rerun recording (.rrd) below it", file=path))
        if len(below) > _MAX_VIEWED:
            problem = (
                f"{len(below):,} recordings are below this folder; at most {_MAX_VIEWED} "
                f"can be opened, such as {below[0]}"
            )
            raise InputError(InputMistake(problem, file=path))
        found += below
    return found


def view_recordings(paths: list[Path]) -> None:
    """Open recordings in the Rerun viewer and wait until it is closed.

    Raises:
        InputError: if a file is not a recording.
        RunFailed: if there is no display or no viewer.
    """
    paths = find_recordings(paths)
    for path in paths:
        with open_recording_source(path):
            pass
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise RunFailed(
            "there is no display for the viewer; `springbench inspect` prints the contents of a recording, "
            "and `rerun FILE.rrd` shows it on a machine with a display"
        )
    binary = Path(rerun_cli.__file__).with_name("rerun.exe" if sys.platform == "win32" else "rerun")
    if not binary.is_file():
        raise RunFailed(f"the viewer is not installed: {binary} is missing; install rerun-sdk again")
    done = subprocess.run([binary, *map(str, paths)], check=False)
    if done.returncode:
        raise RunFailed(f"the viewer ended with code {done.returncode}")


def _print_summary(recording_summary: RecordingSummary, console: Console) -> None:
    console.rule(Text(recording_summary.title or str(recording_summary.path)))
    if not recording_summary.is_complete:
        console.print(
            f"Not complete: its run was stopped. {len(recording_summary.frames)} frames can be read.", style="yellow"
        )
    console.print(
        _build_table(
            ("run", ""),
            [("file", recording_summary.path), ("id", recording_summary.run_id), *recording_summary.properties.items()],
        )
    )
    rows = [(name, f"{first:g}", f"{last:g}") for name, (first, last) in recording_summary.timelines.items()]
    frames = ("frames", f"{len(recording_summary.frames)} recorded", "")
    console.print(
        _build_table(("timeline", "first", "last"), [*rows, *([frames] if len(recording_summary.frames) else [])])
    )
    series = dict(_read_scalar_series(recording_summary.scalars))
    phases = [
        (entity, *_format_spread(values))
        for entity, values in series.items()
        if _MILLISECONDS_PATH in entity and len(values)
    ]
    if phases:
        console.print(_build_table(("milliseconds of frames, medians over rounds", "min", "median", "p95"), phases))
    others = [
        (entity, f"{values[0]:.6g}", f"{values[-1]:.6g}", f"{np.abs(values).max():.6g}")
        for entity, values in series.items()
        if _MILLISECONDS_PATH not in entity and len(values)
    ]
    console.print(_build_table(("by frame", "first", "last", "largest magnitude"), others))
    console.print(Text("entities: " + ", ".join(recording_summary.entities)))


def _print_difference(paths: list[Path], console: Console) -> None:
    """Print the distance between the final positions of two runs, and their times."""
    for path in paths:
        read_replay(path, [-1])  # raises InputError unless it is the recording of one run
    first, second = (summarise_recording(path) for path in paths)
    common = np.intersect1d(first.frames, second.frames)
    if not len(common):
        raise InputError(f"{paths[0]} and {paths[1]} have no frame in common")
    last = int(common[-1])
    a, b = (read_replay(path, [last]) for path in paths)
    console.rule("difference")
    if a.positions.shape != b.positions.shape:
        counts = f"{a.positions.shape[1]} and {b.positions.shape[1]}"
        raise InputError(f"{paths[0]} and {paths[1]} have {counts} vertices: their positions cannot be compared")
    apart = np.linalg.norm(a.absolute_positions(0) - b.absolute_positions(0), axis=1)
    spacing = float(a.rest_lengths.mean()) if len(a.rest_lengths) else np.nan
    figures = {"max": apart.max(), "rms": math.sqrt((apart**2).mean())}
    rows = [(name, f"{value:.6g}", f"{value / spacing:.6g}") for name, value in figures.items()]
    console.print(_build_table((f"positions in frame {last}", "metres", "mean rest lengths"), rows))
    times = [dict(_read_scalar_series(found.scalars)) for found in (first, second)]
    phases = sorted(entity for entity in set(times[0]) & set(times[1]) if _MILLISECONDS_PATH in entity)
    rows = [
        (entity, *(f"{np.median(of[entity]):.4g}" for of in times), f"{_compute_time_ratio(times, entity):.4g}")
        for entity in phases
    ]
    whole = [found.properties.get("milliseconds_per_step") for found in (first, second)]
    if None not in whole:
        a, b = (float(value or 0.0) for value in whole)
        rows = [
            (
                "ms a step",
                format_quantity(a),
                format_quantity(b),
                format_quantity(compute_slowdown(b, a)) if a else "–",
            ),
            *rows,
        ]
    heading = "milliseconds: medians over frames of medians over rounds"
    if rows:
        console.print(_build_table((heading, "first", "second", "second / first"), rows))


def _compute_time_ratio(times: list[dict[str, NDArray[np.float64]]], entity: str) -> float:
    return float(np.median(times[1][entity]) / np.median(times[0][entity]))


def _read_scalar_series(scalars: pa.Table) -> Iterator[tuple[str, NDArray[np.float64]]]:
    """Yield each entity's finite values in the order of the frames.

    Values of single iterations are omitted.
    """
    once = scalars.filter(scalars["iteration"].is_null())
    entities, values = once["entity"].to_numpy(), once["value"].to_numpy()
    for entity in dict.fromkeys(entities):
        of = values[entities == entity]
        yield entity, of[np.isfinite(of)]


def _format_spread(values: NDArray[np.float64]) -> tuple[str, str, str]:
    low, middle, high = np.percentile(values, (0, 50, 95))
    return f"{low:.4g}", f"{middle:.4g}", f"{high:.4g}"


def _export_mesh(replay: RecordingReplay, recording: Path, export: Path) -> None:
    allowed = _SURFACE_SUFFIXES if len(replay.triangles) else _LINE_SUFFIXES
    if export.suffix not in allowed:
        which = "a surface" if len(replay.triangles) else "springs without a surface"
        problem = f"unknown suffix {export.suffix!r}; {recording.name} is {which}: one of {', '.join(allowed)}"
        raise InputError(InputMistake(problem, file=export))
    if replay.origin.any() and export.suffix in _FLOAT32_SUFFIXES:
        coarse = float(np.spacing(np.float32(np.abs(replay.origin).max()))) / 2
        problem = f"has single precision, which moves vertices by up to {coarse:.2g} m this far from (0, 0, 0)"
        raise InputError(InputMistake(f"{problem}; export to .vtp, .vtk or .obj", file=export))
    import pyvista as pv  # slow to load, and most inspections export nothing
    from springbench.harness.report.recorded_strain import compute_spring_strain, compute_vertex_strain

    points = replay.absolute_positions(0)
    if len(replay.triangles):
        mesh = pv.PolyData.from_regular_faces(points, replay.triangles)
    else:
        mesh = pv.PolyData(points, lines=np.insert(replay.springs, 0, 2, axis=1).ravel())
        mesh.cell_data["strain"] = compute_spring_strain(replay, 0)
    mesh.point_data["strain"] = compute_vertex_strain(replay, 0)
    _write_export(export, lambda path: mesh.save(path))


def _write_export(target: Path, write: Callable[[Path], object]) -> None:
    try:
        write(target)
    except OSError as error:
        raise InputError(InputMistake(f"cannot be written: {error.strerror or error}", file=target)) from error


def _build_table(head: tuple[str, ...], rows: Sequence[tuple[object, ...]]) -> Table:
    table = Table(box=None, header_style="bold", padding=(0, 2, 0, 0))
    for k, name in enumerate(head):
        table.add_column(name, justify="left" if k == 0 or head[0] == "run" else "right", overflow="fold")
    for row in rows:
        table.add_row(*(Text(str(value)) for value in row))
    return table
