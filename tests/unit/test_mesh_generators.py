"""What every generator promises, and the shape of each."""

from __future__ import annotations

from collections import Counter
from importlib import import_module

import numpy as np
import pytest
from pydantic import ValidationError

from harness.errors import InputError
from harness.mesh.base import BEND, SHEAR, STRETCH, Mesh
from harness.mesh.chain import Chain
from harness.mesh.generator import MAX_VERTICES, Generator
from harness.mesh.grid import Grid, Net
from harness.mesh.solids import Block, Tower
from harness.mesh.surfaces import Balloon, Skirt
from harness.mesh.table import MESHES

ROUND_OFF = 1e-12
"""A few thousand additions of numbers of order one in float64."""

GENERATORS: list[Generator] = [
    Chain(length=2.0, direction=(1.0, -1.0, 0.5)),
    Grid(diagonals="none"),
    Grid(width=1.5, height=0.7, diagonals="one", skip_one=True),
    Grid(plane="vertical", skip_one=True),
    Net(width=1.2, height=2.0),
    Net(plane="vertical"),
    Skirt(),
    Balloon(radius=0.3),
    Tower(),
    Block(length=1.0, height=0.4, depth=0.6),
]
MESH_CASES = [
    pytest.param(generator, generator.SMALLEST + extra, id=f"{type(generator).__name__}{k}-{extra}")
    for k, generator in enumerate(GENERATORS)
    for extra in (0, 1, 5)
]


@pytest.mark.parametrize("kind", MESHES)
def test_the_table_names_a_model_of_that_kind(kind):
    module, name = MESHES[kind].split(":")
    model = getattr(import_module(module), name)
    assert model.model_fields["kind"].default == kind


@pytest.mark.parametrize(("generator", "size"), MESH_CASES)
def test_springs_join_two_vertices_once(generator, size):
    mesh = generator.build(size)
    pairs = Counter(frozenset(pair) for pair in mesh.springs.tolist())
    assert set(pairs.values()) == {1}
    assert all(len(pair) == 2 for pair in pairs)
    assert mesh.springs.min() == 0
    assert mesh.springs.max() == len(mesh.rest) - 1


@pytest.mark.parametrize(("generator", "size"), MESH_CASES)
def test_families_are_a_partition_of_the_springs(generator, size):
    mesh = generator.build(size)
    assert set(mesh.families) == {STRETCH, SHEAR, BEND}
    assert sorted(np.concatenate(list(mesh.families.values()))) == list(range(len(mesh.springs)))


@pytest.mark.parametrize(("generator", "size"), MESH_CASES)
def test_the_vertices_are_as_many_as_announced_and_joined_in_one_piece(generator, size):
    mesh = generator.build(size)
    assert len(mesh.rest) == generator.count(size)
    reached, frontier = {0}, {0}
    neighbours: dict[int, set[int]] = {}
    for i, j in mesh.springs.tolist():
        neighbours.setdefault(i, set()).add(j)
        neighbours.setdefault(j, set()).add(i)
    while frontier:
        frontier = set().union(*(neighbours[v] for v in frontier)) - reached
        reached |= frontier
    assert len(reached) == len(mesh.rest)


@pytest.mark.parametrize(("generator", "size"), MESH_CASES)
def test_every_vertex_has_a_share_and_the_shares_sum_to_one(generator, size):
    mesh = generator.build(size)
    assert mesh.shares.shape == (len(mesh.rest),)
    assert mesh.shares.min() > 0
    assert mesh.shares.sum() == pytest.approx(1, abs=ROUND_OFF)


@pytest.mark.parametrize(("generator", "size"), MESH_CASES)
def test_parts_are_sorted_vertices(generator, size):
    mesh = generator.build(size)
    assert mesh.parts
    for part in mesh.parts.values():
        assert len(part)
        assert np.all(np.diff(part) > 0)
        assert part[0] >= 0
        assert part[-1] < len(mesh.rest)


@pytest.mark.parametrize(("generator", "size"), MESH_CASES)
def test_arrays_have_the_promised_types_and_cannot_be_written_to(generator, size):
    mesh = generator.build(size)
    assert mesh.rest.dtype == np.float64
    assert mesh.rest.flags.c_contiguous
    assert mesh.springs.dtype == mesh.triangles.dtype == np.int64
    for array in (mesh.rest, mesh.springs, mesh.triangles, mesh.shares, *mesh.families.values(), *mesh.parts.values()):
        assert not array.flags.writeable


