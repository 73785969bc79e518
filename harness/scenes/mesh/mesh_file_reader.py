# pyright: reportMissingTypeStubs=false, reportUnknownArgumentType=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# meshio has no types.
"""Readers of mesh files that run in a subprocess.

They are meshio, and the project's readers of PLY, STL, OFF, VTP and glTF. `springbench.harness.execution.sandbox`
starts the subprocess. meshio and VTK accept some truncated files as complete, which
`springbench.harness.scenes.mesh.file_truncation` recognises.
"""

from __future__ import annotations

import io
import os
import re
import sys
import warnings
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager, redirect_stdout
from functools import cache
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol, cast

import meshio
import numpy as np
from meshio.gmsh import _gmsh40, _gmsh41
from numpy.typing import NDArray
from springbench.harness.scenes.mesh import (
    file_truncation,
    gltf_reader,
    off_reader,
    ply_reader,
    stl_reader,
    vtp_reader,
)

CellBlock = tuple[str, NDArray[np.int64]]
"""Cells of one kind: its meshio name, and the point indices of each cell."""

FACE_KINDS = ("triangle", "quad", "polygon")
_CELL_KIND_BY_CORNERS = {2: "line", 3: "triangle", 4: "quad"}
"""Kind of a cell by its number of corners; others are polygons."""
_GMSH_PHYSICAL = "gmsh:physical"


class MeshFileContent(NamedTuple):
    """Contents of a mesh file.

    Attributes:
        points: positions (n, d), with d from 1 to 3.
        cell_blocks: blocks of cells of one kind.
        vertex_groups: points by group name.
        attributes: point data (n,); components of vectors have a number in their name, `normal.0`.
        face_locations: for each block, the line or the number of each cell.
        location_unit: whether these are lines or numbers of faces.
        line_attributes: cell data of the cells `line`, in their order, each (lines,).
    """

    points: NDArray[np.float64]
    cell_blocks: list[CellBlock]
    vertex_groups: dict[str, NDArray[np.int64]]
    attributes: dict[str, NDArray[np.float64]]
    face_locations: list[NDArray[np.int64]]
    location_unit: Literal["line", "face"] = "face"
    line_attributes: Mapping[str, NDArray[np.float64]] = {}


class _MeshioCells(Protocol):
    type: str
    data: NDArray[Any]


class _MeshioMesh(Protocol):
    """The used part of meshio's result."""

    points: NDArray[Any]
    cells: list[_MeshioCells]
    point_data: dict[str, NDArray[Any]]
    cell_data: dict[str, list[NDArray[Any]]]
    field_data: dict[str, NDArray[Any]]
    point_sets: dict[str, Any]
    cell_sets: dict[str, list[Any]]


def read_mesh_file(path: Path) -> MeshFileContent:
    """Read a mesh file.

    Raises:
        ValueError: for a truncated file.
        PermissionError: if the file refers to a file outside of its folder.
        Exception: of any type, for other broken files.
    """
    suffix, content = path.suffix.lower(), path.read_bytes()
    what = file_truncation.find_strict_truncation(suffix, content)
    if not what:
        try:
            with _restrict_file_access(path):
                return _read_by_suffix(path, content)
        except PermissionError:
            raise
        except Exception as error:
            what = file_truncation.guess_truncation(suffix, content)
            if not what or "was cut" in str(error):
                raise
            symptom = str(error) or type(error).__name__
            raise ValueError(f"{what}: was the file cut before its end? ({symptom})") from error
    raise ValueError(f"{what}; the file was cut before its end, so write it once more")


def _read_by_suffix(path: Path, content: bytes) -> MeshFileContent:
    suffix = path.suffix.lower()
    if suffix == ".vtp":
        return _convert_vtp(vtp_reader.read_vtp(content))
    if suffix == ".ply":
        return _convert_polygons(ply_reader.read_ply(content))
    if suffix == ".off":
        return _convert_polygons(off_reader.read_off(content))
    if suffix == ".stl":
        points, triangles = stl_reader.read_stl(content)
        return MeshFileContent(points, [("triangle", triangles)], {}, {}, [np.arange(len(triangles))])
    if suffix in (".gltf", ".glb"):
        return _convert_gltf(gltf_reader.read_gltf(path))
    if suffix == ".vtk" and _VTK_POLYDATA.search(content[:_VTK_HEAD_BYTES]):
        return _convert_vtp(vtp_reader.read_vtp(_convert_legacy_polydata(path)))
    if suffix == ".msh" and _GMSH_PARAMETRIC.search(content):
        raise ValueError("it has parametric nodes; save it without them (Mesh.SaveParametric = 0 in Gmsh)")
    raw = _read_with_meshio(path)
    blocks = [(block.type, np.array(block.data, np.int64)) for block in raw.cells if len(block.data)]
    cell_blocks = [(kind, data) for kind, data in blocks if kind != "vertex"]
    points = np.array(raw.points, np.float64)
    return MeshFileContent(
        points,
        cell_blocks,
        _collect_groups(raw),
        _split_columns(raw.point_data, len(points)),
        _number_faces(cell_blocks),
        line_attributes=_collect_line_attributes(raw),
    )


