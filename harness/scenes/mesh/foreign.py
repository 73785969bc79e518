# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false
# meshio has no types.
"""Mesh file readers that run in a subprocess: meshio's formats, and own readers of PLY and .vtp.

The subprocess is that of `harness.base.child`. meshio accepts some truncated files as complete. Hence the
sections of a .msh must be closed, and a text STL must have its end marker.
"""

from __future__ import annotations

import io
import os
import re
import sys
import warnings
from collections.abc import Callable, Generator
from contextlib import contextmanager, redirect_stdout
from functools import cache
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol, cast

import meshio
import numpy as np
from meshio.gmsh import _gmsh40, _gmsh41
from numpy.typing import NDArray

from harness.scenes.mesh import ply, vtp

Block = tuple[str, NDArray[np.int64]]
"""Cells of one kind: its meshio name, and the point indices of each cell."""

FACES = ("triangle", "quad", "polygon")
_KINDS = {2: "line", 3: "triangle", 4: "quad"}
"""Kind of a cell by its number of corners; others are polygons."""
_PHYSICAL = "gmsh:physical"


class Found(NamedTuple):
    """Contents of a mesh file.

    Attributes:
        points: (n, 3).
        groups: points by group name.
        attributes: point data (n,); components of vectors have a number in their name, `normal.0`.
        places: line or number of each cell of a block.
        left_out: points that no cell uses, of formats that store others besides the mesh, (k, 3).
    """

    points: NDArray[np.float64]
    blocks: list[Block]
    groups: dict[str, NDArray[np.int64]]
    attributes: dict[str, NDArray[np.float64]]
    places: list[NDArray[np.int64]]
    counted: Literal["line", "face"] = "face"
    left_out: NDArray[np.float64] = np.empty((0, 3))


class _Cells(Protocol):
    type: str
    data: NDArray[Any]


class _Raw(Protocol):
    """The part of meshio's result that is used."""

    points: NDArray[Any]
    cells: list[_Cells]
    point_data: dict[str, NDArray[Any]]
    cell_data: dict[str, list[NDArray[Any]]]
    field_data: dict[str, NDArray[Any]]
    point_sets: dict[str, Any]
    cell_sets: dict[str, list[Any]]


def read(path: Path) -> Found:
    """Read a mesh file.

    Raises:
        ValueError: for a truncated file.
        PermissionError: if the file refers to a file outside of its folder.
        Exception: of any type, for other broken files.
    """
    with _confined_to(path):
        return _read(path)


def _read(path: Path) -> Found:
    suffix = path.suffix.lower()
    if suffix == ".vtp":
        return _of_vtp(vtp.read(path.read_bytes()))
    if suffix == ".ply":
        return _of_ply(ply.read(path.read_bytes()))
    content = path.read_bytes() if suffix in (".msh", ".stl") else b""
    if suffix == ".msh" and _PARAMETRIC.search(content):
        raise ValueError("it has parametric nodes; save it without them (Mesh.SaveParametric = 0 in Gmsh)")
    raw = _by_meshio(path)
    missing = _MISSING.get(suffix)
    if missing and (what := missing(content, raw)):
        raise ValueError(f"{what}; the file was cut before its end, so write it once more")
    blocks = [(block.type, np.array(block.data, np.int64)) for block in raw.cells if len(block.data)]
    kept = [(kind, data) for kind, data in blocks if kind != "vertex"]
    points = np.array(raw.points, np.float64)
    found = Found(points, kept, _groups(raw), _columns(raw.point_data, len(points)), _numbered(kept))
    return _without_stray(found) if suffix == ".msh" else found


class _Confinement:
    """Audit hook that restricts opened files to some folders, read-only, while it is active."""

    def __init__(self) -> None:
        self.folders: tuple[Path, ...] = ()
        sys.addaudithook(self._check)

    def _check(self, event: str, arguments: tuple[Any, ...]) -> None:
        if event != "open" or not self.folders or isinstance(arguments[0], int):
            return
        name, mode, flags = arguments
        path = Path(os.fsdecode(name)).resolve()
        writes = set(mode or "") & set("wax+") or (flags or 0) & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
        is_code = path.suffix in (".py", ".pyc")
        if writes or not (is_code or any(path.is_relative_to(folder) for folder in self.folders)):
            raise PermissionError(f"it refers to {path}, which lies outside of its folder")


@cache
def _confinement() -> _Confinement:
    return _Confinement()


@contextmanager
def _confined_to(path: Path) -> Generator[None]:
    """Restrict file access to the folder of a file, and to what Python imports."""
    installed = (Path(sys.prefix).resolve(), Path(sys.base_prefix).resolve())
    _confinement().folders = (path.resolve(), path.parent.resolve(), *installed)
    try:
        yield
    finally:
        _confinement().folders = ()


def _by_meshio(path: Path) -> _Raw:
    """Read a file with meshio; raise ValueError with the reason if meshio prints it and exits."""
    said = io.StringIO()
    try:
        with warnings.catch_warnings(), redirect_stdout(said):
            warnings.simplefilter("ignore")
            return cast(_Raw, meshio.read(path))
    except SystemExit:
        reason = "; ".join(filter(None, map(str.strip, said.getvalue().splitlines())))
        raise ValueError(reason or f"it does not hold what a {path.suffix} file begins with") from None


