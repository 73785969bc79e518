"""Faces of more than three corners: triangles and masses do not depend on the corner that a face lists first."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest
from springbench.harness.config.config_loader import load_scene
from springbench.harness.errors import InputError
from springbench.harness.scenes.mesh.file_mesh import FileMesh
from springbench.harness.scenes.mesh.polygon_triangulation import (
    MAX_CONCAVE_CORNERS,
    compute_vertex_areas,
    triangulate_polygons,
)
from springbench.harness.scenes.scene_builder import build_scene

from tests.oracles.verify_scene import verify_terms

ROUND_OFF = 1e-12
"""A few hundred additions of numbers of order one in float64."""

SQUARE = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
KITE = [(0, 0, 0), (2, -1, 0), (3, 0, 0), (2, 1, 0)]
ARROW = [(0, 0, 0), (2, -1, 0), (0.5, 0, 0), (2, 1, 0)]
L = [(0, 0, 0), (2, 0, 0), (2, 1, 0), (1, 1, 0), (1, 2, 0), (0, 2, 0)]
HEXAGON = [(np.cos(a), np.sin(a), 0) for a in np.arange(6) * np.pi / 3]
CORNER_ON_A_SIDE = [(0, 0, 0), (0.5, 0, 0), (1, 0, 0), (0, 1, 0)]
DOUBLED_CORNER = [(0, 0, 0), (0, 0, 0), (1, 0, 0), (0, 1, 0)]
COMB = [(0, 0, 0), (5, 0, 0), (5, 2, 0), (4, 1, 0), (3, 2, 0), (2, 1, 0), (1, 2, 0), (0, 1, 0)]
AREAS = {
    "square": (SQUARE, 1.0),
    "kite": (KITE, 3.0),
    "arrow": (ARROW, 0.5),
    "L": (L, 3.0),
    "hexagon": (HEXAGON, 1.5 * 3**0.5),
    "a corner on a side": (CORNER_ON_A_SIDE, 0.5),
    "a doubled corner": (DOUBLED_CORNER, 0.5),
    "comb": (COMB, 7.5),
}


def obj(folder: Path, points, *faces: str, name: str = "mesh.obj") -> Path:
    """An OBJ file of these points, and of faces as they stand in it."""
    lines = [*("v {:.17g} {:.17g} {:.17g}".format(*p) for p in points), *(f"f {face}" for face in faces)]
    (folder / name).write_text("\n".join(lines) + "\n")
    return folder / name


def scene(folder: Path, path: Path, effects: str, mass: str = "mass: 1"):
    """The scene of a mesh file under these effects, bound."""
    config = folder / f"{path.stem}.yaml"
    config.write_text(
        f"mesh: {{kind: file, path: {path.name}}}\n{mass}\ntime_step: 0.01\nframes: 2\neffects: [{effects}]\n"
    )
    return build_scene(load_scene(config), 0)


@pytest.mark.parametrize("case", AREAS)
def test_areas_and_triangles_are_those_of_the_face_whichever_corner_comes_first(case):
    points, area = AREAS[case]
    k = len(points)
    turned = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]  # a face may lie in any plane
    rest, renumbered = np.empty((k, 3)), np.random.default_rng(4).permutation(k)
    rest[renumbered] = np.array(points, float) @ turned + 5.0
    found = set()
    for shift in range(k):
        for direction in (1, -1):
            faces = np.roll(renumbered, shift)[None, ::direction]
            surface = triangulate_polygons(rest, faces)
            assert not surface.is_self_crossing.any()
            weights = compute_vertex_areas(rest, faces, surface)
            assert weights.sum() == pytest.approx(area, rel=ROUND_OFF)
            a, b, c = (rest[surface.triangles[0][:, i]] for i in range(3))
            normals = np.cross(b - a, c - a)
            assert np.linalg.norm(normals, axis=1).sum() / 2 == pytest.approx(area, rel=ROUND_OFF)
            assert np.linalg.norm(normals.sum(axis=0)) / 2 == pytest.approx(area, rel=ROUND_OFF)  # none is turned over
            found.add((frozenset(map(frozenset, surface.triangles[0].tolist())), tuple(np.round(weights, 10))))
    assert len(found) == 1


def test_a_quadrangle_gives_its_corners_half_of_each_diagonals_thirds():
    rest, face = np.array(KITE, float), np.array([[0, 1, 2, 3]])
    by_short = np.array([2, 2 + 1, 1, 2 + 1]) / 3  # its triangles have 2 and 1 m^2
    by_long = np.array([1.5 + 1.5, 1.5, 1.5 + 1.5, 1.5]) / 3
    areas = compute_vertex_areas(rest, face, triangulate_polygons(rest, face))
    assert areas == pytest.approx((by_short + by_long) / 2, rel=ROUND_OFF)


def test_a_quadrangle_is_cut_by_its_shorter_diagonal_and_an_equal_one_by_the_lowest_vertex():
    assert triangulate_polygons(np.array(KITE, float), np.array([[2, 3, 0, 1]])).triangles.tolist() == [
        [[0, 1, 3], [1, 2, 3]]
    ]
    assert triangulate_polygons(np.array(SQUARE, float), np.array([[1, 2, 3, 0]])).triangles.tolist() == [
        [[0, 1, 2], [0, 2, 3]]
    ]


@pytest.mark.parametrize("first", range(4))
def test_a_hanging_square_weighs_the_same_at_all_corners(tmp_path, first):
    face = " ".join(str((first + i) % 4 + 1) for i in range(4))
    assert FileMesh(path=obj(tmp_path, SQUARE, face)).build_mesh().mass_fractions.tolist() == [0.25] * 4


def test_a_cube_of_quadrangles_weighs_the_same_at_all_corners(tmp_path):
    cube = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
    faces = ["1 2 4 3", "5 7 8 6", "6 2 1 5", "3 4 8 7", "7 5 1 3", "2 6 8 4"]
    path = obj(tmp_path, cube, *faces)
    assert FileMesh(path=path).build_mesh().mass_fractions == pytest.approx([1 / 8] * 8, rel=ROUND_OFF)
    made = scene(tmp_path, path, "{kind: springs, stretch: 1}, {kind: gas, pressure: 10}", "mass_per_area: 2")
    assert made.system.mass == pytest.approx([2 * 6 / 8] * 8, rel=ROUND_OFF)


@pytest.mark.parametrize(
    "effect",
    ["{kind: wind, acts_on: triangle, velocity: [3, 1, 2], lift_coefficient: 0.3}", "{kind: gas, pressure: 9}"],
)
def test_forces_on_the_triangles_of_quadrangles_do_not_depend_on_the_first_corner(tmp_path, effect):
    points = [(x, y, z + 0.1 * x * y) for x in (0.0, 1.3) for y in (0.0, 1.0) for z in (0.0, 0.8)]
    faces = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    p = np.array(points) + 0.05 * np.random.default_rng(1).normal(size=(8, 3))
    found = []
    for shift in range(4):
        path = obj(tmp_path, points, *(" ".join(str(v + 1) for v in np.roll(face, shift)) for face in faces))
        made = scene(tmp_path, path, f"{{kind: springs, stretch: 1}}, {effect}")
        total = sum((force(p, np.zeros_like(p), 0.0) for force in made.varying_forces), np.zeros_like(p))
        for energy in made.system.energies:
            energy.add_gradient(p, total)
        found.append(total)
    for other in found[1:]:
        assert np.array_equal(other, found[0])


@pytest.mark.parametrize("first", [0, 3])
def test_the_reference_terms_agree_on_concave_and_convex_faces(tmp_path, first):
    faces = [np.roll([1, 2, 3, 4, 5, 6], first), np.roll([4, 3, 7, 5], first)]
    path = obj(tmp_path, [*L, (2.5, 2, 0.5)], *(" ".join(map(str, face)) for face in faces))
    wind = "{kind: wind, acts_on: triangle, velocity: [3, 1, 2], lift_coefficient: 0.3}"
    effects = f"{{kind: springs, stretch: 10}}, {{kind: gravity}}, {wind}, {{kind: bending, stiffness: 0.1}}"
    made = scene(tmp_path, path, effects, "mass_per_area: 0.3")
    assert verify_terms(load_scene(tmp_path / "mesh.yaml"), made, "implicit-euler") == "agrees"


@pytest.mark.parametrize(
    ("points", "face", "words"),
    [
        (SQUARE, "1 3 2 4", "sides of this face cross"),
        ([(0, 0, 0), (2, 2, 0), (3, 0, 0), (0, 1, 0)], "1 2 3 4", "sides of this face cross"),
        ([HEXAGON[i] for i in range(5)], "1 3 5 2 4", "sides of this face cross"),
        ([(np.cos(a), np.sin(a) * (1 + a % 2), 0) for a in range(MAX_CONCAVE_CORNERS + 1)], None, "is not convex"),
    ],
)
def test_a_face_that_is_no_polygon_is_refused_with_its_line(tmp_path, points, face, words):
    path = obj(tmp_path, points, face or " ".join(str(i + 1) for i in range(len(points))))
    with pytest.raises(InputError, match=words) as caught:
        FileMesh(path=path).build_mesh()
    assert caught.value.mistakes[0].line == len(points) + 1


REPEATS = {
    "the same again": (["1 2 3", "1 3 4", "1 2 3"], [(7, 5)]),
    "from another corner": (["1 2 3", "1 3 4", "2 3 1"], [(7, 5)]),
    "turned over, three times": (["1 2 3", "1 3 4", "3 2 1", "1 2 3"], [(7, 5), (8, 5)]),
    "a quadrangle twice": (["1 2 3 4", "3 4 1 2"], [(6, 5)]),
    "a quadrangle turned over": (["1 2 3 4", "4 3 2 1"], [(6, 5)]),
    "a quadrangle and its triangles": (["1 2 3 4", "1 2 3", "1 3 4"], [(6, 5), (7, 5)]),
    "its triangles by the other diagonal, first": (["1 2 4", "2 3 4", "1 2 3 4"], [(5, 7), (6, 7)]),
}


@pytest.mark.parametrize("suffix", [".obj", ".ply"])
@pytest.mark.parametrize("case", REPEATS)
def test_a_repeated_face_counts_once_with_a_warning(tmp_path, caplog, case, suffix):
    faces, repeats = REPEATS[case]
    path, shift = obj(tmp_path, SQUARE, *faces), 0
    if suffix == ".ply":
        path = tmp_path / "mesh.ply"
        lines = [f"{len(corners)} " + " ".join(str(int(c) - 1) for c in corners) for corners in map(str.split, faces)]
        head = "property float x\nproperty float y\nproperty float z\n"
        path.write_text(
            f"ply\nformat ascii 1.0\nelement vertex 4\n{head}element face {len(faces)}\n"
            "property list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n" + "\n".join(lines)
        )
        shift = 14 - 5  # its first face stands in line 14
    with caplog.at_level(logging.WARNING, "springbench"):
        made = scene(tmp_path, path, "{kind: springs, stretch: 1}", "mass_per_area: 0.5")
    assert made.system.mass.sum() == pytest.approx(0.5, rel=ROUND_OFF)
    assert len(made.mesh.triangles) == 2
    said = caplog.messages[0]
    assert said.startswith(f"{path}:{repeats[0][0] + shift}: ")
    for repeat, other in repeats:
        assert f"{repeat + shift} repeats {other + shift}" in said


def test_what_fills_a_notch_repeats_nothing(tmp_path, caplog):
    mesh = FileMesh(path=obj(tmp_path, ARROW, "1 2 3 4", "3 2 4")).build_mesh()
    assert len(mesh.triangles) == 3
    assert mesh.vertex_areas is not None
    assert mesh.vertex_areas.sum() == pytest.approx(0.5 + 1.5, rel=ROUND_OFF)
    assert not caplog.messages


def test_a_repeated_tetrahedron_counts_once_and_has_its_surface(tmp_path, caplog):
    path = tmp_path / "mesh.vtk"
    points = "POINTS 5 double\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 1 1\n"
    cells = "CELLS 3 15\n4 0 1 2 3\n4 1 0 2 3\n4 4 1 2 3\nCELL_TYPES 3\n10\n10\n10\n"
    path.write_text(f"# vtk DataFile Version 3.0\nx\nASCII\nDATASET UNSTRUCTURED_GRID\n{points}{cells}")
    mesh = FileMesh(path=path).build_mesh()
    assert mesh.mass_fractions[0] == pytest.approx(1 / 6 / 4 / (1 / 6 + 1 / 3), rel=ROUND_OFF)
    assert len(mesh.triangles) == 6
    assert "1 tetrahedra repeat others" in caplog.messages[0]
