"""Readers of positions over time that other programs wrote.

    .npz, .npy   array (k, n, 3) or (k, 3 n)
    .csv, .txt   columns frame, vertex, x, y, z, one line a vertex; or one line of 3 n numbers a frame
    folder       one OBJ or PLY file a frame, in the order of the numbers in their names
    .rrd         recording of springbench

The readers decide neither frame numbers nor vertex order; `springbench.harness.experiments.grading.submission` does.
"""

from __future__ import annotations

import re
from array import array as array_type
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any
from zipfile import BadZipFile, ZipFile

import numpy as np
from numpy.typing import NDArray
from springbench.harness.atomic_files import describe_cause
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.execution import sandbox
from springbench.harness.execution.npz_reader import check_data_file, read_npy_array, read_npz_array
from springbench.harness.scenes.mesh import ply_reader
from springbench.harness.scenes.mesh.obj_reader import read_obj
from springbench.harness.scenes.mesh.spring_network import check_mesh_file

DEFAULT_ARRAY = "positions"
"""Name of the array in an .npz file that `springbench run --positions` writes."""
MESH_SUFFIXES = (".obj", ".ply")
POSITION_SUFFIXES = (".npz", ".npy", ".csv", ".txt", ".rrd")
MAX_MESH_FILES = 100_000
_PLY_LIMITS = sandbox.CallLimits(60.0, 2**31)
_LONG_COLUMNS = ("x", "y", "z")
_MAX_CELL_LENGTH = 64
"""Largest number of characters of a number in a table, with its separators."""


@dataclass(frozen=True, slots=True, eq=False)
class PositionSequence:
    """Positions over time as read from a file.

    Attributes:
        source: the file or folder.
        positions: (k, n, 3) [m].
        frames: frame numbers (k,) that the file states, None where it states none.
        times: times (k,) [s] that the file states, None where it states none.
        notes: sentences on what was assumed to read the file.
    """

    source: Path
    positions: NDArray[np.float64]
    frames: NDArray[np.int64] | None = None
    times: NDArray[np.float64] | None = None
    notes: tuple[str, ...] = ()


def read_position_file(path: Path, num_vertices: int, array: str = DEFAULT_ARRAY) -> PositionSequence:
    """Read positions over time.

    Args:
        path: file or folder.
        num_vertices: number of vertices of the scene.
        array: name of the array in an .npz file.

    Raises:
        InputError: the file is missing, broken, or has other vertices.
    """
    if not path.exists():
        raise InputError(InputMistake(f"there is no such file; {_describe_formats()}", path))
    read = _read_folder if path.is_dir() else _READERS.get(path.suffix.lower())
    if read is None:
        raise InputError(InputMistake(f"has the suffix {path.suffix!r}; {_describe_formats()}", path))
    found = read(path, num_vertices, array)
    k, n = found.positions.shape[:2]
    if not k:
        raise InputError(InputMistake("has no frames", path))
    if n != num_vertices:
        problem = f"has {n:,} vertices; the scene has {num_vertices:,}. Is it of another scene or size?"
        if k == num_vertices:
            problem = f"has the shape (vertices, frames, 3) = ({k}, {n}, 3); expected (frames, vertices, 3)"
        raise InputError(InputMistake(problem, path))
    return found


def read_rest_positions(path: Path, num_vertices: int) -> NDArray[np.float64]:
    """Read rest positions (n, 3) [m].

    Args:
        path: mesh file, or file of positions with a single frame.
        num_vertices: number of vertices n of the scene.

    Raises:
        InputError: the file cannot be read, or has other vertices, several frames, or coordinates that are not finite.
    """
    if path.suffix.lower() in MESH_SUFFIXES and path.is_file():
        points = _read_mesh_points(path)
        if len(points) != num_vertices:
            raise InputError(InputMistake(f"has {len(points):,} vertices; the scene has {num_vertices:,}", path))
        return points
    found = read_position_file(path, num_vertices)
    if len(found.positions) != 1:
        raise InputError(InputMistake(f"has {len(found.positions)} frames; expected one, the rest positions", path))
    if not np.isfinite(found.positions).all():
        raise InputError(InputMistake("has rest positions that are not finite", path))
    return found.positions[0]


def is_submission(path: Path) -> bool:
    """Return whether a path can be a position file or a folder of mesh files.

    Only its name and its entries are read.
    """
    if path.is_dir():
        return any(one.suffix.lower() in MESH_SUFFIXES for one in path.iterdir())
    return path.suffix.lower() in POSITION_SUFFIXES


def _describe_formats() -> str:
    return f"expected {', '.join(POSITION_SUFFIXES)}, or a folder of {' or '.join(MESH_SUFFIXES)} files, one a frame"


