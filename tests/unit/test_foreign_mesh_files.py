"""Mesh files as other programs write them: PLY of any properties, Gmsh without groups, and what only has their name."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
from springbench.harness.errors import InputError
from springbench.harness.experiments.archive.archive_unpacking import unpack_archive
from springbench.harness.experiments.grading.position_files import read_position_file
from springbench.harness.recording.recording_reader import read_replay
from springbench.harness.results import parquet_rows
from springbench.harness.scenes.mesh import file_truncation, ply_reader
from springbench.harness.scenes.mesh.file_mesh import FileMesh, read_cells
from springbench.harness.schema.yaml_loader import read_yaml

XYZ = "property float x\nproperty float y\nproperty float z\n"
CORNERS = "property list uchar int vertex_indices\n"
SQUARE = "0 0 0\n1 0 0\n1 1 0\n0 1 0\n"
POINTS = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]

TEXTS = {
    "a number behind the corners": (CORNERS + "property uchar red\n", "", "4 0 1 2 3 255\n", ""),
    "a number before them": ("property uchar flags\n" + CORNERS, "", "1 4 0 1 2 3\n", ""),
    "another list before them": (f"property list uchar float texcoord\n{CORNERS}", "", "2 .5 .5 4 0 1 2 3\n", ""),
    "a list and numbers behind": (
        CORNERS + "property list uchar float texcoord\nproperty int a\nproperty double b\n",
        "",
        "4 0 1 2 3 2 .5 .5 7 8e-3\n",
        "",
    ),
    "edges behind": (CORNERS, "element edge 1\nproperty int vertex1\nproperty int vertex2\n", "4 0 1 2 3\n", "0 2\n"),
    "lists of no length": (CORNERS + "property list uchar int none\n", "", "4 0 1 2 3 0\n", ""),
    "the other name of the corners": (CORNERS.replace("indices", "index"), "", "4 0 1 2 3\n", ""),
}


def text(face: str, other: str, rows: str, others: str) -> bytes:
    """A PLY of a square in text."""
    head = f"ply\nformat ascii 1.0\ncomment by hand\nelement vertex 4\n{XYZ}element face 1\n{face}{other}end_header\n"
    return (head + SQUARE + rows + others).encode()


@pytest.mark.parametrize("case", TEXTS)
def test_other_properties_and_elements_of_a_ply_are_skipped(case):
    found = ply_reader.read_ply(text(*TEXTS[case]))
    assert found.points.tolist() == [list(point) for point in POINTS]
    assert {k: rows.tolist() for k, (rows, _) in found.faces.items()} == {4: [[0, 1, 2, 3]]}
    assert not found.vertex_attributes


@pytest.mark.parametrize("order", ["<", ">"], ids=["little", "big"])
@pytest.mark.parametrize("mixed", [False, True])
def test_a_binary_ply_of_any_properties_is_read(order, mixed):
    name = {"<": "little", ">": "big"}[order]
    head = (
        f"ply\r\nformat binary_{name}_endian 1.0\r\nelement camera 1\r\nproperty list uint8 short view\r\n"
        "element vertex 4\r\nproperty double x\r\nproperty uchar red\r\nproperty double y\r\nproperty double z\r\n"
        "element face 2\r\nproperty char flag\r\nproperty list ushort uint vertex_index\r\n"
        "property list uchar double texcoord\r\nelement edge 1\r\nproperty int a\r\nproperty int b\r\nend_header\r\n"
    )
    body = struct.pack(order + "B2h", 2, -5, 5)
    body += b"".join(struct.pack(order + "dBdd", x, 200 + i, y, z) for i, (x, y, z) in enumerate(POINTS))
    faces = [(0, 1, 2), (0, 2, 3)] if not mixed else [(0, 1, 2, 3), (1, 2, 3)]
    for i, face in enumerate(faces):
        coordinates = (0.5,) * (2 * i if mixed else 2)
        body += struct.pack(f"{order}bH{len(face)}I", -1, len(face), *face)
        body += struct.pack(f"{order}B{len(coordinates)}d", len(coordinates), *coordinates)
    found = ply_reader.read_ply(head.encode() + body + struct.pack(order + "2i", 0, 2))
    assert found.points.tolist() == [list(point) for point in POINTS]
    assert found.vertex_attributes["red"].tolist() == [200, 201, 202, 203]
    rows = {k: (rows.tolist(), which.tolist()) for k, (rows, which) in found.faces.items()}
    expected = {3: ([[1, 2, 3]], [1]), 4: ([[0, 1, 2, 3]], [0])}
    assert rows == (expected if mixed else {3: ([[0, 1, 2], [0, 2, 3]], [0, 1])})


def test_a_ply_gives_a_mesh_with_its_numbers_in_double_precision(tmp_path):
    path = tmp_path / "mesh.ply"
    content = text(*TEXTS["a number behind the corners"]).replace(b"float z\n", b"float z\nproperty float heat\n")
    for i, (x, y, z) in enumerate(POINTS):
        content = content.replace(f"\n{x} {y} {z}\n".encode(), f"\n{x} {y} {z} {i}.1\n".encode())
    path.write_bytes(content)
    mesh = FileMesh(path=path).build_mesh()
    assert mesh.springs.tolist() == [[0, 1], [0, 3], [1, 2], [2, 3]]
    assert mesh.attributes["heat"].tolist() == [0.1, 1.1, 2.1, 3.1]


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        (b"uchar int vertex_indices", b"uchar int corners", "no list vertex_indices or vertex_index"),
        (b"property float y", b"property float u", "have no y"),
        (b"property float x", b"property half x", "the line 'property half x'"),
        (b"format ascii 1.0\n", b"", "names no format"),
        (b"element face 1", b"element face 2", "declares 2 rows of face"),
        (b"4 0 1 2 3", b"4 0 1 2.5 3", "the vertex 2.5; expected a whole number"),
        (b"4 0 1 2 3", b"-4 0 1 2 3", "the length -4"),
        (b"4 0 1 2 3", b"4 0 1 two 3", "is no number"),
        (b"4 0 1 2 3", b"9 0 1 2 3", "fewer follow"),
        (b"end_header", b"the_end", "no head from `ply` to `end_header`"),
    ],
)
def test_a_broken_ply_is_refused_with_the_reason(before, after, words):
    content = text(CORNERS, "", "4 0 1 2 3\n", "")
    with pytest.raises(ValueError, match=words.replace(".", r"\.")):
        ply_reader.read_ply(content.replace(before, after))


MSH = """$MeshFormat
4.1 0 8
$EndMeshFormat
$PhysicalNames
2
1 1 "rim"
2 2 "sheet"
$EndPhysicalNames
$Entities
1 1 2 0
7 9 9 9 0
1 0 0 0 0 1 0 1 1 0
1 0 0 0 1 1 0 {sheet} 4 1 2 3 4
2 0 0 0 1 1 0 0 0
$EndEntities
$Nodes
2 5 1 5
0 7 0 1
5
9 9 9
2 1 {parametric} 4
1
2
3
4
0 0 0
1 0 0
1 1 0
0 1 0
$EndNodes
$Elements
4 4 1 4
0 7 15 1
1 5
1 1 1 1
2 1 2
2 1 2 1
3 1 2 3
2 2 2 1
4 1 3 4
$EndElements
"""


def gmsh(folder: Path, **changes: str) -> Path:
    """Two triangles, each on a surface of its own, a line, and the point of a geometry."""
    path = folder / "mesh.msh"
    path.write_text(MSH.format(**{"sheet": "1 2", "parametric": "0"} | changes))
    return path


@pytest.mark.parametrize(
    ("sheet", "groups"),
    [
        ("1 2", {"rim": [0, 1], "sheet": [0, 1, 2]}),
        ("0", {"rim": [0, 1]}),
        ("2 2 1", {"rim": [0, 1], "sheet": [0, 1, 2]}),
    ],
    ids=["some", "one", "two of one surface"],
)
def test_gmshs_entities_without_a_group_are_read_and_stray_points_left_out(tmp_path, caplog, sheet, groups):
    mesh = FileMesh(path=gmsh(tmp_path, sheet=sheet)).build_mesh()
    assert (len(mesh.rest_positions), len(mesh.springs), len(mesh.triangles)) == (4, 5, 2)
    sides = ("left", "right", "bottom", "top", "back", "front")
    assert {name: part.tolist() for name, part in mesh.parts.items() if name not in sides} == groups
    assert "1 points belong to no cell and are left out: at (9, 9, 9) m" in caplog.messages[0]


def test_gmshs_parametric_nodes_are_refused_by_name(tmp_path):
    path = gmsh(tmp_path, parametric="1")
    with pytest.raises(InputError, match="parametric nodes"):
        FileMesh(path=path).build_mesh()
    nodes = "$ParametricNodes\n3\n1 0 0 0 0 1\n2 1 0 0 0 2\n3 1 1 0 0 3\n$EndParametricNodes\n"
    path.write_text(f"$MeshFormat\n2.2 0 8\n$EndMeshFormat\n{nodes}$Elements\n1\n1 2 2 1 1 1 2 3\n$EndElements\n")
    with pytest.raises(InputError, match="parametric nodes; save it without them"):
        FileMesh(path=path).build_mesh()


STAND_INS = {
    "a pointer": (
        b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n",
        "Git LFS pointer.*git lfs pull",
    ),
    "a page": (b"\n<!DOCTYPE HTML>\n<html><body>404</body></html>\n", "is a web page"),
    "a page without a type": (b"\xef\xbb\xbf<HTML lang=en>", "is a web page"),
    "nothing": (b"", "is empty"),
    "blanks": (b" \r\n\t\n", "is empty"),
}


@pytest.mark.parametrize(
    "name", ["mesh.obj", "mesh.ply", "mesh.stl", "mesh.vtk", "mesh.vtp", "mesh.msh", "mesh.json", "x.yaml"]
)
@pytest.mark.parametrize("case", STAND_INS)
def test_a_folder_or_device_in_place_of_a_file_is_named(tmp_path, name, case):
    content, words = STAND_INS[case]
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(InputError, match=words):
        read_yaml(path) if name == "x.yaml" else FileMesh(path=path).build_mesh()


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("mesh.vtk", b"# vtk DataFile Version 1.0\n", "VTK data type"),
        ("mesh.off", b"OFF BINARY\n", "binary OFF file"),
        ("mesh.msh", b"$MeshFormat\n2.2 7 8\n$EndMeshFormat\n$Elements\n$EndElements\n", "msh"),
    ],
)
def test_the_reason_that_a_reader_prints_is_in_the_message(tmp_path, name, content, words):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(InputError, match=f"cannot be read as a mesh: .*({words})"):
        FileMesh(path=path).build_mesh()


@pytest.mark.parametrize(
    ("config", "line", "words"),
    [
        (
            "mass: 1\ndescription: Net: 10 x 10\n",
            2,
            'value of `description` contains.*description: "Net: 10 x 10"',
        ),
        ("mesh: {kind: file, path: a: b.obj}\n", 1, 'value of `path` contains a colon.*path: "a: b.obj"'),
        ("effects:\n  - kind: pins: all\n", 2, 'value of `kind` contains a colon.*kind: "pins: all"'),
        ('description: say "x": y\n', 1, "'say \"x\": y'"),
        ("mass: 1\n  frames: 2\n", 2, "same indent"),
        ("description: @me\n", 1, "cannot begin with '@'; put the value in quotes"),
    ],
)
def test_a_colon_without_quotes_is_named_with_what_to_quote(tmp_path, config, line, words):
    path = tmp_path / "scene.yaml"
    path.write_text(config)
    with pytest.raises(InputError, match=words) as caught:
        read_yaml(path)
    assert caught.value.mistakes[0].line == line


def test_text_is_read_as_float64_and_not_as_the_declared_type():
    found = ply_reader.read_ply(text(CORNERS, "", "4 0 1 2 3\n", "").replace(b"1 1 0\n", b"1 0.1 0\n"))
    assert np.array_equal(found.points[2], [1, 0.1, 0])


PLANE = np.stack(np.meshgrid([0.0, 0.5, 1.0], [0.0, 1.0], [0.25]), -1).reshape(-1, 3)
FACES = np.array([[0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4]])
LEGACY_POLYDATA = b"# vtk DataFile Version 3.0\nx\nBINARY\nDATASET POLYDATA\nPOINTS 3 float\n" + b"".join(
    (struct.pack(">9f", 0, 0, 0, 1, 0, 0, 0, 1, 0), b"\nPOLYGONS 1 4\n", struct.pack(">4i", 3, 0, 1, 2))
)
WRITER_OPTIONS = {
    "text.stl": {"binary": False},
    "binary.stl": {"binary": True},
    "text.vtk": {"binary": False, "file_format": "vtk"},
    "binary.vtk": {"binary": True, "file_format": "vtk"},
    "old.vtk": {"binary": True, "file_format": "vtk42"},
    "text.vtu": {"binary": False},
    "packed.vtu": {"binary": True},
    "text22.msh": {"file_format": "gmsh22", "binary": False},
    "binary22.msh": {"file_format": "gmsh22", "binary": True},
    "text41.msh": {"file_format": "gmsh", "binary": False},
    "binary41.msh": {"file_format": "gmsh", "binary": True},
    "mesh.off": {},
    "mesh.mesh": {},
}


def cut_copies(path: Path) -> Iterator[Path]:
    """Copies of a file that end in its second quarter, its third one, and in its last word."""
    content = path.read_bytes()
    for n in (len(content) * 2 // 5, len(content) * 3 // 5, len(content.rstrip()) - 1):
        short = path.with_stem(f"cut-{n}")
        short.write_bytes(content[:n])
        yield short


@pytest.mark.parametrize("name", WRITER_OPTIONS)
@pytest.mark.filterwarnings("ignore")
def test_a_cut_file_is_reported_as_cut(tmp_path, name):
    path = tmp_path / name
    mesh = meshio.Mesh(PLANE, [("triangle", FACES.astype(np.int32))])
    meshio.write(path, mesh, **WRITER_OPTIONS[name])
    assert len(FileMesh(path=path).build_mesh().triangles) == 4
    for short in cut_copies(path):
        with pytest.raises(InputError, match=r"was (the file )?cut"):
            FileMesh(path=short).build_mesh()


def test_a_cut_legacy_vtk_file_of_surfaces_is_not_completed_by_arbitrary_numbers():
    assert file_truncation.find_strict_truncation(".vtk", LEGACY_POLYDATA) == ""
    for n, section in ((4, "POLYGONS declares 4"), (20, "POLYGONS"), (31, "POINTS declares 9")):
        assert section in file_truncation.find_strict_truncation(".vtk", LEGACY_POLYDATA[:-n])
    attributes = LEGACY_POLYDATA + b"\nPOINT_DATA 3\nSCALARS load float 1\nLOOKUP_TABLE default\n" + bytes(12)
    assert file_truncation.find_strict_truncation(".vtk", attributes) == ""
    assert "SCALARS declares 3" in file_truncation.find_strict_truncation(".vtk", attributes[:-1])


@pytest.mark.parametrize("text", ["v 0 0 0\nv 1 0 0\nv 1", "v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1"])
def test_a_cut_obj_is_reported_to_end_within_a_line(tmp_path, text):
    path = tmp_path / "cut.obj"
    path.write_text(text)
    with pytest.raises(InputError, match="ends within this line: was it cut"):
        FileMesh(path=path).build_mesh()
    path.write_text(text + "\n")
    with pytest.raises(InputError) as caught:
        FileMesh(path=path).build_mesh()
    assert "was it cut" not in str(caught.value)


def test_a_cut_json_scene_is_reported_as_cut(tmp_path):
    path = tmp_path / "scene.json"
    path.write_text('{"obj": "mesh.obj", "k": 1, "b": [1, 2')
    with pytest.raises(InputError, match="does not end with }: was it cut"):
        FileMesh(path=path).build_mesh()


READERS = {
    "run.rrd": read_replay,
    "rows/run.parquet": lambda path: parquet_rows.read_rows([path]),
    "results.zip": lambda path: unpack_archive(path).__enter__(),
    "frames/0.ply": lambda path: read_position_file(path.parent, 3),
}


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("case", ["a pointer", "a page"])
def test_readers_of_results_name_what_stands_in_place_of_a_file(tmp_path, name, case):
    content, words = STAND_INS[case]
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(content)
    with pytest.raises(InputError, match=words):
        READERS[name](path)


FACETS = struct.pack("<12fH", 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 7) + struct.pack(
    "<12fH", 0, 0, 1, 1, 0, 0, 1, 1, 0, 0, 1, 0, 0
)
TEXT_STL = b"solid a b\n" + b"".join(
    b"facet normal 0 0 1\nouter loop\n%bendloop\nendfacet\n" % corners
    for corners in (
        b"vertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\n",
        b"vertex 1 0 0\n vertex 1.0e0 1 0\nvertex 0 1 -0\n",
    )
)
COLOURED_OFF = b"COFF\n4 2 5\n0 0 0 .1 .2 .3 1\n1 0 0 0 0 0 1\n1 1 0 0 0 0 1\n0 1 0 0 0 0 1\n3 0 1 3 255 0 0\n3 1 2 3\n"
FILES_IN_PRACTICE = {
    "a-text-header.stl": b"solid but binary".ljust(80) + struct.pack("<I", 2) + FACETS,
    "bytes-behind.stl": bytes(80) + struct.pack("<I", 2) + FACETS + b"\0\0\r\n",
    "capitals.stl": (TEXT_STL + b"endsolid a b\n").upper(),
    "two-solids.stl": (TEXT_STL + b"endsolid\n").replace(b"endfacet\n", b"endfacet\nendsolid\nsolid\n", 1),
    "windows.stl": (TEXT_STL + b"endsolid").replace(b"\n", b"\r\n"),
    "comments.off": b"OFF\n# c\n\n4 2 0\n0 0 0\n1 0 0 # x\n1 1 0\n0 1 0\n3 0 1 3\n3 1 2 3\n",
    "colours.off": COLOURED_OFF,
    "one-line.off": b"OFF 4 2 5\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 3\n3 1 2 3",
    "no-keyword.off": b"4 2 5\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 3\n3 1 2 3\n",
}


@pytest.mark.parametrize("name", FILES_IN_PRACTICE)
def test_stl_and_off_files_of_practice_are_read(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(FILES_IN_PRACTICE[name])
    mesh = FileMesh(path=path).build_mesh()
    assert len(mesh.rest_positions) == 4
    assert len(mesh.triangles) == 2
    assert mesh.surface_area == 1.0


def test_an_off_file_has_polygons_of_any_number_of_corners(tmp_path):
    path = tmp_path / "house.off"
    path.write_bytes(b"OFF\n6 2 0\n0 0 0\n1 0 0\n1 1 0\n.5 2 0\n0 1 0\n2 0 0\n5 0 1 2 3 4\n3 1 5 2\n")
    assert len(FileMesh(path=path).build_mesh().springs) == 7
    path.write_bytes(path.read_bytes().replace(b"3 1 5 2", b"3 1 5 9"))
    with pytest.raises(InputError, match=r"names the points \[1, 5, 9\]"):
        FileMesh(path=path).build_mesh()


@pytest.mark.parametrize("suffix", [".stl", ".off"])
def test_stl_and_off_files_have_the_vertices_that_meshio_gives_them(tmp_path, suffix):
    path = tmp_path / f"mesh{suffix}"
    points = np.random.default_rng(1).normal(size=(20, 3)).astype(np.float32)
    triangles = np.random.default_rng(2).permuted(np.tile(np.arange(20), (30, 1)), axis=1)[:, :3]
    options: dict[str, Any] = {"binary": True} if suffix == ".stl" else {}
    meshio.write(path, meshio.Mesh(points, [("triangle", triangles)]), **options)
    known, found = meshio.read(path), read_cells(path)
    np.testing.assert_array_equal(found.points, known.points)
    np.testing.assert_array_equal(found.polygons[3], known.cells_dict["triangle"])