def _tagged(read_entities: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap a reader of Gmsh entities so that entities without a physical group get the tag 0, which means none.

    meshio counts blocks of cells incorrectly if some entities have no tag at all.
    """

    def read(*arguments: Any) -> Any:
        found = read_entities(*arguments)
        for of_dimension in found[0] if isinstance(found[0], tuple) else found:
            for entity, tags in of_dimension.items():
                of_dimension[entity] = tags or [0]
        return found

    return read


for _module in (_gmsh40, _gmsh41):
    setattr(_module, "_read_entities", _tagged(_module._read_entities))  # noqa: B010


def _numbered(blocks: list[Block]) -> list[NDArray[np.int64]]:
    """Number each face among all faces, from 0; the numbers of other cells are unused."""
    faces = [0, *np.cumsum([len(data) if kind in FACES else 0 for kind, data in blocks]).tolist()]
    return [first + np.arange(len(data)) for first, (_, data) in zip(faces, blocks, strict=False)]


def _without_stray(found: Found) -> Found:
    """Remove points without cells: Gmsh saves the points of a geometry, such as the centres of circles."""
    used = np.zeros(len(found.points), np.bool_)
    for _, data in found.blocks:
        if len(data) and (data.min() < 0 or data.max() >= len(used)):
            return found  # the caller names the cell
        used[data.ravel()] = True
    if used.all():
        return found
    number = np.cumsum(used) - 1
    groups = {name: number[group[used[group]]] for name, group in found.groups.items()}
    return found._replace(
        points=found.points[used],
        blocks=[(kind, number[data]) for kind, data in found.blocks],
        groups={name: group for name, group in groups.items() if len(group)},
        attributes={name: column[used] for name, column in found.attributes.items()},
        left_out=found.points[~used],
    )


def _of_ply(read: ply.Ply) -> Found:
    blocks = [(_KINDS.get(k, "polygon"), rows) for k, (rows, _) in read.faces.items()]
    places = [read.first_line + which for _, which in read.faces.values()]
    counted: Literal["line", "face"] = "line" if read.first_line else "face"
    return Found(read.points, blocks, {}, read.numbers, places, counted)


def _of_vtp(read: vtp.Surface) -> Found:
    """Convert VTP content, with faces grouped by their number of corners."""
    groups = dict[int, list[NDArray[np.int64]]]()
    for polygon in read.polygons:
        groups.setdefault(len(polygon), []).append(polygon)
    blocks = [(_KINDS.get(k, "polygon"), np.array(group)) for k, group in sorted(groups.items())]
    pairs = [np.column_stack([line[:-1], line[1:]]) for line in read.lines]
    if pairs:
        blocks.append(("line", np.concatenate(pairs)))
    return Found(read.points, blocks, {}, _columns(read.numbers, len(read.points)), _numbered(blocks))


def _groups(raw: _Raw) -> dict[str, NDArray[np.int64]]:
    """Collect the points of named point sets and cell sets, and of Gmsh's physical groups."""
    found: dict[str, list[NDArray[Any]]] = {name: [np.asarray(some)] for name, some in raw.point_sets.items()}
    for name, sets in raw.cell_sets.items():
        if name.startswith("gmsh:"):  # numbers of bounding entities, of no cells
            continue
        for block, some in zip(raw.cells, sets, strict=True):
            if some is not None:
                found.setdefault(name, []).append(np.asarray(block.data)[np.asarray(some, np.int64)])
    for name, (tag, _) in raw.field_data.items():
        for block, tags in zip(raw.cells, raw.cell_data.get(_PHYSICAL, []), strict=False):
            found.setdefault(name, []).append(np.asarray(block.data)[np.asarray(tags) == tag])
    joined = {name: np.unique(np.concatenate([x.ravel() for x in some])) for name, some in found.items() if some}
    return {name: points.astype(np.int64) for name, points in joined.items() if len(points)}


def _columns(numbers: dict[str, NDArray[Any]], n: int) -> dict[str, NDArray[np.float64]]:
    """Split point data of n points into columns."""
    found: dict[str, NDArray[np.float64]] = {}
    for name, values in numbers.items():
        if len(values) != n:
            continue
        columns = np.asarray(values, np.float64).reshape(n, -1).T
        found |= {name: columns[0]} if len(columns) == 1 else {f"{name}.{k}": x for k, x in enumerate(columns)}
    return {name: np.ascontiguousarray(column) for name, column in found.items()}


_SECTION = re.compile(rb"^\$(End)?((?:MeshFormat|PhysicalNames|Entities|Nodes|Elements|Periodic)\b|\w+Data\b)", re.M)
_PARAMETRIC = re.compile(rb"^\$ParametricNodes\b", re.M)


def _open_sections(content: bytes, raw: _Raw) -> str:
    """Find an unclosed section of a Gmsh .msh.

    The ANSYS format of the same suffix has no sections.
    """
    begun: dict[bytes, int] = {}
    for end, name in _SECTION.findall(content):
        begun[name] = begun.get(name, 0) + (-1 if end else 1)
    left = next((name.decode() for name, count in begun.items() if count > 0), "")
    return f"the section ${left} has no $End{left}" if left else ""


def _not_ended(content: bytes, raw: _Raw) -> str:
    """Detect a truncated STL; a binary one contains its number of triangles."""
    text = content.lstrip().startswith(b"solid") and b"facet" in content
    return "it has no endsolid" if text and b"endsolid" not in content else ""


_MISSING: dict[str, Callable[[bytes, _Raw], str]] = {
    ".msh": _open_sections,
    ".stl": _not_ended,
}
