"""Wind on triangles against the formulas of drag and lift, gusts against their statistics."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError
from springbench.harness.errors import InputError
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.effects.wind_effect import WindEffect
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.scenes.mesh.surface_meshes import BalloonMesh
from springbench.harness.simulation.time_loop import prepare, simulate_scene
from springbench.solvers.methods.local_global.reference_local_global import SparseLocalGlobal
from springbench.solvers.model.step_problem import Positions, StopRule

from tests.scene_builders import build_test_scene

PLATE = GridMesh(width=2.0, height=1.5, plane="vertical").build_mesh(5)
"""In the plane z = 0, 3 square metres."""
HEAVY = np.full(len(PLATE.rest_positions), 1e6)
"""Masses so large that no force is limited."""
STILL = np.zeros_like(PLATE.rest_positions)
RHO, AREA = 1.2, 3.0


def force(
    p: Positions = PLATE.rest_positions, v: Positions = STILL, t: float = 0.0, *, mass=HEAVY, dt=0.01, **wind
) -> Positions:
    (blow,) = WindEffect.model_validate({"acts_on": "triangle", **wind}).build_contribution(PLATE, mass, dt).forces
    return blow(p, v, t)


@pytest.mark.parametrize("angle", [0.0, 20.0, 45.0, 70.0, 90.0, 160.0, 200.0])
def test_a_plate_feels_drag_along_the_wind_and_lift_across_it(angle):
    """With the angle a between wind and normal: drag rho/2 A u^2 C_D cos a, lift rho/2 A u^2 C_L cos a sin a."""
    a, speed = np.deg2rad(angle), 7.0
    along = np.array([np.sin(a), 0.0, np.cos(a)])
    across = np.sign(np.cos(a)) * np.array([-np.cos(a), 0.0, np.sin(a)])
    # lift points to the side of the plate that the air leaves by
    across *= np.sign(across[2] * np.cos(a)) if abs(np.cos(a)) > 1e-9 else 1.0
    found = force(velocity=tuple(speed * along), drag_coefficient=1.1, lift_coefficient=0.6).sum(axis=0)
    pressure = RHO / 2 * AREA * speed**2 * abs(np.cos(a))
    expected = pressure * (1.1 * along + 0.6 * abs(np.sin(a)) * across)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13 * RHO * AREA * speed**2)  # sums of 32 triangles


def test_only_the_velocity_of_the_air_relative_to_the_triangle_counts():
    v = np.tile([1.0, -2.0, 3.0], (len(PLATE.rest_positions), 1))
    one = force(velocity=(4.0, 1.0, 5.0), lift_coefficient=0.3)
    two = force(velocity=(5.0, -1.0, 8.0), v=v, lift_coefficient=0.3)
    np.testing.assert_allclose(one, two, rtol=1e-13)
    assert not force(velocity=(1.0, -2.0, 3.0), v=v).any()


def test_the_force_does_not_depend_on_the_orientation_of_triangles():
    mirrored = PLATE.rest_positions * [-1.0, 1.0, 1.0]  # their normals now point the other way
    found, expected = (
        force(p, velocity=(0.0, 0.0, 5.0), lift_coefficient=0.4) for p in (mirrored, PLATE.rest_positions)
    )
    np.testing.assert_allclose(found, expected, rtol=1e-13)


def test_a_sheet_falls_at_the_speed_at_which_drag_carries_it():
    """Air at rest: m g = rho/2 A C_D v^2."""
    wind = WindEffect(acts_on="triangle", velocity=(0.0, 0.0, 0.0), drag_coefficient=1.3)
    made = build_test_scene(
        GridMesh(), SpringsEffect(stretch=100.0), GravityEffect(), wind, size=5, mass=0.4, time_step=0.01
    )
    *_, last = simulate_scene(
        made, prepare(made, SparseLocalGlobal()), StopRule(10), initial_guess="inertial", frames=600
    )
    expected = (2 * 0.4 * 9.81 / (RHO * 1.3)) ** 0.5
    fall = -made.system.mass @ last.state.motion.velocity[:, 1] / 0.4
    assert fall == pytest.approx(expected, rel=1e-3)  # the sheet is a little bent, since its rim is lighter


def test_no_triangle_is_blown_faster_than_the_air():
    """A sheet of a gram in a storm of 100 m/s, with steps in which drag alone would throw it back and forth."""
    made = build_test_scene(
        GridMesh(),
        SpringsEffect(stretch=50.0),
        WindEffect(acts_on="triangle", velocity=(0.0, 100.0, 0.0)),
        PinsEffect(parts=("top",)),
        size=6,
        mass=1e-3,
    )
    run = simulate_scene(made, prepare(made, SparseLocalGlobal()), StopRule(50), initial_guess="previous", frames=60)
    for step in run:
        assert np.abs(step.state.motion.velocity).max() <= 200.0  # of the air, and of springs let loose
    free = build_test_scene(GridMesh(), WindEffect(acts_on="triangle", velocity=(0.0, 100.0, 0.0)), size=6, mass=1e-3)
    run = simulate_scene(free, prepare(free, SparseLocalGlobal()), StopRule(1), initial_guess="previous", frames=5)
    for step in run:
        speed = step.state.motion.velocity[:, 1]
        assert np.all((speed > 0.0) & (speed <= 100.0 * (1 + 1e-9)))


def test_a_closed_surface_in_a_wind_is_pushed_along_it():
    mesh = BalloonMesh().build_mesh(6)
    wind = WindEffect(acts_on="triangle", velocity=(10.0, 0.0, 0.0))
    (blow,) = wind.build_contribution(mesh, np.full(len(mesh.rest_positions), 1e6), 0.01).forces
    total = blow(mesh.rest_positions, np.zeros_like(mesh.rest_positions), 0.0).sum(axis=0)
    # Front and back face the air with pi r^2 each; the mesh is inside the sphere by less than 2 %.
    assert total[0] == pytest.approx(2 * RHO / 2 * np.pi * 0.25 * 100.0, rel=0.02)
    assert np.abs(total[1:]).max() <= 1e-10 * total[0]


def gusts(**changed) -> WindEffect:
    return WindEffect.model_validate({"field": "gusts", "acts_on": "triangle", "velocity": (6.0, 0.0, 8.0), **changed})


def speeds(wind: WindEffect, times: np.ndarray) -> np.ndarray:
    """The air's velocity in the middle of the plate, by the drag of a plate that faces it (k, 3)."""
    (blow,) = wind.build_contribution(PLATE, HEAVY, 0.01).forces
    total = np.array([blow(PLATE.rest_positions, STILL, t).sum(axis=0) for t in times])
    # f = rho/2 A u_z u
    uz = np.sqrt(total[:, 2] / (RHO / 2 * AREA))
    return total / (RHO / 2 * AREA * uz)[:, None]


