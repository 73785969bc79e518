"""Meshes from files: OBJ, the assignment's JSON scenes, and every format that meshio reads."""

from __future__ import annotations

import io
import warnings
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Literal

import meshio
import numpy as np

from harness.base.errors import InputError, Mistake
from harness.base.model import Model
from harness.scenes.mesh.base import Mesh
from harness.scenes.mesh.cells import MAX_COORDINATE, Cells, SpringRule, check_file, network
from harness.scenes.mesh.obj import read_obj
from harness.scenes.mesh.scene_json import read_scene_json
from harness.scenes.mesh.topology import NO_PAIRS, Indices

_KINDS = ("line", "triangle", "quad", "polygon", "tetra")
"""The kinds of cells that springs are made of; the kind `vertex` is passed over."""


class File(Model):
    """A mesh from a file; its size is the file's own. Parts: the sides of its bounding box."""

    kind: Literal["file"] = "file"
    path: Path
    """An OBJ, a JSON scene of the assignment (its OBJ is read), or a file that meshio reads (PLY, VTK, ...)."""
    springs: SpringRule | None = None
    """Springs along `edges` of faces alone, or between all `face_pairs`; by default as JSON scenes want it
    (face_pairs), and edges for all other files."""

    def build(self, size: int = 0) -> Mesh:
        """The file's mesh, whatever the size; see `harness.scenes.mesh.cells.network` for springs and masses.

        Raises InputError for a file that is missing, malformed, empty or too large.
        """
        path, suffix = self.path, self.path.suffix.lower()
        rule = self.springs or ("face_pairs" if suffix == ".json" else "edges")
        if suffix == ".json":
            path = path.parent / read_scene_json(path).obj
            suffix = path.suffix.lower()
        return network(read_obj(path) if suffix == ".obj" else _read_meshio(path), rule, path)


def _read_meshio(path: Path) -> Cells:
    """The points and cells that meshio finds; whatever goes wrong there is an InputError."""
    check_file(path)
    printed = io.StringIO()
    try:
        with redirect_stdout(printed), redirect_stderr(printed), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            raw = meshio.read(path)
            points = np.array(raw.points, np.float64)
            blocks = [(block.type, np.array(block.data, np.int64)) for block in raw.cells if len(block.data)]
            blocks = [(kind, data) for kind, data in blocks if kind != "vertex"]
    except (Exception, SystemExit) as error:  # readers raise anything on a broken file, or leave by sys.exit
        reason = str(error) if isinstance(error, Exception) else printed.getvalue()
        reason = " ".join(reason.split())[:300] or type(error).__name__
        raise InputError(Mistake(f"cannot be read as a mesh: {reason}", path)) from None

    problem = _problem(points, blocks)
    if problem:
        raise InputError(Mistake(problem, path))
    groups: dict[int, list[Indices]] = {}
    for kind, data in blocks:
        if kind in ("triangle", "quad", "polygon"):
            groups.setdefault(data.shape[1], []).append(data)
    return Cells(
        points=np.pad(points, ((0, 0), (0, 3 - points.shape[1]))),
        polygons={corners: np.concatenate(groups[corners]) for corners in sorted(groups)},
        segments=np.concatenate([NO_PAIRS, *(data for kind, data in blocks if kind == "line")]),
        tetrahedra=np.concatenate([np.empty((0, 4), np.int64), *(data for kind, data in blocks if kind == "tetra")]),
    )


def _problem(points: np.ndarray, blocks: list[tuple[str, Indices]]) -> str:
    """What is wrong with what meshio read, or nothing."""
    if points.ndim != 2 or not 1 <= points.shape[1] <= 3:
        return f"has points of shape {points.shape}; wanted 1 to 3 coordinates each"
    if not np.all(np.abs(points) <= MAX_COORDINATE):
        row = int(np.flatnonzero(~np.all(np.abs(points) <= MAX_COORDINATE, axis=1))[0])
        return f"point {row} (from 0) is {points[row]}; wanted finite numbers up to {MAX_COORDINATE:g} m"
    for kind, data in blocks:
        if kind not in _KINDS:
            return f"has cells of type {kind}; wanted {', '.join(_KINDS)}"
        ordered = np.sort(data, axis=1)
        wrong = (ordered[:, 0] < 0) | (ordered[:, -1] >= len(points))
        wrong |= np.any(ordered[:, 1:] == ordered[:, :-1], axis=1)
        if wrong.any():
            cell = data[np.flatnonzero(wrong)[0]].tolist()
            return f"a {kind} names the points {cell}; wanted different ones from 0 to {len(points) - 1}"
    return ""