@pytest.mark.parametrize(("generator", "size"), MESH_CASES)
def test_neighbouring_triangles_agree_on_their_orientation(generator, size):
    directed = Counter(directed_edges(generator.build(size)))
    assert set(directed.values()) <= {1}  # two triangles that agree pass their common side in opposite directions


@pytest.mark.parametrize(("generator", "size"), MESH_CASES)
def test_building_again_gives_the_same_mesh(generator, size):
    first, second = generator.build(size), generator.build(size)
    assert np.array_equal(first.rest, second.rest)
    assert np.array_equal(first.springs, second.springs)
    assert np.array_equal(first.triangles, second.triangles)


@pytest.mark.parametrize("generator", GENERATORS, ids=lambda g: type(g).__name__)
def test_the_extent_does_not_depend_on_the_size(generator):
    coarse, fine = generator.build(12), generator.build(24)
    # rings and spheres of 12 vertices miss the extreme points of a circle by at most 1 - cos(pi/12) = 3.4 %
    assert np.ptp(fine.rest, axis=0) == pytest.approx(np.ptp(coarse.rest, axis=0), rel=0.035, abs=ROUND_OFF)


@pytest.mark.parametrize("generator", GENERATORS, ids=lambda g: type(g).__name__)
def test_the_spacing_is_a_typical_rest_length_and_halves_with_twice_the_size(generator):
    coarse, fine = generator.build(8), generator.build(16)
    assert fine.rest_lengths.min() <= fine.spacing <= fine.rest_lengths.max()
    if not isinstance(generator, Tower):  # its storeys get lower, its width stays
        assert 0.4 < fine.spacing / coarse.spacing < 0.6  # (8 - 1)/(16 - 1) = 0.47 and rounded row counts


def test_the_curtain_of_liu_2013_has_its_springs():
    mesh = Grid(diagonals="one", skip_one=True).build(81)
    assert len(mesh.rest) == 6561
    assert {family: len(springs) for family, springs in mesh.families.items()} == {
        STRETCH: 12960,
        SHEAR: 6400,
        BEND: 12798,
    }
    assert len(mesh.springs) == 32158


def test_a_cloth_of_64_vertices_a_side_with_both_diagonals_has_16002_springs():
    assert len(Grid(diagonals="both").build(64).springs) == 16002


@pytest.mark.parametrize(
    ("generator", "size", "vertices", "springs", "triangles"),
    [
        (Chain(), 10, 10, 9, 0),
        (Grid(height=2.0, diagonals="none"), 3, 15, 22, 16),
        (Net(), 2, 5, 8, 0),
        (Net(height=2.0), 3, 3 * 5 + 2 * 4, 4 * 8 + 2 * 2 + 2 * 4, 0),
        (Skirt(top_radius=0.5, bottom_radius=0.5, height=np.pi), 4, 20, 5 * 4 + 4 * 4 + 2 * 4 * 4, 32),
        (Balloon(), 1, 12, 30, 20),
        (Balloon(), 7, 492, 1470, 980),
        (Tower(), 2, 12, 12 + 8 + 16 + 3, 0),
        (Block(height=1.0, depth=1.0), 2, 8, 28, 12),
        (Block(height=1.0, depth=0.5), 3, 18, 33 + 2 * (4 * 2 + 2 * 2 * 3) + 4 * 4, 32),
    ],
    ids=repr,
)
def test_counts_are_those_of_the_lattice(generator, size, vertices, springs, triangles):
    mesh = generator.build(size)
    assert (len(mesh.rest), len(mesh.springs), len(mesh.triangles)) == (vertices, springs, triangles)


@pytest.mark.parametrize(
    ("generator", "lengths"),
    [
        (Grid(skip_one=True), {STRETCH: [1], SHEAR: [2**0.5], BEND: [2]}),
        (Block(height=1.0, depth=1.0), {STRETCH: [1], SHEAR: [2**0.5, 3**0.5], BEND: []}),
    ],
    ids=repr,
)
def test_families_have_the_rest_lengths_of_their_directions(generator, lengths):
    mesh = generator.build(5)
    for family, springs in mesh.families.items():
        came = np.unique(np.round(mesh.rest_lengths[springs] / mesh.spacing, 9))
        assert came == pytest.approx(lengths[family], abs=1e-8)  # rounded to 9 digits


