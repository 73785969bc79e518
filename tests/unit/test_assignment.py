"""Scenes of the Toronto assignment: springs, masses, pins, and messages for mistakes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from springbench.harness.errors import InputError
from springbench.harness.scenes.assignment_scene import (
    ASSIGNMENT_FORCE,
    ASSIGNMENT_ITERATIONS,
    ASSIGNMENT_PIN_WEIGHT,
    ASSIGNMENT_TIME_STEP,
    compute_voronoi_areas,
    read_assignment_scene,
)

SCENES = Path(__file__).resolve().parents[3] / "shared" / "scenes"
SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n"
CHAIN = "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 3 2\nf 1 2\n"


def scene(folder: Path, mesh: str = SQUARE, **changes) -> Path:
    """A scene file; a change to None removes the key."""
    (folder / "mesh.obj").write_text(mesh)
    data = {"obj": "mesh.obj", "k": 500, "m": 1, "b": [1]} | changes
    path = folder / "scene.json"
    path.write_text(json.dumps({key: value for key, value in data.items() if value is not None}, indent=1))
    return path


@pytest.mark.parametrize(
    ("name", "vertices", "springs", "k", "pins", "mass"),
    [
        ("single-spring-horizontal", 2, 1, 500, 1, 2),
        ("horizontal-chain", 10, 9, 500, 2, 10),
        ("net", 61, 156, 300, 6, 61),
        ("flag", 3200, 12442, 1e5, 40, 2.0),
    ],
)
def test_the_published_scenes_have_their_published_totals(name, vertices, springs, k, pins, mass):
    path = SCENES / f"{name}.json"
    if not path.exists():
        pytest.skip("the assignment's scenes are not part of this repository")
    came = read_assignment_scene(path)
    assert came.mesh.mass is not None
    assert (len(came.mesh.rest_positions), len(came.mesh.springs)) == (vertices, springs)
    assert (came.stiffness, len(came.pinned_vertices)) == (k, pins)
    assert came.mesh.mass.sum() == pytest.approx(mass, rel=1e-6)  # the flag's area is 2 in the OBJ's digits


def test_the_constants_are_the_assignments():
    assert (ASSIGNMENT_TIME_STEP, ASSIGNMENT_ITERATIONS, ASSIGNMENT_PIN_WEIGHT, ASSIGNMENT_FORCE) == (
        1 / 30,
        50,
        1e10,
        (0.0, -9.8, 0.0),
    )


def test_lines_of_two_vertices_are_springs_in_file_order(tmp_path):
    came = read_assignment_scene(scene(tmp_path, CHAIN, m=0.5))
    assert came.mesh.springs.tolist() == [[2, 1], [0, 1]]
    assert came.mesh.mass is not None
    assert came.mesh.mass.tolist() == [0.5, 0.5, 0.5]
    assert came.mesh.mass_fractions == pytest.approx([1 / 3] * 3)
    assert came.obj_path == tmp_path / "mesh.obj"


def test_a_quad_gives_its_sides_and_both_diagonals(tmp_path):
    came = read_assignment_scene(scene(tmp_path))
    assert sorted(came.mesh.springs.tolist()) == [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]


def test_a_line_among_faces_counts_as_a_pair_and_polylines_do_not(tmp_path):
    came = read_assignment_scene(scene(tmp_path, f"{SQUARE}v 2 0 0\nv 3 0 0\nf 2 5\nl 5 6\n"))
    assert [1, 4] in came.mesh.springs.tolist()
    assert [4, 5] not in came.mesh.springs.tolist()


def test_pins_count_from_one(tmp_path):
    assert read_assignment_scene(scene(tmp_path, b=[4, 1])).pinned_vertices.tolist() == [3, 0]


def test_a_repeated_face_weighs_once(tmp_path, caplog):
    mass = read_assignment_scene(scene(tmp_path, SQUARE + "f 2 3 4 1\n", m=None)).mesh.mass
    assert mass == pytest.approx([0.25] * 4)
    assert "6 repeats 5" in caplog.messages[0]


def test_the_mass_of_a_right_triangulated_square_is_its_voronoi_area(tmp_path):
    mass = read_assignment_scene(scene(tmp_path, m=None)).mesh.mass
    assert mass == pytest.approx([0.25] * 4)  # barycentric lumping would give 1/3, 1/6, 1/3, 1/6


@pytest.mark.parametrize(
    ("corners", "areas"),
    [
        ([(0, 0, 0), (1, 0, 0), (0.5, 3**0.5 / 2, 0)], [3**0.5 / 12] * 3),
        ([(0, 0, 0), (4, 0, 0), (1, 1, 0)], [0.5, 0.5, 1.0]),
        ([(0, 0, 0), (4, 0, 0), (2, 4, 0)], [2.75, 2.75, 2.5]),
        ([(0, 0, 0), (1, 0, 0), (2, 0, 0)], [0, 0, 0]),
    ],
    ids=["equilateral", "obtuse", "acute", "flat"],
)
def test_mixed_voronoi_areas_of_a_triangle(corners, areas):
    # acute: the centre of the circle through the corners is (2, 1.5), its radius 2.5; the top corner owns two
    # right triangles with legs sqrt(5), half a side, and sqrt(2.5^2 - 5): 2.5 of the area 8, the others half the rest
    rest = np.array(corners, float)
    assert compute_voronoi_areas(rest, np.array([[0, 1, 2]])) == pytest.approx(areas)
    for order in ([1, 2, 0], [2, 1, 0]):
        assert compute_voronoi_areas(rest, np.array([order])) == pytest.approx(areas)


def test_vertices_that_no_face_uses_stay_without_mass(tmp_path):
    came = read_assignment_scene(scene(tmp_path, f"v 9 9 9\n{SQUARE.replace('f 1 2 3 4', 'f 2 3 4 5')}", m=None))
    assert len(came.mesh.rest_positions) == 5
    assert came.mesh.mass == pytest.approx([0, 0.25, 0.25, 0.25, 0.25])


@pytest.mark.parametrize(
    ("changes", "key", "words"),
    [
        ({"obj": None}, "obj", "is missing: Path of the OBJ file"),
        ({"k": None}, "k", "is missing: Stiffness"),
        ({"b": None}, "b", "is missing: Pinned"),
        ({"bc": [[0, 0, 0]]}, "bc", "unknown key; expected one of b, k, m, obj, png"),
        ({"objs": 1}, "objs", "did you mean 'obj'?"),
        ({"obj": 3}, "obj", "string"),
        ({"k": "500"}, "k", "number"),
        ({"k": True}, "k", "number"),
        ({"k": -1}, "k", "greater than or equal to 0"),
        ({"k": float("nan")}, "k", "finite"),
        ({"k": float("inf")}, "k", "finite"),
        ({"m": 0}, "m", "greater than 0"),
        ({"m": [1, 1]}, "m", "number"),
        ({"m": True}, "m", "number"),
        ({"b": 1}, "b", "list"),
        ({"b": [True]}, "b.0", "integer"),
        ({"b": [1, 1.5]}, "b.1", "integer"),
        ({"b": [1, 0]}, "b.1", "counted from 1 to 4"),
        ({"b": [5]}, "b.0", "counted from 1 to 4"),
        ({"b": [10**30]}, "b.0", "counted from 1 to 4"),
        ({"b": [2, 3, 2]}, "b.2", "pinned twice"),
    ],
)
def test_mistakes_in_a_scene_come_with_file_line_and_key(tmp_path, changes, key, words):
    path = scene(tmp_path, **changes)
    with pytest.raises(InputError) as caught:
        read_assignment_scene(path)
    (mistake,) = caught.value.mistakes
    assert (mistake.file, mistake.key) == (path, key)
    assert words in mistake.problem
    name = key.split(".")[0]
    if f'"{name}"' in path.read_text():
        assert mistake.line is not None
        assert f'"{name}"' in path.read_text().splitlines()[mistake.line - 1]


def test_masses_cannot_be_taken_from_a_mesh_without_area(tmp_path):
    with pytest.raises(InputError, match="m: is missing, and the faces of the OBJ file have no area"):
        read_assignment_scene(scene(tmp_path, CHAIN, m=None))


def test_all_mistakes_come_at_once(tmp_path):
    with pytest.raises(InputError) as caught:
        read_assignment_scene(scene(tmp_path, k=-1, m=-1, bc=[]))
    assert {mistake.key for mistake in caught.value.mistakes} == {"k", "m", "bc"}


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ("", None, "is empty"),
        ('{"obj": "mesh.obj",\n "k": 5,,}', 2, "is no JSON"),
        ("[1, 2]", None, "got a list"),
        ('{"k": 1, "k": 2}', None, "'k' occurs twice"),
        ("[" * 100_000, None, "cannot be read as JSON"),
        ('{"k": ' + "1" * 5000 + "}", None, "cannot be read as JSON"),
    ],
    ids=["empty", "syntax", "list", "twice", "deep", "long"],
)
def test_a_file_that_is_no_scene_is_refused(tmp_path, text, line, words):
    path = tmp_path / "scene.json"
    path.write_text(text)
    with pytest.raises(InputError, match=words) as caught:
        read_assignment_scene(path)
    assert caught.value.mistakes[0].line == line


def test_text_that_is_not_utf8_is_refused(tmp_path):
    path = tmp_path / "scene.json"
    path.write_bytes(b'{"obj": "\xff\xfe"}')
    with pytest.raises(InputError, match="cannot be read as JSON"):
        read_assignment_scene(path)


def test_a_missing_obj_is_named(tmp_path):
    path = scene(tmp_path)
    (tmp_path / "mesh.obj").unlink()
    with pytest.raises(InputError, match=r"mesh\.obj: cannot be opened"):
        read_assignment_scene(path)


def test_an_obj_without_faces_is_refused(tmp_path):
    with pytest.raises(InputError, match="no faces"):
        read_assignment_scene(scene(tmp_path, "v 0 0 0\nv 1 0 0\nl 1 2\n"))
