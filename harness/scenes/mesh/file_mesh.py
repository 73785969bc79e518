"""Meshes from files: OBJ, the assignment's JSON scenes, PLY, VTP, glTF, and meshio's formats."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, NonNegativeFloat, model_validator
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.execution import sandbox
from springbench.harness.scenes.mesh.assignment_json import read_assignment_json
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.harness.scenes.mesh.mesh_cleaning import (
    METRES_PER_UNIT,
    CleaningOptions,
    FaceRule,
    LengthUnit,
    UnusedRule,
    UpAxis,
    clean_cells,
)
from springbench.harness.scenes.mesh.mesh_file_reader import FACE_KINDS, MeshFileContent, read_mesh_file
from springbench.harness.scenes.mesh.mesh_topology import NO_PAIRS, IndexArray
from springbench.harness.scenes.mesh.obj_reader import read_obj
from springbench.harness.scenes.mesh.spring_network import (
    MAX_COORDINATE,
    MeshCells,
    SpringRule,
    build_spring_network,
    check_mesh_file,
)
from springbench.harness.scenes.mesh.spring_values import (
    SpringValueKeys,
    find_springs,
    match_table_rows,
    spread_columns,
)
from springbench.harness.scenes.mesh.table_reader import read_data_table

_CELL_KINDS = ("line", *FACE_KINDS, "tetra")
"""Kinds of cells that yield springs; the kind `vertex` is ignored."""

MIN_READ_SECONDS, READ_BYTES_PER_SECOND = 5.0, 1e6
"""Time limit of reading: meshio reads text at 1 MB/s or more, and does not terminate on some broken files."""
MIN_READ_MEMORY, READ_MEMORY_PER_BYTE = 2**29, 20
"""Memory limit of reading [bytes]: Python lists, with numbers of two characters in the worst case."""


class FileMesh(SpringValueKeys):
    """A mesh from a file, of fixed size.

    Parts: the sides of its bounding box, and the groups named in the file. Attributes: point data of the file.
    """

    kind: Literal["file"] = "file"
    path: Path
    """Path of an OBJ, a JSON scene of the assignment (its OBJ is read), a PLY, STL, OFF, VTP or glTF, or a meshio
    format (VTK, Gmsh, Abaqus, ...)."""
    scale: Annotated[float, Field(ge=1e-9, le=1e9)] = 1.0
    """Metres per unit of the file's coordinates, 0.001 for millimetres."""
    units: LengthUnit | None = None
    """Unit of the file's coordinates, instead of `scale`; metres by default."""
    up: UpAxis = "y"
    """Axis of the file that points up; the mesh is rotated so that this axis becomes y."""
    weld: NonNegativeFloat | None = None
    """Distance [m], after scaling, up to which vertices become one, the first of them; 0 joins those in one place. By
    default none are joined."""
    unused: UnusedRule | None = None
    """Vertices without a face, line or tetrahedron; by default dropped, from Gmsh files alone, which contain points of
    the geometry."""
    faces: FaceRule = "strict"
    """Faces that name a vertex twice or have no area. `strict`: the former are errors, and the latter stay;
    `drop-degenerate`: repeated corners are joined, and faces without area are dropped."""
    spring_rule: SpringRule | None = None
    """Springs along `edges` of faces only, or between all corners of a face (`face-pairs`); by default face-pairs for
    JSON scenes, and edges for all other files."""
    spring_table: Path | None = None
    """CSV or Parquet table with values of springs: columns `i` and `j`, zero-based vertices, and columns of values.
    Without it the columns are the cell data of the file's lines."""

    def build_mesh(self, size: int = 0) -> Mesh:
        """Build the file's mesh, ignoring the size.

        Springs and masses are those of `springbench.harness.scenes.mesh.spring_network.build_spring_network`.

        Raises:
            InputError: for a file that is missing, malformed, empty or too large.
        """
        path = self.find_geometry_path()
        rule = self.spring_rule or ("face-pairs" if path is not self.path else "edges")
        cells = clean_cells(read_cells(path), self.build_cleaning_options(), path)
        return self._add_spring_properties(build_spring_network(cells, rule, path), cells)

    def _add_spring_properties(self, mesh: Mesh, cells: MeshCells) -> Mesh:
        """Add spring values from the table, or from the cell data of the file's lines."""
        columns, has_table = dict[str, NDArray[np.float64]](), self.spring_table is not None
        if self.spring_table is not None:
            table = read_data_table(self.spring_table)
            rows = match_table_rows(table, mesh.springs, len(mesh.rest_positions))
            columns = spread_columns(table.find_numeric_columns(), rows, len(mesh.springs))
        elif self.states_values:
            rows = find_springs(cells.segments, mesh.springs)
            named = {name: values[rows >= 0] for name, values in cells.segment_attributes.items()}
            columns = spread_columns(named, rows[rows >= 0], len(mesh.springs))
        else:
            return mesh
        properties = self.build_spring_properties(mesh.spring_distances, columns, reads_unnamed=has_table)
        return replace(mesh, spring_properties=properties)

    def find_geometry_path(self) -> Path:
        """Return the path of the geometry file: the OBJ file for a JSON scene."""
        if self.path.suffix.lower() != ".json":
            return self.path
        return self.path.parent / read_assignment_json(self.path).obj

    def build_cleaning_options(self) -> CleaningOptions:
        """Return the requested changes of the file's cells."""
        by_default = "drop" if self.path.suffix.lower() == ".msh" else "keep"
        scale = METRES_PER_UNIT[self.units] if self.units else self.scale
        return CleaningOptions(scale, self.up, self.weld, self.unused or by_default, self.faces)

    @model_validator(mode="after")
    def _check_scale(self) -> FileMesh:
        if self.units and "scale" in self.model_fields_set:
            raise ValueError("`units` and `scale` cannot be combined; leave out one of them")
        return self


