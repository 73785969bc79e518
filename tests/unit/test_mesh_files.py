"""Meshes from files: what becomes a spring, what is refused, and where the message points."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path

import meshio
import numpy as np
import pytest
from springbench.harness.errors import InputError
from springbench.harness.scenes.effects.gas_effect import GasEffect
from springbench.harness.scenes.mesh import spring_network as cells_module
from springbench.harness.scenes.mesh.file_mesh import FileMesh
from springbench.harness.scenes.mesh.mesh import SHEAR, STRETCH

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
SIDES = [[0, 1], [0, 3], [1, 2], [2, 3]]


def obj(folder: Path, text: str, **options) -> FileMesh:
    """A model of an OBJ file with this text."""
    path = folder / "mesh.obj"
    path.write_text(text)
    return FileMesh(path=path, **options)


@pytest.mark.parametrize(
    "face", ["f 1 2 3 4", "f 1/1 2/2 3/3 4/4", "f 1//1 2//1 3//1 4//1", "f 1/1/1 2/2/1 3/3/1 4/4/1", "f -4 -3 -2 -1"]
)
def test_every_form_of_a_vertex_token_names_the_same_face(tmp_path, face):
    mesh = obj(tmp_path, f"{SQUARE}vt 0 0\nvn 0 0 1\n{face}\n").build_mesh(99)
    assert mesh.springs.tolist() == SIDES
    assert mesh.triangles.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert (mesh.dimension, mesh.resolution, mesh.spacing, mesh.mass) == (2, 0, 1.0, None)


def test_a_quad_has_diagonals_only_between_face_pairs(tmp_path):
    mesh = obj(tmp_path, f"{SQUARE}f 1 2 3 4\n", spring_rule="face-pairs").build_mesh(0)
    assert mesh.springs[mesh.spring_families[STRETCH]].tolist() == SIDES
    assert mesh.springs[mesh.spring_families[SHEAR]].tolist() == [[0, 2], [1, 3]]


def test_a_side_of_one_face_is_no_diagonal_of_another(tmp_path):
    mesh = obj(tmp_path, f"{SQUARE}f 1 2 3 4\nf 1 2 3\n", spring_rule="face-pairs").build_mesh(0)
    assert mesh.springs[mesh.spring_families[STRETCH]].tolist() == [[0, 1], [0, 2], [0, 3], [1, 2], [2, 3]]
    assert mesh.springs[mesh.spring_families[SHEAR]].tolist() == [[1, 3]]


@pytest.mark.parametrize("lines", ["f 4 1\nf 2 3\nf 1 2\n", "l 4 1\nl 2 3\nl 1 2\n"])
def test_cells_of_two_vertices_are_springs_in_file_order(tmp_path, lines):
    mesh = obj(tmp_path, SQUARE + lines).build_mesh(0)
    assert mesh.springs.tolist() == [[3, 0], [1, 2], [0, 1]]
    assert mesh.dimension == 1
    assert mesh.mass_fractions == pytest.approx([1 / 3, 1 / 3, 1 / 6, 1 / 6])


def test_a_polyline_joins_each_vertex_to_the_next(tmp_path):
    assert obj(tmp_path, f"{SQUARE}l 1 2 3 4 1\n").build_mesh(0).springs.tolist() == [[0, 1], [1, 2], [2, 3], [3, 0]]


def test_a_rope_may_hang_on_a_face_and_carries_no_mass_of_its_own(tmp_path):
    mesh = obj(tmp_path, f"{SQUARE}v 2 2 0\nf 1 2 3 4\nl 3 5\n").build_mesh(0)
    assert [2, 4] in mesh.springs.tolist()
    assert mesh.mass_fractions[4] == 0
    assert mesh.mass_fractions.sum() == pytest.approx(1)


def test_comments_colours_groups_windows_line_ends_and_a_byte_order_mark_are_passed_over(tmp_path):
    path = tmp_path / "mesh.obj"
    path.write_bytes(
        b"\xef\xbb\xbf# a square\r\no square\r\nv 0 0 0 1 1 1 # red\r\nv 1e0 0 0\r\nv 0 1 0\r\n\r\nf 1 2 3\r\n"
    )
    assert len(FileMesh(path=path).build_mesh(0).springs) == 3


@pytest.mark.parametrize(
    "text",
    [
        "v 0 0 0\nv 1 0 0\nv 1 1 \\\n0\nv 0 1 0\nf 1 2 3 \\\n 4\n",
        "v 0 0 0\r\nv 1 \\\r\n0 0\r\nv 1 1 0\r\nv 0 1 0\r\nvt 0 \\\r\n1\r\nf 1 2 \\  \r\n 3 4\r\n",
        "v 0 0\\\n0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf\\\n1 2\\\n\\\n3 4\\",
        "# ends in \\\nv 0 0 0 # here too \\\nv 1 0 0\nv 1 1 0\nv 0 1 0\nl 1 2 \\\n3 4 1\nf 1 2 3 4\n",
    ],
    ids=["v and f", "windows and blanks", "glued and last", "comments"],
)
def test_a_backslash_continues_a_line_and_a_comment_ends_with_it(tmp_path, text):
    mesh = obj(tmp_path, text).build_mesh(0)
    assert mesh.rest_positions.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    assert mesh.springs.tolist() == SIDES


def test_a_mistake_in_a_continued_line_has_the_line_in_which_it_begins(tmp_path):
    with pytest.raises(InputError, match="vertex 9 does not exist") as caught:
        obj(tmp_path, SQUARE + "f 1 2 \\\n3 \\\n9\nl 1 2\n").build_mesh(0)
    assert caught.value.mistakes[0].line == 5


def test_messages_name_vertices_by_the_numbers_of_an_obj_too(tmp_path):
    mesh = obj(tmp_path, SQUARE + "f 1 2 3 4\n").build_mesh(0)
    assert mesh.format_file_numbers(0, 3) == " (1, 4 in the file)"
    with pytest.raises(InputError, match=r"from vertex 0 to 1 \(1, 2 in the file\)"):
        GasEffect(pressure=1.0).build_contribution(mesh, np.ones(4), 0.1)
    assert replace(mesh, file_numbers=None).format_file_numbers(0, 3) == ""


def test_parts_are_the_sides_of_the_bounding_box(tmp_path):
    parts = obj(tmp_path, f"{SQUARE}f 1 2 3 4\n").build_mesh(0).parts
    assert {name: parts[name].tolist() for name in ("left", "right", "bottom", "top")} == {
        "left": [0, 3],
        "right": [1, 2],
        "bottom": [0, 1],
        "top": [2, 3],
    }


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ("v 0 0\n", 1, "needs 3 coordinates"),
        ("v 0 0 zero\n", 1, "'zero' is no number"),
        ("v 0 0 1_0\n", 1, "'1_0' is no number"),
        ("v 0 0 nan\n", 1, "'nan' is no position"),
        ("\nv 0 inf 0\n", 2, "'inf' is no position"),
        ("v 0 0 1e300\n", 1, "up to 1e+12 m"),
        (f"{SQUARE}f 1 2 5\n", 5, "vertex 5 does not exist; the file has 4"),
        (f"{SQUARE}f 1 2 {10**40}\n", 5, "does not exist"),
        (f"{SQUARE}f 1 2 0\n", 5, "counted from 1"),
        (f"{SQUARE}f 1 2 -5\n", 5, "vertex -5 lies before the first"),
        (f"{SQUARE}f 1 2 x\n", 5, "'x' is no vertex"),
        (f"{SQUARE}f 1 2 1.5\n", 5, "'1.5' is no vertex"),
        (f"{SQUARE}f 1 2 2\n", 5, "names a vertex twice"),
        (f"{SQUARE}f 1\n", 5, "at least 2 vertices"),
        (f"{SQUARE}l 1 1\n", 5, "joins a vertex to itself"),
        (f"{SQUARE}l 1 7\n", 5, "vertex 7 does not exist"),
        (f"{SQUARE}face 1 2 3\n", 5, "unknown keyword 'face'"),
    ],
)
def test_mistakes_in_an_obj_come_with_their_line(tmp_path, text, line, words):
    with pytest.raises(InputError) as caught:
        obj(tmp_path, text).build_mesh(0)
    (mistake,) = caught.value.mistakes
    assert mistake.file == tmp_path / "mesh.obj"
    assert mistake.line == line
    assert words in mistake.problem


def test_all_mistakes_of_an_obj_come_at_once(tmp_path):
    with pytest.raises(InputError) as caught:
        obj(tmp_path, "v 0 0\nv a 0 0\nf 1 1\n").build_mesh(0)
    assert [mistake.line for mistake in caught.value.mistakes] == [1, 2, 3]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is empty"),
        ("# nothing\n", "no vertices"),
        (SQUARE, "no cells"),
        ("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "without any size"),
        ("v 1 1 1\nv 1 1 1\nf 1 2\n", "without any size"),
    ],
)
def test_a_mesh_of_nothing_is_refused(tmp_path, text, words):
    with pytest.raises(InputError, match=words):
        obj(tmp_path, text).build_mesh(0)


@pytest.mark.parametrize("name", ["missing.obj", "missing.ply", "missing.json", "folder.obj", "x" * 300, "a\0b.obj"])
def test_a_path_that_is_not_a_file_is_refused(tmp_path, name):
    (tmp_path / "folder.obj").mkdir()
    with pytest.raises(InputError, match="give the path"):
        FileMesh(path=tmp_path / name).build_mesh(0)


def test_a_huge_file_is_refused_unread(tmp_path):
    path = tmp_path / "huge.obj"
    with path.open("wb") as file:
        file.truncate(cells_module.MAX_FILE_BYTES + 1)  # sparse: it takes no space
    with pytest.raises(InputError, match="at most 1,073,741,824 are read"):
        FileMesh(path=path).build_mesh(0)


def test_a_face_of_very_many_corners_is_refused_before_its_pairs_are_listed(tmp_path):
    corners = 30_000  # 450 million pairs
    angle = np.linspace(0, 6, corners)
    points = "".join(f"v {x} {y} 0\n" for x, y in zip(np.cos(angle), np.sin(angle), strict=True))
    face = "f " + " ".join(map(str, range(1, corners + 1)))
    assert len(obj(tmp_path, points + face).build_mesh(0).springs) == corners
    with pytest.raises(InputError, match="pairs on faces"):
        obj(tmp_path, points + face, spring_rule="face-pairs").build_mesh(0)


@pytest.mark.parametrize("suffix", [".ply", ".stl", ".vtk", ".vtu", ".off", ".msh"])
def test_meshio_formats_give_the_sides_of_triangles(tmp_path, suffix):
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    path = tmp_path / f"mesh{suffix}"
    meshio.Mesh(points, [("triangle", np.array([[0, 1, 2], [0, 2, 3]]))]).write(path)
    mesh = FileMesh(path=path).build_mesh(0)
    assert len(mesh.rest_positions) == 4
    assert sorted(np.round(mesh.rest_lengths, 6)) == [1, 1, 1, 1, 1.414214]
    assert len(mesh.triangles) == 2


def test_lines_and_quads_of_meshio_become_springs(tmp_path):
    path = tmp_path / "mesh.vtu"
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 2, 0]], float)
    cells = {"quad": np.array([[0, 1, 2, 3]]), "line": np.array([[2, 4]]), "vertex": np.array([[0]])}
    meshio.Mesh(points, {**cells}).write(path)
    assert FileMesh(path=path).build_mesh(0).springs.tolist() == [[0, 1], [0, 3], [1, 2], [2, 3], [2, 4]]
    assert len(FileMesh(path=path, spring_rule="face-pairs").build_mesh(0).springs) == 7


@pytest.mark.parametrize("order", [[0, 1, 2, 3], [1, 0, 2, 3]], ids=["upright", "inverted"])
def test_tetrahedra_make_a_solid_whose_surface_faces_outwards(tmp_path, order):
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]], float)
    path = tmp_path / "mesh.vtu"
    meshio.Mesh(points, {"tetra": np.array([[0, 1, 2, 3], [2, 1, 3, 4]])[:, order]}).write(path)
    mesh = FileMesh(path=path).build_mesh(0)
    assert mesh.dimension == 3
    assert len(mesh.springs) == 9
    assert len(mesh.triangles) == 6
    a, b, c = (mesh.rest_positions[mesh.triangles[:, k]] for k in range(3))
    volume = np.einsum("ij,ij->", np.cross(a, b), c) / 6
    assert volume == pytest.approx(1 / 6 + 1 / 3)
    assert mesh.mass_fractions[0] == pytest.approx(1 / 6 / 4 / volume)
    sides = Counter(frozenset(p) for t in mesh.triangles.tolist() for p in ((t[0], t[1]), (t[1], t[2]), (t[2], t[0])))
    assert set(sides.values()) == {2}


@pytest.mark.parametrize("suffix", [".ply", ".stl", ".vtk", ".vtu", ".off", ".msh", ".xdmf", ".inp", ".nonsense", ""])
@pytest.mark.parametrize("content", [b"", b"rubbish\n\x00\xff 1 2 3\n", b"ply\nformat ascii 1.0\nend_header\n"])
def test_a_broken_file_is_refused_in_silence(tmp_path, capfd, suffix, content):
    path = tmp_path / f"mesh{suffix}"
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        FileMesh(path=path).build_mesh(0)
    assert caught.value.mistakes[0].file == path
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("points", "triangle", "words"),
    [
        ([[0, 0, 0], [1, 0, 0], [0, np.nan, 0]], [0, 1, 2], "point 2"),
        ([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [0, 1, 3], "numbers from 0 to 2"),
        ([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [0, 1, 1], "names a vertex twice"),
    ],
)
def test_impossible_cells_of_meshio_are_refused(tmp_path, points, triangle, words):
    path = tmp_path / "mesh.vtu"
    meshio.Mesh(np.array(points, float), [("triangle", np.array([triangle]))]).write(path)
    with pytest.raises(InputError, match=words):
        FileMesh(path=path).build_mesh(0)


def test_cells_that_no_springs_are_made_of_are_named(tmp_path):
    path = tmp_path / "mesh.vtu"
    cube = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    meshio.Mesh(cube, [("hexahedron", np.array([[0, 4, 6, 2, 1, 5, 7, 3]]))]).write(path)
    with pytest.raises(InputError, match="hexahedron; expected line, triangle, quad"):
        FileMesh(path=path).build_mesh(0)


def test_a_json_scene_stands_for_the_obj_it_names_with_face_pairs(tmp_path):
    (tmp_path / "deep").mkdir()
    obj(tmp_path / "deep", f"{SQUARE}f 1 2 3 4\n")
    path = tmp_path / "scene.json"
    path.write_text(json.dumps({"obj": "deep/mesh.obj", "k": 1, "b": [1]}))
    assert len(FileMesh(path=path).build_mesh(0).springs) == 6
    assert len(FileMesh(path=path, spring_rule="edges").build_mesh(0).springs) == 4
