"""The shape that each generator makes."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from pydantic import ValidationError
from springbench.harness.errors import InputError
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh, RopeMesh
from springbench.harness.scenes.mesh.grid_mesh import GridMesh, NetMesh
from springbench.harness.scenes.mesh.mesh import BEND, SHEAR, STRETCH, Mesh
from springbench.harness.scenes.mesh.solid_meshes import BlockMesh, TowerMesh
from springbench.harness.scenes.mesh.stack_mesh import StackMesh
from springbench.harness.scenes.mesh.surface_meshes import BalloonMesh, SkirtMesh

ROUND_OFF = 1e-12
"""A few thousand additions of numbers of order one in float64."""


def test_the_curtain_of_liu_2013_has_its_springs():
    mesh = GridMesh(diagonals="one", bend_springs=True).build_mesh(81)
    assert len(mesh.rest_positions) == 6561
    assert {family: len(springs) for family, springs in mesh.spring_families.items()} == {
        STRETCH: 12960,
        SHEAR: 6400,
        BEND: 12798,
    }
    assert len(mesh.springs) == 32158


def test_a_block_of_75_vertices_with_one_diagonal_a_face_is_as_large_as_the_dog_of_liu_2013():
    mesh = BlockMesh(height=0.26, depth=0.25, diagonals="one").build_mesh(75)
    assert (len(mesh.rest_positions), len(mesh.springs)) == (28_500, 161_199)  # the dog: 28,390 and 148,047


def test_a_cloth_of_64_vertices_a_side_with_both_diagonals_has_16002_springs():
    assert len(GridMesh(diagonals="both").build_mesh(64).springs) == 16002


@pytest.mark.parametrize(
    ("generator", "size", "vertices", "springs", "triangles"),
    [
        (ChainMesh(), 10, 10, 9, 0),
        (GridMesh(height=2.0, diagonals="none"), 3, 15, 22, 16),
        (NetMesh(), 2, 5, 8, 0),
        (NetMesh(height=2.0), 3, 3 * 5 + 2 * 4, 4 * 8 + 2 * 2 + 2 * 4, 0),
        (SkirtMesh(top_radius=0.5, bottom_radius=0.5, height=np.pi), 4, 20, 5 * 4 + 4 * 4 + 2 * 4 * 4, 32),
        (BalloonMesh(), 1, 12, 30, 20),
        (BalloonMesh(), 7, 492, 1470, 980),
        (TowerMesh(), 2, 12, 12 + 8 + 16 + 3, 0),
        (BlockMesh(height=1.0, depth=1.0), 2, 8, 28, 12),
        (BlockMesh(height=1.0, depth=0.5), 3, 18, 33 + 2 * (4 * 2 + 2 * 2 * 3) + 4 * 4, 32),
        (BlockMesh(height=1.0, depth=0.5, diagonals="one"), 3, 18, 33 + 4 * 2 + 2 * 2 * 3, 32),
    ],
    ids=repr,
)
def test_counts_are_those_of_the_lattice(generator, size, vertices, springs, triangles):
    mesh = generator.build_mesh(size)
    assert (len(mesh.rest_positions), len(mesh.springs), len(mesh.triangles)) == (vertices, springs, triangles)


@pytest.mark.parametrize(
    ("generator", "lengths"),
    [
        (GridMesh(bend_springs=True), {STRETCH: [1], SHEAR: [2**0.5], BEND: [2]}),
        (BlockMesh(height=1.0, depth=1.0), {STRETCH: [1], SHEAR: [2**0.5, 3**0.5], BEND: []}),
        (BlockMesh(height=1.0, depth=1.0, diagonals="one"), {STRETCH: [1], SHEAR: [2**0.5], BEND: []}),
    ],
    ids=repr,
)
def test_families_have_the_rest_lengths_of_their_directions(generator, lengths):
    mesh = generator.build_mesh(5)
    for family, springs in mesh.spring_families.items():
        came = np.unique(np.round(mesh.rest_lengths[springs] / mesh.spacing, 9))
        assert came == pytest.approx(lengths[family], abs=1e-8)  # rounded to 9 digits


def test_springs_follow_the_documented_order():
    mesh = GridMesh(diagonals="both", bend_springs=True).build_mesh(3)
    rows = [(0, 1), (1, 2), (3, 4), (4, 5), (6, 7), (7, 8)]
    columns = [(0, 3), (1, 4), (2, 5), (3, 6), (4, 7), (5, 8)]
    right, left = [(0, 4), (1, 5), (3, 7), (4, 8)], [(1, 3), (2, 4), (4, 6), (5, 7)]
    skip = [(0, 2), (3, 5), (6, 8), (0, 6), (1, 7), (2, 8)]
    assert [tuple(pair) for pair in mesh.springs.tolist()] == rows + columns + right + left + skip


def test_a_chain_points_in_the_stated_direction():
    mesh = ChainMesh(length=3.0, direction=(0.0, -2.0, 0.0)).build_mesh(4)
    assert mesh.rest_positions == pytest.approx(
        np.array([[0, 0, 0], [0, -1, 0], [0, -2, 0], [0, -3, 0]]), abs=ROUND_OFF
    )
    assert mesh.mass_fractions == pytest.approx([1 / 6, 1 / 3, 1 / 3, 1 / 6])
    assert mesh.parts["ends"].tolist() == [0, 3]


@pytest.mark.parametrize("model", [GridMesh, NetMesh])
def test_a_vertical_sheet_hangs_below_its_top(model):
    mesh = model(width=2.0, height=1.0, plane="vertical").build_mesh(5)
    assert np.all(mesh.rest_positions[mesh.parts["top"], 1] == 0)
    assert np.all(mesh.rest_positions[mesh.parts["bottom"], 1] == -1)
    assert np.all(mesh.rest_positions[mesh.parts["left"], 0] == -1)
    assert np.all(mesh.rest_positions[mesh.parts["right"], 0] == 1)
    assert mesh.parts["top_corners"].tolist() == [0, 4]
    assert not mesh.rest_positions[:, 2].any()


@pytest.mark.parametrize("model", [GridMesh, NetMesh])
def test_a_horizontal_sheet_is_level_around_the_origin(model):
    mesh = model(width=2.0, height=1.0).build_mesh(5)
    assert not mesh.rest_positions[:, 1].any()
    assert mesh.mass_fractions @ mesh.rest_positions == pytest.approx([0, 0, 0], abs=ROUND_OFF)
    assert len(mesh.parts["corners"]) == 4


def test_the_triangles_of_a_horizontal_cloth_face_up():
    assert np.all(normals(GridMesh().build_mesh(4))[:, 1] > 0)


def test_the_ropes_of_a_net_leave_squares_open():
    mesh = NetMesh().build_mesh(6)
    inner = np.setdiff1d(np.arange(len(mesh.rest_positions)), mesh.parts["boundary"])
    degree = np.bincount(mesh.springs.ravel())
    assert set(degree[inner]) == {4}
    assert mesh.rest_lengths[: 4 * 25] == pytest.approx(mesh.spacing)  # the rope around is sqrt(2) longer
    assert len(mesh.parts["boundary"]) == 20


def test_a_skirt_widens_from_waist_to_hem_and_faces_outwards():
    mesh = SkirtMesh(top_radius=0.2, bottom_radius=0.6, height=0.5).build_mesh(16)
    for part, radius, y in (("top", 0.2, 0.0), ("bottom", 0.6, -0.5)):
        ring = mesh.rest_positions[mesh.parts[part]]
        assert len(ring) == 16
        assert np.hypot(ring[:, 0], ring[:, 2]) == pytest.approx(radius)
        assert ring[:, 1] == pytest.approx(y)
    middle = mesh.rest_positions[mesh.triangles].mean(axis=1) * [1, 0, 1]
    assert np.all(np.einsum("ij,ij->i", normals(mesh), middle) > 0)


def test_a_balloon_is_round_and_has_its_poles_on_the_axis():
    mesh = BalloonMesh(radius=0.3).build_mesh(9)
    assert np.linalg.norm(mesh.rest_positions, axis=1) == pytest.approx(0.3)
    assert mesh.rest_positions[mesh.parts["pole_top"]] == pytest.approx(np.array([[0, 0.3, 0]]))
    assert mesh.rest_positions[mesh.parts["pole_bottom"]] == pytest.approx(np.array([[0, -0.3, 0]]))
    assert Counter(np.bincount(mesh.springs.ravel()).tolist()) == {5: 12, 6: 800}


def test_a_tower_tapers_and_stands_on_four_feet():
    mesh = TowerMesh(height=2.0, base_width=1.0, top_width=0.5).build_mesh(4)
    assert mesh.rest_positions[mesh.parts["base"]].tolist() == [
        [0.5, 0, 0.5],
        [0.5, 0, -0.5],
        [-0.5, 0, -0.5],
        [-0.5, 0, 0.5],
    ]
    assert np.all(mesh.rest_positions[mesh.parts["top"], 1] == 2.0)
    assert np.ptp(mesh.rest_positions[mesh.parts["top"], 0]) == 0.5


def test_a_stack_consists_of_grids_each_rotated_against_the_one_below():
    one, mesh = GridMesh().build_mesh(3), StackMesh(num_layers=3, layer_spacing=0.1, layer_angle=90.0).build_mesh(3)
    assert len(mesh.rest_positions) == StackMesh(num_layers=3).count_vertices(3) == 27
    for k in range(3):
        layer = mesh.rest_positions[9 * k : 9 * k + 9]
        assert layer[:, 1] == pytest.approx(0.1 * k)
        assert len(mesh.springs) == 3 * len(one.springs)
    np.testing.assert_array_equal(mesh.rest_positions[:9], one.rest_positions)
    np.testing.assert_allclose(
        mesh.rest_positions[9:18, [0, 2]], one.rest_positions[:, [2, 0]] * (1, -1), atol=ROUND_OFF
    )
    for family, rows in one.spring_families.items():
        first, *_, last = (
            mesh.springs[mesh.spring_families[family]].reshape(3, -1, 2) if len(rows) else (one.springs[rows],) * 2
        )
        np.testing.assert_array_equal(first, one.springs[rows])
        assert len(rows) == 0 or (last - first == 18).all()
    assert mesh.parts["lowest"].tolist() == list(range(9))
    assert mesh.parts["highest"].tolist() == list(range(18, 27))
    assert mesh.parts["left"].tolist() == [i + 9 * k for k in range(3) for i in one.parts["left"].tolist()]
    assert mesh.mass_fractions.sum() == pytest.approx(1.0)


def test_a_rope_is_a_chain_with_springs_that_resist_bending():
    mesh = RopeMesh(length=2.0).build_mesh(5)
    np.testing.assert_array_equal(mesh.rest_positions, ChainMesh(length=2.0).build_mesh(5).rest_positions)
    assert mesh.springs[mesh.spring_families[BEND]].tolist() == [[0, 2], [1, 3], [2, 4]]
    assert mesh.dimension == 1


def test_mass_is_proportional_to_area_or_volume():
    cloth, block = GridMesh(width=2.0, height=2.0).build_mesh(5), BlockMesh(height=1.0, depth=1.0).build_mesh(5)
    inner = np.setdiff1d(np.arange(25), cloth.parts["boundary"])
    assert cloth.mass_fractions[inner] == pytest.approx(1 / 16)  # six triangles of 1/32 give a third each
    assert block.mass_fractions[block.parts["corners"]] == pytest.approx(1 / 8 / 64)
    assert block.mass_fractions.max() == pytest.approx(1 / 64)


def test_proportions_that_no_size_fits_are_refused():
    with pytest.raises(InputError, match="none with these proportions"):
        GridMesh(width=1e-6, height=1e6).build_mesh(2)


@pytest.mark.parametrize(
    ("model", "fields"),
    [
        (ChainMesh, {"direction": (0, 0, 0)}),
        (ChainMesh, {"length": 0}),
        (GridMesh, {"width": float("nan")}),
        (GridMesh, {"diagonals": "all"}),
        (SkirtMesh, {"top_radius": -1}),
        (BalloonMesh, {"radius": 1e7}),
        (BlockMesh, {"width": 1}),
    ],
)
def test_senseless_parameters_are_refused(model, fields):
    with pytest.raises(ValidationError):
        model(**fields)


def normals(mesh: Mesh) -> np.ndarray:
    """Normals of the triangles, twice the area long."""
    a, b, c = (mesh.rest_positions[mesh.triangles[:, k]] for k in range(3))
    return np.cross(b - a, c - a)