def _read_npz(path: Path, n: int, array: str) -> PositionSequence:
    only = _find_only_array(path) if array == DEFAULT_ARRAY else None
    values = read_npz_array(path, only or array, allows_nonfinite=True)
    notes = (f"array: `{only}`, the only one in the file",) if only and only != array else ()
    return PositionSequence(path, _to_frames(values, n, path), notes=notes)


def _find_only_array(path: Path) -> str | None:
    """Return the name of the only array in an .npz file.

    The result is None if there are several, or if they cannot be listed.
    """
    try:
        with ZipFile(path) as archive:
            names = archive.namelist()
    except (OSError, ValueError, BadZipFile):
        return None
    name = names[0].removesuffix(".npy") if len(names) == 1 else ""
    return name if name.isidentifier() else None


def _read_npy(path: Path, n: int, array: str) -> PositionSequence:
    return PositionSequence(path, _to_frames(read_npy_array(path, allows_nonfinite=True), n, path))


def _to_frames(values: NDArray[np.float64], n: int, path: Path) -> NDArray[np.float64]:
    """Return values as (k, n, 3)."""
    if values.ndim == 3 and values.shape[2] == 3:
        return values
    if values.ndim == 2 and values.shape[1] == 3 * n:
        return values.reshape(-1, n, 3)
    if values.shape == (n, 3):
        return values[None]
    expectation = f"(frames, {n}, 3) or (frames, {3 * n})"
    raise InputError(InputMistake(f"its array has the shape {values.shape}; expected {expectation}", path))


def _read_table(path: Path, n: int, array: str) -> PositionSequence:
    """Read a text table, with or without names of the columns."""
    check_data_file(path, path.suffix)
    names, values, numbers = list[str](), array_type("d"), array_type("q")
    width, longest = 0, _MAX_CELL_LENGTH * (3 * n + 2)
    try:
        with path.open(encoding="utf-8-sig") as file:
            for number, line in enumerate(iter(lambda: file.readline(longest + 1), ""), 1):
                if len(line) > longest:
                    problem = f"has a line of more than {longest:,} characters; expected at most {3 * n + 2} numbers"
                    raise InputError(InputMistake(problem, path, number))
                cells = [cell for cell in re.split(r"[,;\s]+", line.strip()) if cell]
                if not cells or cells[0].startswith("#"):
                    continue
                try:
                    row = [float(cell) for cell in cells]
                except ValueError:
                    if numbers or names:
                        raise InputError(InputMistake(f"is not all numbers: {line[:60]!r}", path, number)) from None
                    names = [cell.strip("\"'").lower() for cell in cells]
                    continue
                width = width or len(names) or len(row)
                if len(row) != width:
                    problem = f"has {len(row)} columns; expected {width}, as the first line has"
                    raise InputError(InputMistake(problem, path, number))
                values.extend(row)
                numbers.append(number)
    except (OSError, ValueError) as error:
        raise InputError(InputMistake(f"cannot be read as text: {describe_cause(error)}", path)) from None
    if not numbers:
        raise InputError(InputMistake("has no frames", path))
    if repeated := [name for name in names if names.count(name) > 1]:
        raise InputError(InputMistake(f"names the column {repeated[0]!r} twice", path, numbers[0] - 1))
    table = np.frombuffer(values, float).reshape(-1, width)
    if set(_LONG_COLUMNS) <= set(names):
        return _read_long_table(path, n, names, table)
    leading = {name: table[:, names.index(name)] for name in ("frame", "time") if name in names}
    coordinates = [column for column in range(table.shape[1]) if not (names and names[column] in leading)]
    if len(coordinates) != 3 * n:
        expectation = f"one line a frame of {3 * n} numbers, or the columns frame, vertex, x, y, z"
        raise InputError(InputMistake(f"has {len(coordinates)} columns; expected {expectation}", path, numbers[0]))
    frames = _to_whole_numbers(leading["frame"], "frame", path) if "frame" in leading else None
    times = _to_times(leading["time"], path) if "time" in leading else None
    return PositionSequence(path, table[:, coordinates].reshape(-1, n, 3), frames, times)


