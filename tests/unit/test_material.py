"""Stiffness rules: their formulas, and that the continuum's material does not change with the mesh size."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.linalg import spsolve
from springbench.harness.errors import InputError
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.scenes.mesh.grid_mesh import GridMesh, NetMesh
from springbench.harness.scenes.mesh.mesh import BEND, SHEAR, STRETCH, Mesh
from springbench.harness.scenes.mesh.mesh_generator import MeshGenerator
from springbench.harness.scenes.mesh.solid_meshes import BlockMesh, TowerMesh
from springbench.harness.scenes.mesh.surface_meshes import BalloonMesh, SkirtMesh
from springbench.harness.scenes.orthotropic_cloth import OrthotropicStiffness
from springbench.harness.scenes.spring_stiffness import SCALING_RULES, compute_spring_stiffness

ROUND_OFF = 1e-9
"""Relative error of a sparse solve with a few thousand unknowns and a condition number below 1e6."""


def pull(mesh: Mesh, k: np.ndarray, *, fixed: np.ndarray, moved: np.ndarray, axis: int) -> float:
    """The force [N] that displaces `moved` by 1 m along `axis` while `fixed` stays, by the linear theory.

    K = sum_e k_e n_e n_e' over the directions n_e of the springs at rest; coordinates of no stiffness stay put.
    """
    i, j = mesh.springs.T
    direction = (mesh.rest_positions[i] - mesh.rest_positions[j]) / mesh.rest_lengths[:, None]
    blocks = k[:, None, None] * direction[:, :, None] * direction[:, None, :]
    rows, columns, values = [], [], []
    for a, b, sign in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)):
        rows.append(np.broadcast_to(3 * a[:, None, None] + np.arange(3)[None, :, None], blocks.shape).ravel())
        columns.append(np.broadcast_to(3 * b[:, None, None] + np.arange(3)[None, None, :], blocks.shape).ravel())
        values.append(sign * blocks.ravel())
    n = 3 * len(mesh.rest_positions)
    stiffness = coo_array((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), (n, n)).tocsr()
    u = np.zeros(n)
    u[3 * moved + axis] = 1.0
    pinned = np.concatenate([3 * fixed + axis, 3 * moved + axis, 3 * fixed[:1], 3 * fixed[:1] + 1, 3 * fixed[:1] + 2])
    flat = np.flatnonzero(np.ptp(mesh.rest_positions, axis=0) == 0)
    pinned = np.concatenate([pinned, *(np.arange(c, n, 3) for c in flat)])
    if mesh.dimension == 3:  # the last rigid motion, a turn about the axis
        pinned = np.append(pinned, 3 * fixed[-1] + (2 if axis == 0 else 0))
    free = np.setdiff1d(np.arange(n), pinned)
    if len(free):
        u[free] = np.asarray(spsolve(stiffness[free][:, free].tocsc(), -(stiffness @ u)[free]))
    return float((stiffness @ u)[3 * moved + axis].sum())


def test_a_woven_cloth_resists_by_warp_weft_and_bias():
    mesh, weave = (
        GridMesh(diagonals="both").build_mesh(9),
        OrthotropicStiffness(warp=400.0, weft=100.0, bias=25.0, direction=(0.0, 0.0, -2.0)),
    )
    k = compute_spring_stiffness(mesh, scaling_rule="continuum", stretch=weave, shear=weave, bend=0.0)
    i, j = mesh.springs.T
    across, down = np.abs(mesh.rest_positions[i] - mesh.rest_positions[j])[:, [0, 2]].T > 1e-9
    expected = np.where(across & down, 25.0, np.where(down, 400.0, 100.0))
    np.testing.assert_allclose(k, expected, rtol=1e-12)
    turned = OrthotropicStiffness(warp=400.0, weft=100.0, bias=25.0, direction=(1.0, 0.0, 0.0))
    at_angles = turned.compute_stiffness(mesh, np.array([[0, 1], [0, 10], [0, 11], [0, 19], [0, 9]]))
    # At atan(1/2), cos 2 theta is 3/5: .36 of the warp, or of the weft, and .64 of the bias.
    np.testing.assert_allclose(at_angles, [400.0, 25.0, 160.0, 52.0, 100.0], rtol=1e-12)


def test_a_weave_needs_a_surface_along_its_warp():
    up = OrthotropicStiffness(warp=1.0, weft=1.0, bias=1.0, direction=(0.0, 1.0, 0.0))
    for mesh, message in (
        (ChainMesh().build_mesh(3), "need a mesh of triangles"),
        (GridMesh().build_mesh(3), "stands upright on the mesh"),
    ):
        with pytest.raises(InputError, match=message):
            up.compute_stiffness(mesh, mesh.springs)


def membrane(size: int, **material) -> float:
    """Pulls a cloth of 1 m x 0.5 m along its length."""
    mesh = GridMesh(width=1.0, height=0.5, diagonals="both", bend_springs=material.get("bend", 0) > 0).build_mesh(size)
    k = compute_spring_stiffness(
        mesh, **({"scaling_rule": "continuum", "stretch": 100.0, "shear": 50.0, "bend": 0.0} | material)
    )
    return pull(mesh, k, fixed=mesh.parts["left"], moved=mesh.parts["right"], axis=0)


def block(size: int, rule: str = "continuum") -> float:
    """Pulls a block of 1 m x 0.5 m x 0.5 m along its length."""
    mesh = BlockMesh(length=1.0, height=0.5, depth=0.5).build_mesh(size)
    k = compute_spring_stiffness(mesh, scaling_rule=rule, stretch=1000.0, shear=400.0, bend=0.0)
    return pull(mesh, k, fixed=mesh.parts["left"], moved=mesh.parts["right"], axis=0)


@pytest.mark.parametrize("size", [2, 3, 10, 101])
def test_a_chain_of_any_size_is_the_same_spring(size):
    mesh = ChainMesh(length=2.0).build_mesh(size)
    k = compute_spring_stiffness(mesh, scaling_rule="continuum", stretch=50.0, shear=0.0, bend=0.0)
    assert 1 / np.sum(1 / k) == pytest.approx(50.0 / 2.0, rel=ROUND_OFF)  # EA / L
    assert pull(mesh, k, fixed=mesh.parts["first"], moved=mesh.parts["last"], axis=0) == pytest.approx(25.0)


@pytest.mark.parametrize("size", [3, 5, 9])
def test_a_cloth_of_threads_alone_has_the_membrane_stiffness_of_its_constant(size):
    # threads along the pull at 1/h a metre and one more at the edge: k (W/h + 1) h / L; its limit is k W / L
    h = 1 / (size - 1)
    mesh = GridMesh(diagonals="none").build_mesh(size)
    k = compute_spring_stiffness(mesh, scaling_rule="continuum", stretch=100.0, shear=0.0, bend=0.0)
    along = k[mesh.spring_families[STRETCH]][: size * (size - 1)]
    assert along.sum() * h**2 == pytest.approx(100.0 * (1 + h))


@pytest.mark.parametrize(
    ("measure", "sizes", "limit"),
    [
        # C11 = stretch + shear = 150, C12 = shear = 50 N/m; (C11 - C12^2 / C11) of width 0.5 m over 1 m
        (membrane, (5, 9, 17), (150 - 50**2 / 150) * 0.5),
        # C11 = stretch + (2 + 4/3) shear = 7000/3, C12 = (1 + 4/3) shear = 2800/3 Pa; Young's modulus by 0.25 m^2
        (block, (5, 9, 13), (7000 - 2 * 2800**2 / (7000 + 2800)) / 3 * 0.25),
    ],
)
def test_stretched_cloth_and_blocks_tend_to_the_continuum_of_their_lattice(measure, sizes, limit):
    forces = [measure(size) for size in sizes]
    assert all(a > b > limit for a, b in pairwise(forces))  # half-empty cells at the surface make coarse ones stiff
    surplus = [force / limit - 1 for force in forces]
    spacings = [1 / (size - 1) for size in sizes]
    sides = 1 if measure is membrane else 2
    assert all(s <= (1 + h / 0.5) ** sides - 1 for s, h in zip(surplus, spacings, strict=True))
    # a parabola through three sizes, continued to h = 0; what is left is of third order, 0.001 to 0.01
    assert np.polyfit(spacings, forces, 2)[-1] == pytest.approx(limit, rel=0.003)


@pytest.mark.parametrize("t", [0.05, 1.0])
def test_a_fold_stores_the_bending_energy_of_the_rule(t):
    # a sheet folded along its middle column; the exact shortening replaces its leading order, which at
    # t = 1 rad is 1 % off: 2 (1 - cos(1/2)) = 0.2448 against 1/4, hence 4 % in energy; edge rows count fully
    size, bending = 21, 3e-4
    mesh = GridMesh(diagonals="none", bend_springs=True).build_mesh(size)
    k = compute_spring_stiffness(mesh, scaling_rule="continuum", stretch=10.0, shear=0.0, bend=bending)
    folded = mesh.rest_positions.copy()
    right = mesh.rest_positions[:, 0] > 1e-9
    folded[right] = mesh.rest_positions[right] * [np.cos(t), 1, 1] + np.outer(
        mesh.rest_positions[right, 0], [0, np.sin(t), 0]
    )
    i, j = mesh.springs.T
    energy = 0.5 * k @ (np.linalg.norm(folded[i] - folded[j], axis=1) - mesh.rest_lengths) ** 2
    h, rows = mesh.spacing, size
    continuum = bending * t**2 / (2 * h) * rows * h
    assert energy == pytest.approx(continuum * t**2, rel=0.045)


@pytest.mark.parametrize("bend", [0.0, 1e-4, 5e-4])
def test_bending_leaves_the_membrane_stiffness_as_it_is(bend):
    mesh = GridMesh(diagonals="none", bend_springs=True).build_mesh(41)
    k = compute_spring_stiffness(mesh, scaling_rule="continuum", stretch=100.0, shear=0.0, bend=bend)
    assert k[mesh.spring_families[BEND]] == pytest.approx(16 * bend / mesh.spacing**2)
    strain = mesh.rest_positions * [0.01, 0, 0]
    i, j = mesh.springs.T
    longer = np.abs(strain[i] - strain[j])[:, 0]
    stiffness = 2 * (0.5 * k @ longer**2) / 0.01**2  # energy of a square metre = 1/2 stiffness strain^2
    assert stiffness == pytest.approx(100.0 * 41 / 40, rel=ROUND_OFF)  # a row too many


def test_a_mesh_too_fine_for_its_bending_stiffness_is_refused_with_the_figures():
    # 64 B / h^2 = 64 0.01 20^2 = 256 N/m against 100; 8 sqrt(0.01 / 100) = 0.08 m
    with pytest.raises(InputError, match=r"256 N/m.*0\.05 m.*100 N/m.*at least 0\.08 m"):
        compute_spring_stiffness(
            GridMesh(bend_springs=True).build_mesh(21), scaling_rule="continuum", stretch=100.0, shear=0.0, bend=0.01
        )


@pytest.mark.parametrize(
    ("generator", "stretch", "shear", "bend"),
    [
        (ChainMesh(length=3.0), lambda h: 1 / h, None, None),
        (GridMesh(), lambda h: 1.0, lambda h: 1.0, None),
        (NetMesh(), lambda h: 1.0, None, None),
        (SkirtMesh(), lambda h: 1.0, lambda h: 1.0, None),
        (BalloonMesh(), lambda h: 1.0, None, None),
        (BlockMesh(), lambda h: h, lambda h: h, None),
    ],
    ids=lambda case: type(case).__name__,
)
def test_continuum_stiffness_follows_the_dimension(generator, stretch, shear, bend):
    mesh = generator.build_mesh(7)
    k = compute_spring_stiffness(mesh, scaling_rule="continuum", stretch=2.0, shear=3.0, bend=2e-4)
    for family, constant, scale in ((STRETCH, 2.0, stretch), (SHEAR, 3.0, shear), (BEND, 2e-4, bend)):
        springs = mesh.spring_families[family]
        assert (scale is None) == (not len(springs))
        if scale:
            assert k[springs] == pytest.approx(constant * scale(mesh.spacing))


def test_the_members_of_a_truss_are_bars():
    mesh = TowerMesh().build_mesh(3)
    k = compute_spring_stiffness(mesh, scaling_rule="continuum", stretch=2.0, shear=2.0, bend=0.0)
    assert k * mesh.rest_lengths == pytest.approx(2.0)


@pytest.mark.parametrize(
    "generator", [ChainMesh(), GridMesh(bend_springs=True), TowerMesh(), BlockMesh()], ids=lambda g: type(g).__name__
)
def test_fixed_stiffness_is_taken_as_it_is(generator: MeshGenerator):
    mesh = generator.build_mesh(6)
    k = compute_spring_stiffness(mesh, scaling_rule="fixed", stretch=2.0, shear=0.0, bend=5.0)
    for family, constant in ((STRETCH, 2.0), (SHEAR, 0.0), (BEND, 5.0)):
        assert np.all(k[mesh.spring_families[family]] == constant)


@pytest.mark.parametrize(("size", "k"), [(11, 150), (21, 300), (41, 600), (81, 1200)])
def test_the_rule_of_liu_2013_gives_the_stiffness_of_their_figure(size, k):
    mesh = GridMesh(diagonals="one").build_mesh(size)
    assert np.all(
        compute_spring_stiffness(mesh, scaling_rule="liu2013", stretch=300.0, shear=300.0, bend=0.0, reference_size=21)
        == k
    )


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"scaling_rule": "continum"}, "scaling_rule"),
        ({"scaling_rule": "liu2013"}, "reference_size"),
        ({"scaling_rule": "liu2013", "reference_size": 1}, "reference_size"),
        ({"scaling_rule": "fixed", "reference_size": 10}, "reference_size"),
        ({"stretch": -1.0}, "stretch"),
        ({"shear": float("nan")}, "shear"),
        ({"bend": float("inf")}, "bend"),
    ],
)
def test_senseless_materials_are_refused(changes, key):
    arguments = {"scaling_rule": "fixed", "stretch": 1.0, "shear": 1.0, "bend": 1.0} | changes
    with pytest.raises(InputError) as caught:
        compute_spring_stiffness(GridMesh().build_mesh(3), **arguments)
    assert caught.value.mistakes[0].key == key


@pytest.mark.parametrize(
    "mesh", [replace(GridMesh().build_mesh(3), resolution=0), BalloonMesh().build_mesh(1)], ids=["file", "size 1"]
)
def test_the_rule_of_liu_2013_needs_a_mesh_that_has_a_size(mesh):
    with pytest.raises(InputError, match="use fixed or continuum"):
        compute_spring_stiffness(mesh, scaling_rule="liu2013", stretch=1.0, shear=1.0, bend=0.0, reference_size=10)


def test_a_bar_without_length_has_no_continuum_stiffness():
    chain = ChainMesh().build_mesh(3)
    collapsed = replace(chain, rest_positions=np.zeros((3, 3)))
    with pytest.raises(InputError, match="two vertices in one place"):
        compute_spring_stiffness(collapsed, scaling_rule="continuum", stretch=1.0, shear=1.0, bend=0.0)


def test_the_rules_are_those_a_scene_may_name():
    assert set(SCALING_RULES) == {"fixed", "continuum", "area", "liu2013"}
