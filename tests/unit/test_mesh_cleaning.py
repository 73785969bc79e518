"""Meshes as people have them: units, the up axis, seams, unused vertices and degenerate faces."""

from __future__ import annotations

from pathlib import Path

import meshio
import numpy as np
import pytest
from pydantic import ValidationError
from springbench.harness.errors import InputError
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.mesh.file_mesh import FileMesh
from springbench.harness.scenes.mesh.mesh_cleaning import drop_degenerate_cells
from springbench.harness.scenes.mesh.spring_network import MeshCells

SQUARE = "v 0 0 0\nv 2 0 0\nv 2 3 0\nv 0 3 0\n"
SEAM = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 0 1e-7\nv 1 1 0\nv 0 1 0\ng left\nf 1 2 3\ng right\nf 4 5 6\n"


def obj(folder: Path, text: str, **options) -> FileMesh:
    """A model of an OBJ file with this text."""
    path = folder / "mesh.obj"
    path.write_text(text)
    return FileMesh(path=path, **options)


@pytest.mark.parametrize(
    ("options", "factor"),
    [({"scale": 0.001}, 0.001), ({"units": "mm"}, 0.001), ({"units": "in"}, 0.0254), ({"units": "m"}, 1.0), ({}, 1.0)],
)
def test_scale_and_units_give_metres(tmp_path, options, factor):
    mesh = obj(tmp_path, f"{SQUARE}f 1 2 3 4\n", **options).build_mesh()
    assert mesh.rest_positions.tolist() == (factor * np.array([[0, 0, 0], [2, 0, 0], [2, 3, 0], [0, 3, 0]])).tolist()
    assert mesh.vertex_areas is not None
    assert mesh.vertex_areas.sum() == pytest.approx(6 * factor**2, rel=1e-12)  # sums of four numbers


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z"])
def test_the_up_axis_becomes_y_by_a_rotation(tmp_path, up):
    text = "v 1 0 0\nv 0 1 0\nv 0 0 1\nv 0 0 0\nf 1 2 3\nf 1 2 4\n"
    axes = obj(tmp_path, text, up=up).build_mesh().rest_positions[:3]
    sign = -1 if up.startswith("-") else 1
    assert axes["xyz".index(up[-1])].tolist() == [0, sign, 0]
    assert np.linalg.det(axes) == 1


def test_a_seam_is_welded_with_its_groups_and_numbers(tmp_path):
    split = obj(tmp_path, SEAM).build_mesh()
    assert len(split.rest_positions) == 6
    mesh = obj(tmp_path, SEAM, weld=1e-6).build_mesh()
    assert mesh.rest_positions.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]
    assert mesh.springs.tolist() == [[0, 1], [0, 2], [1, 2], [1, 3], [2, 3]]
    assert {name: mesh.parts[name].tolist() for name in ("left", "right")} == {"left": [0, 1, 2], "right": [1, 2, 3]}
    assert mesh.format_file_numbers(3) == " (5 in the file)"
    assert len(obj(tmp_path, SEAM, weld=0).build_mesh().rest_positions) == 5  # one pair is apart by 1e-7


def test_what_welding_makes_degenerate_is_named_by_its_line(tmp_path):
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 1 1e-7\nf 1 2 3\nf 2 3 4\n"
    with pytest.raises(InputError, match="after welding, a face names a vertex twice") as caught:
        obj(tmp_path, text, weld=1e-6).build_mesh()
    assert caught.value.mistakes[0].line == 6
    assert len(obj(tmp_path, text, weld=1e-6, faces="drop-degenerate").build_mesh().triangles) == 1
    with pytest.raises(InputError, match=r"without any size|no cells"):
        obj(tmp_path, text, weld=2, faces="drop-degenerate").build_mesh()


@pytest.mark.parametrize(
    ("face", "joined"),
    [
        ("f 1 2 3 3", [[0, 1, 2]]),
        ("f 1 1 2 3", [[0, 1, 2]]),
        ("f 1 2 3 1", [[0, 1, 2]]),
        ("f 1 2 3 4 3", [[0, 1, 2]]),
        ("f 4 3 1 2 3", [[2, 0, 1]]),
        ("f 1 2 3 4 1 4", [[0, 1, 2, 3]]),
        ("f 1 2 1 2", []),
        ("f 1 2 2", []),
    ],
)
def test_repeated_corners_are_joined_or_the_face_is_dropped(tmp_path, caplog, face, joined):
    caplog.set_level("INFO")
    mesh = obj(tmp_path, f"{SQUARE}{face}\nf 1 3 4\n", faces="drop-degenerate").build_mesh()
    sides = {tuple(sorted((f[k - 1], f[k]))) for f in [*joined, [0, 2, 3]] for k in range(len(f))}
    assert mesh.springs.tolist() == sorted(map(list, sides))
    assert ("1 faces lost a repeated corner" if joined else "1 faces without area were dropped") in caplog.text
    with pytest.raises(InputError, match=r"names a vertex twice.*drop-degenerate"):
        obj(tmp_path, f"{SQUARE}{face}\nf 1 3 4\n").build_mesh()


def test_a_face_that_visits_a_vertex_twice_around_two_areas_is_no_degenerate_one(tmp_path):
    text = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv -1 0 0\nv -1 -1 0\nf 1 2 3 1 4 5\n"
    with pytest.raises(InputError, match="names a vertex twice"):
        obj(tmp_path, text, faces="drop-degenerate").build_mesh()