def test_springs_follow_the_documented_order():
    mesh = Grid(diagonals="both", skip_one=True).build(3)
    rows = [(0, 1), (1, 2), (3, 4), (4, 5), (6, 7), (7, 8)]
    columns = [(0, 3), (1, 4), (2, 5), (3, 6), (4, 7), (5, 8)]
    right, left = [(0, 4), (1, 5), (3, 7), (4, 8)], [(1, 3), (2, 4), (4, 6), (5, 7)]
    skip = [(0, 2), (3, 5), (6, 8), (0, 6), (1, 7), (2, 8)]
    assert [tuple(pair) for pair in mesh.springs.tolist()] == rows + columns + right + left + skip


def test_a_chain_points_where_it_is_told():
    mesh = Chain(length=3.0, direction=(0.0, -2.0, 0.0)).build(4)
    assert mesh.rest == pytest.approx(np.array([[0, 0, 0], [0, -1, 0], [0, -2, 0], [0, -3, 0]]), abs=ROUND_OFF)
    assert mesh.shares == pytest.approx([1 / 6, 1 / 3, 1 / 3, 1 / 6])
    assert mesh.parts["ends"].tolist() == [0, 3]


@pytest.mark.parametrize("model", [Grid, Net])
def test_a_vertical_sheet_hangs_below_its_top(model):
    mesh = model(width=2.0, height=1.0, plane="vertical").build(5)
    assert np.all(mesh.rest[mesh.parts["top"], 1] == 0)
    assert np.all(mesh.rest[mesh.parts["bottom"], 1] == -1)
    assert np.all(mesh.rest[mesh.parts["left"], 0] == -1)
    assert np.all(mesh.rest[mesh.parts["right"], 0] == 1)
    assert mesh.parts["top_corners"].tolist() == [0, 4]
    assert not mesh.rest[:, 2].any()


@pytest.mark.parametrize("model", [Grid, Net])
def test_a_horizontal_sheet_lies_level_around_the_origin(model):
    mesh = model(width=2.0, height=1.0).build(5)
    assert not mesh.rest[:, 1].any()
    assert mesh.shares @ mesh.rest == pytest.approx([0, 0, 0], abs=ROUND_OFF)
    assert len(mesh.parts["corners"]) == 4


def test_the_triangles_of_a_horizontal_cloth_face_up():
    assert np.all(normals(Grid().build(4))[:, 1] > 0)


def test_the_ropes_of_a_net_leave_squares_open():
    mesh = Net().build(6)
    inner = np.setdiff1d(np.arange(len(mesh.rest)), mesh.parts["boundary"])
    degree = np.bincount(mesh.springs.ravel())
    assert set(degree[inner]) == {4}
    assert mesh.rest_lengths[: 4 * 25] == pytest.approx(mesh.spacing)  # the rope around is sqrt(2) longer
    assert len(mesh.parts["boundary"]) == 20


def test_a_skirt_widens_from_waist_to_hem_and_faces_outwards():
    mesh = Skirt(top_radius=0.2, bottom_radius=0.6, height=0.5).build(16)
    for part, radius, y in (("top", 0.2, 0.0), ("bottom", 0.6, -0.5)):
        ring = mesh.rest[mesh.parts[part]]
        assert len(ring) == 16
        assert np.hypot(ring[:, 0], ring[:, 2]) == pytest.approx(radius)
        assert ring[:, 1] == pytest.approx(y)
    middle = mesh.rest[mesh.triangles].mean(axis=1) * [1, 0, 1]
    assert np.all(np.einsum("ij,ij->i", normals(mesh), middle) > 0)


