"""Properties of the meshes of every generator."""

from __future__ import annotations

from collections import Counter
from importlib import import_module

import numpy as np
import pytest
from springbench.harness.errors import InputError
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh, RopeMesh
from springbench.harness.scenes.mesh.grid_mesh import GridMesh, NetMesh
from springbench.harness.scenes.mesh.mesh import BEND, SHEAR, STRETCH, Mesh
from springbench.harness.scenes.mesh.mesh_generator import MAX_VERTICES, MeshGenerator
from springbench.harness.scenes.mesh.mesh_table import MESH_CLASSES
from springbench.harness.scenes.mesh.solid_meshes import BlockMesh, TowerMesh
from springbench.harness.scenes.mesh.surface_meshes import BalloonMesh, SkirtMesh
from springbench.solvers.linalg import memory

ROUND_OFF = 1e-12
"""A few thousand additions of numbers of order one in float64."""

GENERATORS: list[MeshGenerator] = [
    ChainMesh(length=2.0, direction=(1.0, -1.0, 0.5)),
    RopeMesh(),
    GridMesh(diagonals="none"),
    GridMesh(width=1.5, height=0.7, diagonals="one", bend_springs=True),
    GridMesh(plane="vertical", bend_springs=True),
    NetMesh(width=1.2, height=2.0),
    NetMesh(plane="vertical"),
    SkirtMesh(),
    BalloonMesh(radius=0.3),
    TowerMesh(),
    BlockMesh(length=1.0, height=0.4, depth=0.6),
    BlockMesh(length=1.0, height=0.6, depth=0.4, diagonals="one"),
]
MESH_CASES = [
    pytest.param(generator, generator.MIN_SIZE + extra, id=f"{type(generator).__name__}{k}-{extra}")
    for k, generator in enumerate(GENERATORS)
    for extra in (0, 1, 5)
]


@pytest.mark.parametrize("kind", MESH_CLASSES)
def test_the_table_names_a_model_of_that_kind(kind):
    module, name = MESH_CLASSES[kind].split(":")
    model = getattr(import_module(module), name)
    assert model.model_fields["kind"].default == kind


@pytest.mark.parametrize(("generator", "size"), MESH_CASES)
def test_springs_join_two_vertices_once(generator, size):
    mesh = generator.build_mesh(size)
    pairs = Counter(frozenset(pair) for pair in mesh.springs.tolist())
    assert set(pairs.values()) == {1}
    assert all(len(pair) == 2 for pair in pairs)
    assert mesh.springs.min() == 0
    assert mesh.springs.max() == len(mesh.rest_positions) - 1


@pytest.mark.parametrize(("generator", "size"), MESH_CASES)
def test_families_are_a_partition_of_the_springs(generator, size):
    mesh = generator.build_mesh(size)
    assert set(mesh.spring_families) == {STRETCH, SHEAR, BEND}
    assert sorted(np.concatenate(list(mesh.spring_families.values()))) == list(range(len(mesh.springs)))


@pytest.mark.parametrize(("generator", "size"), MESH_CASES)
def test_the_vertices_are_as_many_as_announced_and_joined_in_one_piece(generator, size):
    mesh = generator.build_mesh(size)
    assert len(mesh.rest_positions) == generator.count_vertices(size)
    reached, frontier = {0}, {0}
    neighbours: dict[int, set[int]] = {}
    for i, j in mesh.springs.tolist():
        neighbours.setdefault(i, set()).add(j)
        neighbours.setdefault(j, set()).add(i)
    while frontier:
        frontier = set().union(*(neighbours[v] for v in frontier)) - reached
        reached |= frontier
    assert len(reached) == len(mesh.rest_positions)


@pytest.mark.parametrize(("generator", "size"), MESH_CASES)
def test_every_vertex_has_a_share_and_the_shares_sum_to_one(generator, size):
    mesh = generator.build_mesh(size)
    assert mesh.mass_fractions.shape == (len(mesh.rest_positions),)
    assert mesh.mass_fractions.min() > 0
    assert mesh.mass_fractions.sum() == pytest.approx(1, abs=ROUND_OFF)


@pytest.mark.parametrize(("generator", "size"), MESH_CASES)
def test_parts_are_sorted_vertices(generator, size):
    mesh = generator.build_mesh(size)
    assert mesh.parts
    for part in mesh.parts.values():
        assert len(part)
        assert np.all(np.diff(part) > 0)
        assert part[0] >= 0
        assert part[-1] < len(mesh.rest_positions)