def read_cells(path: Path) -> MeshCells:
    """Read the cells of a mesh file of any format, unmodified.

    Raises:
        InputError: for a file that is invalid or cannot be read.
    """
    return read_obj(path) if path.suffix.lower() == ".obj" else _read_other_cells(path)


def _read_other_cells(path: Path) -> MeshCells:
    """Read the cells of a file of any format but OBJ in a subprocess.

    Raises:
        InputError: for any failure, also of the subprocess.
    """
    check_mesh_file(path)
    state = path.stat()
    found = _read_cached(path, state.st_mtime_ns, state.st_size)
    points, blocks = found.points, found.cell_blocks
    problem = _find_cell_problem(points, blocks) or _find_group_problem(found)
    if problem:
        raise InputError(InputMistake(problem, path))
    polygons: dict[int, list[IndexArray]] = {}
    places: dict[int, list[IndexArray]] = {}
    for (kind, data), numbers in zip(blocks, found.face_locations, strict=True):
        if kind in FACE_KINDS:
            polygons.setdefault(data.shape[1], []).append(data)
            places.setdefault(data.shape[1], []).append(numbers)
    return MeshCells(
        points=np.pad(points, ((0, 0), (0, 3 - points.shape[1]))),
        polygons={corners: np.concatenate(polygons[corners]) for corners in sorted(polygons)},
        polygon_locations={corners: np.concatenate(places[corners]) for corners in sorted(places)},
        location_unit=found.location_unit,
        segments=np.concatenate([NO_PAIRS, *(data for kind, data in blocks if kind == "line")]),
        tetrahedra=np.concatenate([np.empty((0, 4), np.int64), *(data for kind, data in blocks if kind == "tetra")]),
        vertex_groups=found.vertex_groups,
        attributes=found.attributes,
        file_numbers=None if path.suffix.lower() == ".msh" else np.arange(len(points)),  # Gmsh numbers by tags
        segment_attributes=found.line_attributes,
    )


@lru_cache(maxsize=2)  # a scene builds its mesh several times, and a subprocess starts slowly
def _read_cached(path: Path, mtime_ns: int, size: int) -> MeshFileContent:
    """Read a mesh file, cached by path, modification time [ns] and size [bytes]."""
    limits = sandbox.CallLimits(
        MIN_READ_SECONDS + size / READ_BYTES_PER_SECOND, MIN_READ_MEMORY + READ_MEMORY_PER_BYTE * size
    )
    try:
        return sandbox.call_in_sandbox(read_mesh_file, path, limits=limits)
    except sandbox.SandboxError as error:
        raise InputError(InputMistake(f"cannot be read as a mesh: {error}", path)) from None


def _find_group_problem(found: MeshFileContent) -> str:
    """Describe what is wrong with the groups; empty if they are valid."""
    for name, group in found.vertex_groups.items():
        if group[0] < 0 or group[-1] >= len(found.points):
            return f"its group {name[:40]!r} names the point {group[-1]}; expected 0 to {len(found.points) - 1}"
    return ""


def _find_cell_problem(points: np.ndarray, blocks: list[tuple[str, IndexArray]]) -> str:
    """Describe what is wrong with the points and cells; empty if they are valid."""
    if points.ndim != 2 or not 1 <= points.shape[1] <= 3:
        return f"has points of shape {points.shape}; expected 1 to 3 coordinates each"
    if not np.all(np.abs(points) <= MAX_COORDINATE):
        row = int(np.flatnonzero(~np.all(np.abs(points) <= MAX_COORDINATE, axis=1))[0])
        return f"point {row} (from 0) is {points[row]}; expected finite numbers up to {MAX_COORDINATE:g} m"
    for kind, data in blocks:
        if kind not in _CELL_KINDS:
            return f"has cells of type {kind}; expected {', '.join(_CELL_KINDS)}"
        if data.ndim != 2 or data.shape[1] < 2:
            return f"has a {kind} of fewer than 2 points"
        ordered = np.sort(data, axis=1)
        wrong = (ordered[:, 0] < 0) | (ordered[:, -1] >= len(points))
        if wrong.any():
            cell = data[np.flatnonzero(wrong)[0]].tolist()
            return f"a {kind} names the points {cell}; expected numbers from 0 to {len(points) - 1}"
    return ""