def test_faces_without_area_are_dropped_with_their_springs(tmp_path):
    text = f"{SQUARE}v 1 0 0\nf 1 2 3 4\nf 1 5 2\nl 5 5\n"
    mesh = obj(tmp_path, text, faces="drop-degenerate", unused="drop").build_mesh()
    assert len(mesh.rest_positions) == 4
    assert mesh.springs.tolist() == [[0, 1], [0, 3], [1, 2], [2, 3]]


def test_lines_without_length_are_dropped_with_their_cell_data():
    segments = np.array([[0, 1], [1, 1], [1, 2]])
    cells = MeshCells(np.eye(3), segments=segments, segment_attributes={"EA": np.array([1.0, 2.0, 3.0])})
    cleaned, _ = drop_degenerate_cells(cells)
    assert cleaned.segments.tolist() == [[0, 1], [1, 2]]
    assert cleaned.segment_attributes["EA"].tolist() == [1.0, 3.0]


def test_unused_vertices_stay_unless_they_are_dropped(tmp_path):
    text = f"v 9 9 9\n{SQUARE}f 2 3 4 5\n"
    assert len(obj(tmp_path, text).build_mesh().rest_positions) == 5
    mesh = obj(tmp_path, text, unused="drop").build_mesh()
    assert mesh.springs.tolist() == [[0, 1], [0, 3], [1, 2], [2, 3]]
    assert mesh.format_file_numbers(0) == " (2 in the file)"


def test_the_keys_apply_to_other_formats(tmp_path):
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 0, 1], [1, 0, 0], [1, 0, 1], [0, 0, 1], [7, 7, 7]], float)
    path = tmp_path / "mesh.vtu"
    meshio.Mesh(points, [("triangle", np.array([[0, 1, 2], [3, 4, 5]]))]).write(path)
    mesh = FileMesh(path=path, units="cm", up="z", weld=0, unused="drop").build_mesh()
    assert mesh.rest_positions.tolist() == [[0, 0, 0], [0.01, 0, 0], [0, 0.01, 0], [0.01, 0.01, 0]]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"scale": 0}, "scale"),
        ({"scale": 0.001, "units": "mm"}, "leave out one"),
        ({"units": "furlong"}, "units"),
        ({"up": "w"}, "up"),
        ({"weld": -1}, "weld"),
        ({"unused": "remove"}, "unused"),
        ({"faces": "repair"}, "faces"),
    ],
)
def test_impossible_values_are_refused(tmp_path, options, words):
    with pytest.raises(ValidationError, match=words):
        FileMesh(path=tmp_path / "mesh.obj", **options)


def test_a_scale_that_leaves_the_range_of_positions_is_refused(tmp_path):
    with pytest.raises(InputError, match="scale: gives coordinates above"):
        obj(tmp_path, "v 0 0 0\nv 1e6 0 0\nv 0 1 0\nf 1 2 3\n", scale=1e8).build_mesh()


def find_pins(mesh: FileMesh, **selectors) -> list[int]:
    """The vertices of a file's mesh that pins with these selectors select."""
    return PinsEffect.model_validate(selectors).select_vertices(mesh.build_mesh(), "pins").tolist()


def test_indices_count_the_vertices_that_are_left(tmp_path):
    spare = f"v 9 9 9\n{SEAM.replace('f 1 2 3', 'f 2 3 4').replace('f 4 5 6', 'f 5 6 7')}"
    mesh = obj(tmp_path, spare, weld=1e-6, unused="drop")
    (corner,) = find_pins(mesh, indices=[3])  # the sixth of the file: one before it is unused, one is joined
    assert mesh.build_mesh().rest_positions[corner].tolist() == [1, 1, 0]
    with pytest.raises(InputError, match=r"indices: got 4; the mesh has the vertices 0 to 3"):
        find_pins(mesh, indices=[4])


def test_regions_are_in_metres_with_y_up(tmp_path):
    mesh = obj(tmp_path, "v 0 0 0\nv 1000 0 0\nv 0 0 2000\nf 1 2 3\n", units="mm", up="z")
    assert find_pins(mesh, box={"low": [-0.1, 1.9, -0.1], "high": [0.1, 2.1, 0.1]}) == [2]
    assert find_pins(mesh, sphere={"center": [1, 0, 0], "radius": 0.1}) == [1]
    assert find_pins(mesh, nearest_to=[[0, 2, 0]]) == find_pins(mesh, parts=["top"]) == [2]


def test_a_side_of_the_bounding_box_has_only_the_vertices_on_it(tmp_path):
    mesh = obj(tmp_path, "v 0 0 0\nv 1 0.999 0\nv 0 1 0\nv 1 0.9999999 0\nf 1 2 3\nf 2 4 3\n")
    assert find_pins(mesh, parts=["top"]) == [2, 3]  # up to a millionth of the diagonal


def test_units_scale_coordinates_and_no_lengths_of_springs(tmp_path):
    (tmp_path / "springs.csv").write_text("i,j,rest_length\n0,1,0.9\n")
    text = "v 0 0 0\nv 0 0 0\nv 1000 0 0\nl 1 3\nl 2 3\n"
    mesh = obj(tmp_path, text, units="mm", weld=0, spring_table=tmp_path / "springs.csv", stiffness=5).build_mesh()
    assert mesh.spring_distances.tolist() == [1.0, 1.0]
    assert mesh.rest_lengths.tolist() == [0.9, 1.0]  # the row names vertices after welding


def test_a_selection_without_selectors_names_those_that_there_are():
    with pytest.raises(ValidationError, match=r"names no vertices; give parts, .* or stride") as caught:
        PinsEffect.model_validate({})
    named = str(caught.value).partition("give ")[2].partition(" [type")[0].replace(" or ", ", ").split(", ")
    assert set(named) <= set(PinsEffect.model_fields)
