"""VTP files in every form that VTK writes; OBJ files' groups and colours; groups of Gmsh."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import meshio
import numpy as np
import pytest
from springbench.harness.errors import InputError
from springbench.harness.scenes.mesh import vtp_reader
from springbench.harness.scenes.mesh.file_mesh import FileMesh
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
from vtkmodules.vtkCommonCore import vtkPoints
from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData
from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

MESH = GridMesh().build_mesh(5)
HEAT = np.arange(25) / 7


def cells(*corners: list[int]) -> vtkCellArray:
    made = vtkCellArray()
    ends = np.cumsum([0, *map(len, corners)])
    made.SetData(*(numpy_to_vtkIdTypeArray(x, deep=True) for x in (ends, np.concatenate(corners))))
    return made


def surface() -> vtkPolyData:
    data, points = vtkPolyData(), vtkPoints()
    points.SetData(numpy_to_vtk(MESH.rest_positions, deep=True))
    data.SetPoints(points)
    data.SetPolys(cells([0, 1, 6, 5], [1, 2, 7]))
    data.SetStrips(cells([10, 11, 15, 16, 20]))
    data.SetLines(cells([2, 3, 4]))
    heat = numpy_to_vtk(HEAT, deep=True)
    heat.SetName("heat")
    data.GetPointData().AddArray(heat)
    return data


def write_vtp(path: Path, mode: str, compressor: str, wide: bool) -> Path:
    writer = vtkXMLPolyDataWriter()
    writer.SetFileName(str(path))
    writer.SetInputData(surface())
    {"ascii": writer.SetDataModeToAscii, "binary": writer.SetDataModeToBinary}.get(mode, writer.SetDataModeToAppended)()
    writer.SetEncodeAppendedData(mode == "base64")
    getattr(writer, f"SetCompressorTypeTo{compressor}")()
    (writer.SetHeaderTypeToUInt64 if wide else writer.SetHeaderTypeToUInt32)()
    writer.Write()
    return path


@pytest.mark.parametrize("mode", ["ascii", "binary", "base64", "raw"])
def test_every_encoding_has_the_same_contents(tmp_path, mode):
    for compressor, wide in product(("None", "ZLib", "LZMA"), (False, True)):
        read = vtp_reader.read_vtp(write_vtp(tmp_path / "mesh.vtp", mode, compressor, wide).read_bytes())
        np.testing.assert_array_equal(read.points, MESH.rest_positions)
        corners = [polygon.tolist() for polygon in read.polygons]
        assert corners == [[0, 1, 6, 5], [1, 2, 7], [10, 11, 15], [11, 16, 15], [15, 16, 20]]
        assert [line.tolist() for line in read.lines] == [[2, 3, 4]]
        np.testing.assert_array_equal(read.point_attributes["heat"][:, 0], HEAT)


def test_it_becomes_a_mesh_and_what_was_cut_is_refused(tmp_path):
    path = write_vtp(tmp_path / "mesh.vtp", "raw", "None", wide=False)
    mesh = FileMesh(path=path).build_mesh()
    assert len(mesh.triangles) == 6
    np.testing.assert_array_equal(mesh.attributes["heat"], HEAT)
    whole = path.read_bytes()
    end = whole.rfind(b"</AppendedData>")
    path.write_bytes(whole[: end - 200])
    with pytest.raises(InputError, match=r"it does not end with </VTKFile>; the file was cut"):
        FileMesh(path=path).build_mesh()
    path.write_bytes(whole[: end - 200] + whole[end:])
    with pytest.raises(InputError, match=r"an array declares \d+ bytes, and \d+ are there; the file was cut"):
        FileMesh(path=path).build_mesh()
    path.write_bytes(whole.replace(b"vtkZLib", b"").replace(b'type="PolyData"', b'type="ImageData"'))
    with pytest.raises(InputError, match="contains ImageData; expected PolyData"):
        FileMesh(path=path).build_mesh()


def test_an_objs_groups_are_parts_and_its_colours_numbers(tmp_path):
    corners = ("0 0 0 1 0 0", "1 0 0 0 1 0", "1 1 0 0 0 1", "0 1 0 0 0 0.5")
    path = tmp_path / "mesh.obj"
    path.write_text("".join(f"v {x}\n" for x in corners) + "g cuff seam\nf 1 2 3\no left\nf 1 3 4\nl 2 4\n")
    mesh = FileMesh(path=path).build_mesh()
    assert {name: mesh.parts[name].tolist() for name in ("cuff", "seam", "left", "right")} == {
        "cuff": [0, 1, 2],
        "seam": [0, 1, 2],
        "left": [0, 1, 2, 3],  # as the file names it, not the side of the box
        "right": [1, 2],
    }
    assert mesh.attributes["blue"].tolist() == [0.0, 0.0, 1.0, 0.5]


def test_groups_of_gmsh_are_parts(tmp_path):
    one = [("triangle", MESH.triangles[:4]), ("line", np.array([[0, 1], [1, 2]]))]
    made = meshio.Mesh(
        MESH.rest_positions,
        one,
        cell_data={"gmsh:physical": [np.full(4, 2), np.array([1, 7])], "gmsh:geometrical": [np.ones(4, int), [1, 1]]},
        field_data={"collar": np.array([1, 1]), "panel": np.array([2, 2])},
    )
    meshio.write(tmp_path / "mesh.msh", made, file_format="gmsh22", binary=False)
    mesh = FileMesh(path=tmp_path / "mesh.msh").build_mesh()
    np.testing.assert_array_equal(mesh.rest_positions[mesh.parts["collar"]], MESH.rest_positions[[0, 1]])
    np.testing.assert_array_equal(
        mesh.rest_positions[mesh.parts["panel"]], MESH.rest_positions[np.unique(MESH.triangles[:4])]
    )