def test_gusts_are_smooth_and_determined_by_their_seed():
    times = np.linspace(0.0, 2.0, 201)
    one, again, other = (speeds(gusts(seed=seed), times) for seed in (3, 3, 4))
    np.testing.assert_array_equal(one, again)
    assert np.abs(one - other).max() > 1.0
    # rms 3 m/s, at no more than 4 Hz: 0.25 radians in a hundredth of a second
    assert np.abs(np.diff(one, axis=0)).max() < 3.0 * 3.0 * 0.25


def test_gusts_vary_by_their_fraction_about_the_mean():
    found = speeds(gusts(turbulence_intensity=0.1, frequency=0.2), np.linspace(0.0, 2000.0, 4000))
    # The slowest wave has a twentieth of a hertz: 100 of its periods average to a hundredth of its height. The shortest
    # is 12 m long, so that the plate feels all of it in one phase, but for one part in a hundred.
    np.testing.assert_allclose(found.mean(axis=0), [6.0, 0.0, 8.0], rtol=0, atol=0.05)
    # Two of the sixteen waves whose frequencies nearly agree beat for as long as this: an eighth of the mean square.
    np.testing.assert_allclose(found.std(axis=0), 0.1 * 10.0, rtol=0.07)


def test_gusts_of_nothing_are_the_constant_wind():
    expected = force(velocity=(6.0, 0.0, 8.0))
    np.testing.assert_allclose(
        force(velocity=(6.0, 0.0, 8.0), field="gusts", turbulence_intensity=0.0), expected, rtol=1e-14
    )


def test_gusts_of_still_air_are_still_air():
    v = np.tile([1.0, -2.0, 3.0], (len(PLATE.rest_positions), 1))
    still = {"velocity": (0.0, 0.0, 0.0), "v": v}
    np.testing.assert_array_equal(force(field="gusts", **still), force(**still))


def test_gusts_on_vertices_have_the_force_as_their_mean():
    (blow,) = (
        WindEffect(field="gusts", force=(2.0, 0.0, 0.0), turbulence_intensity=0.2)
        .build_contribution(PLATE, HEAVY, 0.01)
        .forces
    )
    total = np.array([blow(PLATE.rest_positions, STILL, t).sum(axis=0) for t in np.linspace(0.0, 200.0, 2000)])
    # As above; the plate is as long as a fortieth to a half of the waves, which averages their height down.
    np.testing.assert_allclose(total.mean(axis=0), [2.0, 0.0, 0.0], rtol=0, atol=0.03)
    assert np.all((total.std(axis=0) > 0.2) & (total.std(axis=0) <= 0.45))


def test_the_assignments_field_on_triangles_is_a_velocity():
    found = force(field="assignment", t=1.7).sum(axis=0)
    phi = PLATE.rest_positions[PLATE.triangles].mean(axis=1)[:, 0] / 2.5 + 1.7
    u = np.stack([3 + 1.5 * (1 + np.cos(5 * phi)), 1 + np.cos(0.3 + phi), np.sin(phi)], axis=1)
    expected = (RHO / 2 * AREA / len(phi) * np.abs(u[:, [2]]) * u).sum(axis=0)
    np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.parametrize(
    "wind",
    [
        {"strength": 0.0},
        {"strength": 0.0, "acts_on": "triangle"},
        {"acts_on": "triangle", "air_density": 0.0},
        {"acts_on": "triangle", "drag_coefficient": 0.0, "lift_coefficient": 0.0},
        {"field": "gusts", "force": (0.0, 0.0, 0.0)},
    ],
    ids=str,
)
def test_wind_of_nothing_leaves_nothing(wind):
    assert WindEffect.model_validate(wind).build_contribution(PLATE, HEAVY, 0.01).is_empty


@pytest.mark.parametrize(
    ("wind", "key"),
    [
        ({"acts_on": "triangle", "force": (1, 0, 0)}, "force"),
        ({"velocity": (1, 0, 0)}, "velocity"),
        ({"lift_coefficient": 1.0}, "lift_coefficient"),
        ({"seed": 1}, "seed"),
        ({"field": "assignment", "force": (1, 0, 0)}, "force"),
    ],
    ids=str,
)
def test_invalid_keys_are_refused(wind, key):
    with pytest.raises(ValidationError, match=f"`{key}` has no meaning"):
        WindEffect.model_validate(wind)


def test_wind_on_triangles_needs_triangles():
    with pytest.raises(InputError, match="needs triangles"):
        WindEffect(acts_on="triangle").build_contribution(ChainMesh().build_mesh(3), np.ones(3), 0.1)