@pytest.mark.parametrize(
    ("generator", "size", "volume", "tolerance"),
    [
        (Balloon(radius=0.5), 16, np.pi / 6, 0.01),  # an inscribed polyhedron of 5120 facets lacks half a percent
        (Block(length=1.0, height=0.5, depth=0.4), 11, 0.2, ROUND_OFF),
    ],
    ids=repr,
)
def test_closed_surfaces_enclose_their_volume(generator, size, volume, tolerance):
    mesh = generator.build(size)
    edges = set(directed_edges(mesh))
    assert all((j, i) in edges for i, j in edges)
    a, b, c = (mesh.rest[mesh.triangles[:, k]] for k in range(3))
    assert np.einsum("ij,ij->", np.cross(a, b), c) / 6 == pytest.approx(volume, rel=tolerance)


def test_a_balloon_is_round_and_has_its_poles_on_the_axis():
    mesh = Balloon(radius=0.3).build(9)
    assert np.linalg.norm(mesh.rest, axis=1) == pytest.approx(0.3)
    assert mesh.rest[mesh.parts["pole_top"]] == pytest.approx(np.array([[0, 0.3, 0]]))
    assert mesh.rest[mesh.parts["pole_bottom"]] == pytest.approx(np.array([[0, -0.3, 0]]))
    assert Counter(np.bincount(mesh.springs.ravel()).tolist()) == {5: 12, 6: 800}


def test_a_tower_tapers_and_stands_on_four_feet():
    mesh = Tower(height=2.0, base_width=1.0, top_width=0.5).build(4)
    assert mesh.rest[mesh.parts["base"]].tolist() == [[0.5, 0, 0.5], [0.5, 0, -0.5], [-0.5, 0, -0.5], [-0.5, 0, 0.5]]
    assert np.all(mesh.rest[mesh.parts["top"], 1] == 2.0)
    assert np.ptp(mesh.rest[mesh.parts["top"], 0]) == 0.5


def test_mass_goes_by_area_and_by_volume():
    cloth, block = Grid(width=2.0, height=2.0).build(5), Block(height=1.0, depth=1.0).build(5)
    inner = np.setdiff1d(np.arange(25), cloth.parts["boundary"])
    assert cloth.shares[inner] == pytest.approx(1 / 16)  # six triangles of 1/32 give a third each
    assert block.shares[block.parts["corners"]] == pytest.approx(1 / 8 / 64)
    assert block.shares.max() == pytest.approx(1 / 64)


@pytest.mark.parametrize("generator", GENERATORS, ids=lambda g: type(g).__name__)
@pytest.mark.parametrize("size", [-3, 0, 10**9, 10**400])
def test_senseless_sizes_are_refused_with_what_is_allowed(generator, size):
    with pytest.raises(InputError) as caught:
        generator.build(size)
    (mistake,) = caught.value.mistakes
    assert mistake.key == "size"
    assert mistake.problem.startswith(f"{size} ")
    assert f"{generator.SMALLEST} to " in mistake.problem


@pytest.mark.parametrize("generator", GENERATORS, ids=lambda g: type(g).__name__)
def test_the_largest_size_named_is_the_largest_that_fits(generator):
    with pytest.raises(InputError) as caught:
        generator.build(generator.SMALLEST - 1)
    largest = int(str(caught.value).split(" to ")[1].split()[0])
    assert generator.count(largest) <= MAX_VERTICES < generator.count(largest + 1)


def test_proportions_that_no_size_fits_are_refused():
    with pytest.raises(InputError, match="none with these proportions"):
        Grid(width=1e-6, height=1e6).build(2)


@pytest.mark.parametrize(
    ("model", "fields"),
    [
        (Chain, {"direction": (0, 0, 0)}),
        (Chain, {"length": 0}),
        (Grid, {"width": float("nan")}),
        (Grid, {"diagonals": "all"}),
        (Skirt, {"top_radius": -1}),
        (Balloon, {"radius": 1e7}),
        (Block, {"width": 1}),
    ],
)
def test_senseless_parameters_are_refused(model, fields):
    with pytest.raises(ValidationError):
        model(**fields)


def normals(mesh: Mesh) -> np.ndarray:
    """Normals of the triangles, twice the area long."""
    a, b, c = (mesh.rest[mesh.triangles[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def directed_edges(mesh: Mesh) -> list[tuple[int, int]]:
    """The sides of the triangles in the direction in which they are passed."""
    return [pair for a, b, c in mesh.triangles.tolist() for pair in ((a, b), (b, c), (c, a))]