class _FileAccessGuard:
    """Audit hook that restricts opened files to some folders, read-only, while it is active."""

    def __init__(self) -> None:
        self.folders: tuple[Path, ...] = ()
        sys.addaudithook(self._check_event)

    def _check_event(self, event: str, arguments: tuple[Any, ...]) -> None:
        if event != "open" or not self.folders or isinstance(arguments[0], int):
            return
        name, mode, flags = arguments
        path = Path(os.fsdecode(name)).resolve()
        writes = set(mode or "") & set("wax+") or (flags or 0) & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
        is_code = path.suffix in (".py", ".pyc")
        if writes or not (is_code or any(path.is_relative_to(folder) for folder in self.folders)):
            raise PermissionError(f"it refers to {path}, which lies outside of its folder")


@cache
def _file_access_guard() -> _FileAccessGuard:
    return _FileAccessGuard()


@contextmanager
def _restrict_file_access(path: Path) -> Generator[None]:
    """Restrict file access to the folder of a file, and to what Python imports."""
    installed = (Path(sys.prefix).resolve(), Path(sys.base_prefix).resolve())
    _file_access_guard().folders = (path.resolve(), path.parent.resolve(), *installed)
    try:
        yield
    finally:
        _file_access_guard().folders = ()


def _read_with_meshio(path: Path) -> _MeshioMesh:
    """Read a file with meshio.

    Raises:
        ValueError: if meshio exits, with the reason that it printed.
    """
    output = io.StringIO()
    try:
        with warnings.catch_warnings(), redirect_stdout(output):
            warnings.simplefilter("ignore")
            return cast(_MeshioMesh, meshio.read(path))
    except SystemExit:
        reason = "; ".join(filter(None, map(str.strip, output.getvalue().splitlines())))
        raise ValueError(reason or f"it does not contain what a {path.suffix} file begins with") from None