@pytest.mark.parametrize(("generator", "size"), MESH_CASES)
def test_arrays_have_the_documented_types_and_are_read_only(generator, size):
    mesh = generator.build_mesh(size)
    assert mesh.rest_positions.dtype == np.float64
    assert mesh.rest_positions.flags.c_contiguous
    assert mesh.springs.dtype == mesh.triangles.dtype == np.int64
    for array in (
        mesh.rest_positions,
        mesh.springs,
        mesh.triangles,
        mesh.mass_fractions,
        *mesh.spring_families.values(),
        *mesh.parts.values(),
    ):
        assert not array.flags.writeable


@pytest.mark.parametrize(("generator", "size"), MESH_CASES)
def test_neighbouring_triangles_agree_on_their_orientation(generator, size):
    directed = Counter(directed_edges(generator.build_mesh(size)))
    assert set(directed.values()) <= {1}  # two triangles that agree pass their common side in opposite directions


@pytest.mark.parametrize(("generator", "size"), MESH_CASES)
def test_building_again_gives_the_same_mesh(generator, size):
    first, second = generator.build_mesh(size), generator.build_mesh(size)
    assert np.array_equal(first.rest_positions, second.rest_positions)
    assert np.array_equal(first.springs, second.springs)
    assert np.array_equal(first.triangles, second.triangles)


@pytest.mark.parametrize("generator", GENERATORS, ids=lambda g: type(g).__name__)
def test_the_extent_does_not_depend_on_the_size(generator):
    coarse, fine = generator.build_mesh(12), generator.build_mesh(24)
    # rings and spheres of 12 vertices miss the extreme points of a circle by at most 1 - cos(pi/12) = 3.4 %
    assert np.ptp(fine.rest_positions, axis=0) == pytest.approx(
        np.ptp(coarse.rest_positions, axis=0), rel=0.035, abs=ROUND_OFF
    )


@pytest.mark.parametrize("generator", GENERATORS, ids=lambda g: type(g).__name__)
def test_the_spacing_is_a_typical_rest_length_and_halves_with_twice_the_size(generator):
    coarse, fine = generator.build_mesh(8), generator.build_mesh(16)
    assert fine.rest_lengths.min() <= fine.spacing <= fine.rest_lengths.max()
    if not isinstance(generator, TowerMesh):  # its storeys get lower, its width stays
        assert 0.4 < fine.spacing / coarse.spacing < 0.6  # (8 - 1)/(16 - 1) = 0.47 and rounded row counts


@pytest.mark.parametrize(
    ("generator", "size", "volume", "tolerance"),
    [
        (BalloonMesh(radius=0.5), 16, np.pi / 6, 0.01),  # an inscribed polyhedron of 5120 facets lacks half a percent
        (BlockMesh(length=1.0, height=0.5, depth=0.4), 11, 0.2, ROUND_OFF),
    ],
    ids=repr,
)
def test_closed_surfaces_enclose_their_volume(generator, size, volume, tolerance):
    mesh = generator.build_mesh(size)
    edges = set(directed_edges(mesh))
    assert all((j, i) in edges for i, j in edges)
    a, b, c = (mesh.rest_positions[mesh.triangles[:, k]] for k in range(3))
    assert np.einsum("ij,ij->", np.cross(a, b), c) / 6 == pytest.approx(volume, rel=tolerance)


@pytest.mark.parametrize("generator", GENERATORS, ids=lambda g: type(g).__name__)
@pytest.mark.parametrize("size", [-3, 0, 10**9, 10**400], ids=["-3", "0", "1e9", "1e400"])
def test_senseless_sizes_are_refused_with_what_is_allowed(generator, size):
    with pytest.raises(InputError) as caught:
        generator.build_mesh(size)
    (mistake,) = caught.value.mistakes
    assert mistake.key == "size"
    assert mistake.problem.startswith(f"{size} ")
    assert f"{generator.MIN_SIZE} to " in mistake.problem


@pytest.mark.parametrize("generator", GENERATORS, ids=lambda g: type(g).__name__)
def test_the_largest_size_named_is_the_largest_that_fits(generator, monkeypatch):
    monkeypatch.setattr(memory, "compute_memory_limit", lambda: 2.0**40)  # so that memory is not what limits
    with pytest.raises(InputError) as caught:
        generator.build_mesh(generator.MIN_SIZE - 1)
    largest = int(str(caught.value).split(" to ")[1].split()[0])
    assert generator.count_vertices(largest) <= MAX_VERTICES < generator.count_vertices(largest + 1)


def directed_edges(mesh: Mesh) -> list[tuple[int, int]]:
    """The sides of the triangles in the direction in which they are passed."""
    return [pair for a, b, c in mesh.triangles.tolist() for pair in ((a, b), (b, c), (c, a))]
