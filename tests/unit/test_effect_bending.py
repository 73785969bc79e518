"""Bending against beams and plates, and what it refuses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from springbench.harness.errors import InputError
from springbench.harness.scenes.effects.bending_effect import BendingEffect
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.scenes.mesh.surface_meshes import BalloonMesh
from springbench.harness.scenes.vertex_selectors import BoxRegion
from springbench.solvers.model.energies.bending_energy import Bending as Energy
from springbench.solvers.model.energies.bending_energy import find_flaps

from tests.effect_scenes import compute_rest_shape
from tests.scene_builders import build_test_scene

B, G = 0.01, 9.81
LOAD = 1e-3 * 8 * B
"""Weight of a square metre [N] that makes a cantilever of one metre give way by q L^4 / 8 B = 1 mm."""


def tip(segments: int, width: float, plane: str = "horizontal") -> float:
    """How far the end of a strip of one metre sinks [m] whose first two columns of vertices are pinned."""
    h = 1.0 / segments
    pins = PinsEffect(box=BoxRegion(low=(-0.5, -1, -1), high=(-0.5 + 1.01 * h, 1, 1)), weight="exact")
    made = build_test_scene(
        GridMesh(width=1.0, height=width),
        SpringsEffect(stretch=1e4),
        GravityEffect(),
        BendingEffect(stiffness=B),
        pins,
        size=segments + 1,
        mass=LOAD / G * width,
    )
    return -compute_rest_shape(made)[made.mesh.parts["right"], 1].mean()


@pytest.mark.parametrize("width", [None, 0.125, 0.25], ids=["one cell", "an eighth", "a quarter"])
def test_a_cantilever_tends_to_the_beam_formula(width):
    """The beam of length L = 1 - h is clamped somewhere between the columns that are pinned: an error of order h."""
    segments = (16, 32, 64)
    error = [tip(k, width or 1 / k) / (LOAD * (1 - 1 / k) ** 4 / (8 * B)) - 1 for k in segments]
    assert 0 < error[2] <= 0.05
    # The order is one: 4 (h/2) / L is the leading term, the next smaller by some h / L.
    np.testing.assert_allclose([error[0] / error[1], error[1] / error[2]], 2.0, rtol=0.1)


def test_a_cantilever_clamped_halfway_between_its_pins_is_a_beam_to_a_thousandth():
    # A hinge stands for the half cells on both of its sides, so the clamp is half a cell before the last pin.
    assert tip(64, 0.125) == pytest.approx(LOAD * (1 - 0.5 / 64) ** 4 / (8 * B), rel=1e-3)  # of order h^2


@pytest.mark.parametrize("angle", [0, 30, 45, 60, 90, 135])
def test_a_cylinder_has_the_energy_of_its_curvature_along_the_lines_and_twice_that_along_the_diagonals(angle):
    mesh = GridMesh().build_mesh(41)
    e = np.array([np.cos(np.deg2rad(angle)), 0.0, np.sin(np.deg2rad(angle))])
    p, curvature = mesh.rest_positions.copy(), 1e-2
    p[:, 1] = 0.5 * curvature * (mesh.rest_positions @ e) ** 2
    found = Energy.from_rest_shape(mesh.rest_positions, mesh.triangles, B).value(p) / (0.5 * B * curvature**2)
    # k_xx^2 + k_zz^2 + 6 k_xz^2; the outermost of 40 cells count half, along which nothing is hinged.
    assert found == pytest.approx(1 + np.sin(np.deg2rad(2 * angle)) ** 2, rel=1.5 / 40)


def test_bending_does_not_depend_on_place_or_stretch_of_a_surface():
    mesh = GridMesh(plane="vertical").build_mesh(9)
    energy = Energy.from_rest_shape(mesh.rest_positions, mesh.triangles, B)
    affine = np.random.default_rng(0).normal(size=(3, 3))
    # Cotangents of order one, times positions of order ten, leave round-off of 1e-15, squared, at 352 flaps.
    assert energy.value(mesh.rest_positions @ affine + 5.0) <= 352 * 1e-29


def test_either_diagonal_of_the_cells_makes_the_same_energy():
    mesh = GridMesh().build_mesh(7)
    mirrored = mesh.rest_positions * [-1.0, 1.0, 1.0]
    p = mesh.rest_positions + 0.1 * np.random.default_rng(0).normal(size=mesh.rest_positions.shape)
    one, two = (Energy.from_rest_shape(rest, mesh.triangles, B).value(p) for rest in (mesh.rest_positions, mirrored))
    assert one == pytest.approx(two, rel=1e-12)  # the order of sums
    index = np.arange(49).reshape(7, 7)[:, ::-1]  # the cells cut the other way
    assert Energy.from_rest_shape(mesh.rest_positions, index.ravel()[mesh.triangles], B).value(p) == pytest.approx(
        one, rel=1e-12
    )


def test_each_inner_edge_has_one_flap():
    triangles = BalloonMesh().build_mesh(3).triangles
    flap = find_flaps(triangles)
    assert len(flap) == 3 * len(triangles) // 2
    assert {tuple(sorted(f[[0, 1, 2]])) for f in flap} <= {tuple(sorted(t)) for t in triangles}
    assert len(find_flaps(np.array([[0, 1, 2]]))) == 0


BAD = {
    "a chain": (ChainMesh().build_mesh(4), "needs triangles"),
    "a triangle of no area": (
        replace(GridMesh().build_mesh(3), triangles=np.array([[0, 1, 2]])),
        r"\[0, 1, 2\] has no area",
    ),
    "three triangles at an edge": (
        replace(GridMesh().build_mesh(3), triangles=np.array([[0, 1, 3], [0, 1, 4], [0, 1, 6]])),
        r"more than two triangles meet at the edge \[0, 1\]",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_a_mesh_that_is_no_surface_is_refused(case):
    mesh, message = BAD[case]
    with pytest.raises(InputError, match=message):
        BendingEffect(stiffness=1.0).build_contribution(mesh, np.ones(len(mesh.rest_positions)), 0.1)