def _tag_ungrouped_entities(read_entities: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap a reader of Gmsh entities: those without a physical group get the tag 0.

    The tag 0 means no group. meshio counts blocks of cells incorrectly if some entities have no tag at all.
    """

    def read(*arguments: Any) -> Any:
        found = read_entities(*arguments)
        for of_dimension in found[0] if isinstance(found[0], tuple) else found:
            for entity, tags in of_dimension.items():
                of_dimension[entity] = tags or [0]
        return found

    return read


for _module in (_gmsh40, _gmsh41):
    setattr(_module, "_read_entities", _tag_ungrouped_entities(_module._read_entities))  # noqa: B010


def _number_faces(blocks: list[CellBlock]) -> list[NDArray[np.int64]]:
    """Number each face among all faces, from 0; the numbers of other cells are unused."""
    faces = [0, *np.cumsum([len(data) if kind in FACE_KINDS else 0 for kind, data in blocks]).tolist()]
    return [first + np.arange(len(data)) for first, (_, data) in zip(faces, blocks, strict=False)]


def _convert_polygons(read: ply_reader.PolygonContent) -> MeshFileContent:
    blocks = [(_CELL_KIND_BY_CORNERS.get(k, "polygon"), rows) for k, (rows, _) in read.faces.items()]
    places = [read.first_face_line + which for _, which in read.faces.values()]
    counted: Literal["line", "face"] = "line" if read.first_face_line else "face"
    return MeshFileContent(read.points, blocks, {}, read.vertex_attributes, places, counted)


_VTK_POLYDATA = re.compile(rb"^DATASET\s+POLYDATA", re.M | re.I)
_VTK_HEAD_BYTES = 2_000
"""Number of bytes that contain the kind of data of a legacy VTK file, after a title of at most 256 characters."""


def _convert_legacy_polydata(path: Path) -> bytes:
    """Convert a legacy VTK file of surfaces to the contents of a .vtp file.

    meshio does not support legacy files of surfaces.
    """
    try:
        from vtkmodules.vtkIOLegacy import vtkPolyDataReader
        from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter
    except ModuleNotFoundError:
        raise ValueError('a legacy file of surfaces needs VTK: pip install "springbench[pictures]"') from None
    reader, writer = vtkPolyDataReader(), vtkXMLPolyDataWriter()
    reader.SetFileName(str(path))
    reader.ReadAllScalarsOn()
    reader.ReadAllVectorsOn()
    reader.Update()
    if reader.GetErrorCode() or not reader.GetOutput().GetNumberOfPoints():
        raise ValueError("it is no complete file of VTK; the file was cut, or has no points")
    writer.SetInputData(reader.GetOutput())
    writer.SetDataModeToBinary()
    writer.SetCompressorTypeToNone()
    writer.WriteToOutputStringOn()
    writer.Write()
    return writer.GetOutputString().encode()


def _convert_gltf(read: gltf_reader.GltfContent) -> MeshFileContent:
    cells = [("triangle", read.triangles), ("line", read.segments)]
    blocks = [(kind, data) for kind, data in cells if len(data)]
    return MeshFileContent(read.points, blocks, read.vertex_groups, {}, _number_faces(blocks))


def _convert_vtp(read: vtp_reader.VtpContent) -> MeshFileContent:
    """Convert VTP content, with faces grouped by their number of corners."""
    groups = dict[int, list[NDArray[np.int64]]]()
    for polygon in read.polygons:
        groups.setdefault(len(polygon), []).append(polygon)
    blocks = [(_CELL_KIND_BY_CORNERS.get(k, "polygon"), np.array(group)) for k, group in sorted(groups.items())]
    pairs = [np.column_stack([line[:-1], line[1:]]) for line in read.lines]
    if pairs:
        blocks.append(("line", np.concatenate(pairs)))
    pieces = [len(line) - 1 for line in read.lines]
    return MeshFileContent(
        read.points,
        blocks,
        {},
        _split_columns(read.point_attributes, len(read.points)),
        _number_faces(blocks),
        line_attributes={name: np.repeat(values, pieces) for name, values in read.line_attributes.items()},
    )


def _collect_line_attributes(raw: _MeshioMesh) -> dict[str, NDArray[np.float64]]:
    """Collect the cell data of the cells `line`: one number for each."""
    lines = [k for k, block in enumerate(raw.cells) if block.type == "line" and len(block.data)]
    found: dict[str, NDArray[np.float64]] = {}
    for name, blocks in raw.cell_data.items():
        values = [np.asarray(blocks[k]) for k in lines]
        if values and all(one.ndim == 1 and one.dtype.kind in "iufb" for one in values):
            found[name] = np.concatenate(values).astype(np.float64)
    return found


def _collect_groups(raw: _MeshioMesh) -> dict[str, NDArray[np.int64]]:
    """Collect the points of named point sets and cell sets, and of Gmsh's physical groups."""
    found: dict[str, list[NDArray[Any]]] = {name: [np.asarray(some)] for name, some in raw.point_sets.items()}
    for name, sets in raw.cell_sets.items():
        if name.startswith("gmsh:"):  # these list bounding entities, not cells
            continue
        for block, some in zip(raw.cells, sets, strict=True):
            if some is not None:
                found.setdefault(name, []).append(np.asarray(block.data)[np.asarray(some, np.int64)])
    for name, (tag, _) in raw.field_data.items():
        for block, tags in zip(raw.cells, raw.cell_data.get(_GMSH_PHYSICAL, []), strict=False):
            found.setdefault(name, []).append(np.asarray(block.data)[np.asarray(tags) == tag])
    joined = {name: np.unique(np.concatenate([x.ravel() for x in some])) for name, some in found.items() if some}
    return {name: points.astype(np.int64) for name, points in joined.items() if len(points)}


def _split_columns(numbers: dict[str, NDArray[Any]], n: int) -> dict[str, NDArray[np.float64]]:
    """Split point data of n points into columns."""
    found: dict[str, NDArray[np.float64]] = {}
    for name, values in numbers.items():
        if len(values) != n:
            continue
        columns = np.asarray(values, np.float64).reshape(n, -1).T
        found |= {name: columns[0]} if len(columns) == 1 else {f"{name}.{k}": x for k, x in enumerate(columns)}
    return {name: np.ascontiguousarray(column) for name, column in found.items()}


_GMSH_PARAMETRIC = re.compile(rb"^\$ParametricNodes\b", re.M)