def _read_long_table(path: Path, n: int, names: list[str], table: NDArray[np.float64]) -> PositionSequence:
    """Read a table of one line a vertex and frame."""
    key = next((name for name in ("frame", "time") if name in names), None)
    if key is None or "vertex" not in names:
        missing = "frame" if key is None else "vertex"
        raise InputError(InputMistake(f"has the columns {', '.join(names)}; expected `{missing}` too", path, 1))
    column = table[:, names.index(key)]
    frames, times = (_to_whole_numbers(column, key, path), None) if key == "frame" else (None, _to_times(column, path))
    values, rows = np.unique(column, return_inverse=True)
    vertices = _to_whole_numbers(table[:, names.index("vertex")], "vertex", path)
    first = 0 if vertices.min(initial=1) == 0 else 1
    vertices = vertices - first
    expected = len(values) * n
    if vertices.min(initial=0) < 0 or vertices.max(initial=0) >= n or len(vertices) != expected:
        problem = f"has {len(vertices):,} lines and vertices up to {vertices.max(initial=0) + first}; expected each of "
        raise InputError(InputMistake(f"{problem}{n:,} vertices once in each of {len(values)} frames", path))
    counts = np.bincount(rows * n + vertices, minlength=expected)
    if (counts != 1).any():
        row, vertex = divmod(int(np.flatnonzero(counts != 1)[0]), n)
        problem = (
            f"has vertex {vertex + first} {counts[row * n + vertex]} times in {key} {values[row]:g}; expected once"
        )
        raise InputError(InputMistake(problem, path))
    p = np.empty((len(values), n, 3))
    p[rows, vertices] = table[:, [names.index(axis) for axis in _LONG_COLUMNS]]
    return PositionSequence(path, p, None if frames is None else np.unique(frames), None if times is None else values)


def _to_whole_numbers(column: NDArray[np.float64], name: str, path: Path) -> NDArray[np.int64]:
    """Return a column of frame or vertex numbers as integers."""
    is_wrong = ~(np.abs(column) < 2.0**53) | (column != np.trunc(column))
    if is_wrong.any():
        problem = f"its column {name} has {column[is_wrong][0]:g}; expected whole numbers"
        raise InputError(InputMistake(problem, path))
    return column.astype(np.int64)


def _to_times(column: NDArray[np.float64], path: Path) -> NDArray[np.float64]:
    """Return a column of times [s], which must be finite."""
    if not np.isfinite(column).all():
        wrong = column[~np.isfinite(column)][0]
        raise InputError(InputMistake(f"its column time has {wrong:g}; expected seconds", path))
    return column


def _read_folder(folder: Path, n: int, array: str) -> PositionSequence:
    """Read a folder of mesh files, one a frame."""
    files = [one for one in folder.iterdir() if one.suffix.lower() in MESH_SUFFIXES and one.is_file()]
    if not files:
        raise InputError(InputMistake(f"has no {' or '.join(MESH_SUFFIXES)} files; {_describe_formats()}", folder))
    if len(files) > MAX_MESH_FILES:
        raise InputError(InputMistake(f"has {len(files):,} files; at most {MAX_MESH_FILES:,} are read", folder))
    found = {one: re.findall(r"\d+", one.stem) for one in files}
    if unnumbered := [one.name for one, digits in found.items() if not digits]:
        problem = f"its file {sorted(unnumbered)[0]} has no number; name the files by their frames"
        raise InputError(InputMistake(problem, folder))
    by_number = sorted((int(digits[-1]), one) for one, digits in found.items())
    frames = [number for number, _ in by_number]
    gap = next((a for a, b in pairwise(frames) if b != a + 1), None)
    if gap is not None:
        problem = f"has files {gap} and {frames[frames.index(gap) + 1]} in a row; expected one file for every frame"
        raise InputError(InputMistake(problem, folder))
    points = [_read_mesh_points(one) for _, one in by_number]
    sizes = [len(one) for one in points]
    odd = next((k for k, size in enumerate(sizes) if size != sizes[0]), None)
    if odd is not None:
        problem = f"has {sizes[odd]:,} vertices, and {by_number[0][1].name} has {sizes[0]:,}"
        raise InputError(InputMistake(problem, by_number[odd][1]))
    return PositionSequence(folder, np.array(points))


def _read_mesh_points(path: Path) -> NDArray[np.float64]:
    """Read the vertices (n, 3) of an OBJ or PLY file."""
    if path.suffix.lower() == ".obj":
        return np.asarray(read_obj(path).points, float)
    check_mesh_file(path)
    try:
        return sandbox.call_in_sandbox(_read_ply_points, path, limits=_PLY_LIMITS)
    except sandbox.SandboxError as error:
        raise InputError(InputMistake(f"cannot be read as a PLY file: {error}", path)) from None


def _read_ply_points(path: Path) -> NDArray[np.float64]:
    """Read the vertices of a PLY file in the sandbox."""
    return np.asarray(ply_reader.read_ply(path.read_bytes()).points, float)


def _read_recording(path: Path, n: int, array: str) -> PositionSequence:
    from springbench.harness.recording.recording_reader import read_replay

    replay = read_replay(path)
    return PositionSequence(path, replay.positions + replay.origin, replay.frames, replay.times)


_READERS: dict[str, Callable[[Path, int, str], Any]] = {
    ".npz": _read_npz,
    ".npy": _read_npy,
    ".csv": _read_table,
    ".txt": _read_table,
    ".rrd": _read_recording,
}
