"""Reference trajectories: against closed forms, against the assignment's scenes, and refused where nothing is known."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from springbench.harness.config.config_loader import load_scene
from springbench.harness.errors import RunFailed
from springbench.harness.reference import equations_of_motion, reference_store
from springbench.harness.reference.equations_of_motion import NotIntegrable, OdeField
from springbench.harness.reference.reference_store import ReferenceStore
from springbench.harness.reference.reference_trajectory import (
    ReferenceTrajectory,
    UnpredictableMotion,
    integrate_motion,
)
from springbench.harness.reference.step_snapshot import build_exact_scene
from springbench.harness.scenes.effects.air_drag_effect import AirDragEffect
from springbench.harness.scenes.effects.dashpots_effect import DashpotsEffect
from springbench.harness.scenes.effects.effect_interface import SceneEffect
from springbench.harness.scenes.effects.ether_drag_effect import EtherDragEffect
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.effects.wind_effect import WindEffect
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.scenes.scene_spec import MeshSource, SceneSpec
from springbench.harness.simulation.time_loop import prepare, simulate_scene
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.step_problem import StopRule

SHARED_SCENES = Path(__file__).resolve().parents[3] / "shared" / "scenes"
G = 9.81
TIMES = (0.3, 0.8)


def spec(mesh: MeshSource, *effects: SceneEffect, velocity=(0.0, 0.0, 0.0), time_step: float = 1 / 30) -> SceneSpec:
    given = {"mesh": mesh, "effects": effects, "velocity": velocity, "time_step": time_step}
    return SceneSpec(mass=2.0, frames=30, path=Path("scene.yaml"), **given)


def build_unit_scene(mesh: MeshSource, *effects: SceneEffect, size: int, velocity=(0.0, 0.0, 0.0)) -> Scene:
    return build_exact_scene(spec(mesh, *effects, velocity=velocity), size)


K, C, SPEED = 40.0, 1.5, 0.4
SPRING, FIRST_PIN = SpringsEffect(scaling_rule="fixed", stretch=K), PinsEffect(parts=("first",))
MOVING_PIN = PinsEffect.model_validate(
    {"parts": ["first"], "motion": {"key_frames": [{"time": 0.0}, {"time": 9.0, "offset": [9.0 * SPEED, 0.0, 0.0]}]}}
)


def move_damped(t: np.ndarray, rate: float) -> np.ndarray:
    """u'' + rate u' + K u = 0 with u(0) = 0 and u'(0) = SPEED, of a mass of 1 kg."""
    omega = np.sqrt(K - rate**2 / 4.0)
    return SPEED / omega * np.exp(-0.5 * rate * t) * np.sin(omega * t)


FAST = (SPEED, 0.0, 0.0)
ALONG = {  # the place of the second vertex of two along x, each of 1 kg, less 1 m
    "spring": ((SPRING, FIRST_PIN), FAST, lambda t: move_damped(t, 0.0)),
    "spring and ether drag": ((SPRING, FIRST_PIN, EtherDragEffect(decay_rate=C)), FAST, lambda t: move_damped(t, C)),
    "spring and air drag": ((SPRING, FIRST_PIN, AirDragEffect(coefficient=2.0 * C)), FAST, lambda t: move_damped(t, C)),
    "spring and dashpot": (
        (SPRING, FIRST_PIN, DashpotsEffect(scaling_rule="fixed", stretch=C)), FAST, lambda t: move_damped(t, C)
    ),
    "ether drag": ((EtherDragEffect(decay_rate=C),), FAST, lambda t: SPEED / C * (1.0 - np.exp(-C * t))),
    "spring whose pin moves": ((SPRING, MOVING_PIN), (0.0, 0.0, 0.0), lambda t: SPEED * t - move_damped(t, 0.0)),
    "dashpot whose pin moves": (
        (SPRING, DashpotsEffect(scaling_rule="fixed", stretch=C), MOVING_PIN),
        (0.0, 0.0, 0.0), lambda t: SPEED * t - move_damped(t, C),
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", ALONG)
def test_a_mass_on_a_line_follows_the_closed_form_of_its_equation(case):
    effects, velocity, expected = ALONG[case]
    found = integrate_motion(build_unit_scene(ChainMesh(), *effects, size=2, velocity=velocity), TIMES)
    # rtol 1e-12 a step, some hundred steps. A dashpot feels the pin's start, which is rounded over 1e-5 s: the impulse
    # of half of its pull in that time is 3e-6 N s.
    atol = 3e-6 if "dashpot whose" in case else 1e-11
    np.testing.assert_allclose(found.positions[:, 1, 0] - 1.0, expected(np.array(TIMES)), rtol=0, atol=atol)
    assert found.disagreement.max() < 1e-8
    found.require_accuracy(1e-6)


def test_free_fall_is_a_parabola_and_the_velocity_its_slope():
    found = integrate_motion(
        build_unit_scene(GridMesh(), SpringsEffect(stretch=100.0), GravityEffect(), size=3, velocity=(1.0, 2.0, 0.0)),
        TIMES,
    )
    rest = build_unit_scene(GridMesh(), size=3).mesh.rest_positions
    for k, t in enumerate(TIMES):
        moved = [t, 2.0 * t - 0.5 * G * t**2, 0.0]
        np.testing.assert_allclose(found.positions[k], rest + moved, rtol=0, atol=1e-11)
        np.testing.assert_allclose(found.velocities[k], np.tile([1.0, 2.0 - G * t, 0.0], (9, 1)), rtol=0, atol=1e-10)
        assert found.displacement[k] == pytest.approx(3.0 * np.linalg.norm(moved), rel=1e-9)  # nine vertices, all free


def test_the_acceleration_is_the_force_of_the_scene_over_the_mass():
    """Springs of zero length and twins included; wind, which is a force of place and time, too."""
    scene = build_unit_scene(
        GridMesh(),
        SpringsEffect(stretch=70.0, shear=9.0),
        GravityEffect(),
        WindEffect(field="assignment"),
        PINNED_CORNERS,
        size=4,
    )
    field, rng = OdeField(scene), np.random.default_rng(0)
    free, m = scene.system.free_vertices, scene.system.mass[:, None]
    for trial in range(4):
        y = field.initial_state + 0.3 * rng.normal(size=field.initial_state.shape)
        if trial == 3:
            y[3:6] = y[0:3]
        p, v = (part.copy() for part in field.unpack_state(0.7, y))
        force = scene.constant_force + sum(f(p, v, 0.7) for f in scene.varying_forces)
        gradient = np.zeros_like(p)
        scene.all_springs.add_gradient(p, gradient)
        expected = np.concatenate([v[free].ravel(), ((force - gradient) / m)[free].ravel()])
        np.testing.assert_allclose(field(0.7, y), expected, rtol=1e-12, atol=1e-10)  # sums of terms of some hundred


PINNED_CORNERS = PinsEffect(parts=("corners",))

# The position errors at 1 s that a prototype found, relative to the displacement from the start.
KNOWN_ERRORS = {
    "single-spring-horizontal": {"implicit-euler": 0.18, "bdf2": 0.020, "midpoint": 0.0034},
    "horizontal-chain": {"implicit-euler": 1.61, "bdf2": 0.31, "midpoint": 0.196},
    "net": {"implicit-euler": 0.80, "bdf2": 0.20, "midpoint": 0.11},
}


@pytest.mark.parametrize("name", KNOWN_ERRORS)
def test_the_assignments_scenes_have_the_known_errors_of_time_stepping(name):
    if not SHARED_SCENES.is_dir():
        pytest.skip("the assignment's scenes lie in a folder `shared` next to the repository, which is not there")
    scene = load_scene(SHARED_SCENES / f"{name}.json")
    truth = integrate_motion(build_exact_scene(scene, 0), [1.0])
    truth.require_accuracy(1e-3)
    for integrator, expected in KNOWN_ERRORS[name].items():
        run = build_exact_scene(scene, 0, integrator)
        *_, last = simulate_scene(
            run, prepare(run, NewtonSolver()), StopRule(100, 1e-12), initial_guess="previous", frames=30
        )
        # All three digits that are stated.
        assert truth.measure_error(0, last.positions) == pytest.approx(expected, rel=0.025)


CHAOS = spec(
    ChainMesh(length=1.0),
    SpringsEffect(stretch=2000.0),
    GravityEffect(),
    PinsEffect(parts=("first",)),
    velocity=(0.0, 9.0, 1.0),
)
"""A pendulum of three links, thrown over its pin."""


def test_a_horizon_beyond_which_round_off_decides_is_refused(tmp_path):
    store = ReferenceStore(tmp_path)
    assert store.load_trajectory(CHAOS, 4, [0.5], error=1e-3).growth[0] < 1e-8
    with pytest.raises(UnpredictableMotion, match=r"after 8 s a perturbation of 1e-12 .* a --t-end of"):
        store.load_trajectory(CHAOS, 4, [0.5, 8.0], error=1e-3)


def test_how_far_a_trajectory_is_known_depends_on_the_error_to_be_measured():
    found = integrate_motion(build_exact_scene(CHAOS, 4), [2.5])
    uncertain = float(max(found.growth[0], found.disagreement[0]))
    assert 0.0 < uncertain < 1e-3
    found.require_accuracy(20.0 * uncertain)
    with pytest.raises(UnpredictableMotion):
        found.require_accuracy(5.0 * uncertain)


def test_a_scene_that_does_not_move_has_no_relative_error(tmp_path):
    with pytest.raises(UnpredictableMotion):
        ReferenceStore(tmp_path).load_trajectory(spec(ChainMesh(), SPRING, FIRST_PIN), 2, [1.0], error=1e-3)


def halve_x(v):
    return v * np.array([0.5, 1.0, 1.0])


UNINTEGRABLE = {
    "a filter of some directions": (lambda s: replace(s, velocity_filters=(halve_x,)), "filter"),
    "a filter that turns speeds around": (lambda s: replace(s, velocity_filters=(lambda v: -v,)), "filter"),
    "no mass": (lambda s: replace(s, system=replace(s.system, mass=np.array([1.0, 0.0]))), "without mass"),
    "penalty pins": (lambda s: replace(s, system=replace(s.system, pins=SOFT_PIN)), "penalty"),
}
SOFT_PIN = replace(build_unit_scene(ChainMesh(), SPRING, FIRST_PIN, size=2).system.pins, weight=np.array([1e10]))


@pytest.mark.parametrize("case", UNINTEGRABLE)
def test_what_has_no_equation_of_motion_is_refused_with_the_reason(case):
    change, reason = UNINTEGRABLE[case]
    with pytest.raises(NotIntegrable, match=reason):
        integrate_motion(change(build_unit_scene(ChainMesh(), SPRING, FIRST_PIN, size=2)), [0.1])
    assert issubclass(NotIntegrable, RunFailed)


SWING = (SPRING, FIRST_PIN, GravityEffect(), EtherDragEffect(decay_rate=C))


def test_a_trajectory_is_integrated_once_for_all_time_steps(tmp_path, monkeypatch):
    store = ReferenceStore(tmp_path)
    found = store.load_trajectory(spec(ChainMesh(), *SWING), 3, TIMES, error=1e-3)
    monkeypatch.setattr(reference_store, "integrate_motion", None)
    for time_step in (1 / 30, 1 / 240):
        again = store.load_trajectory(spec(ChainMesh(), *SWING, time_step=time_step), 3, TIMES, error=1e-3)
        for f in fields(ReferenceTrajectory):
            np.testing.assert_array_equal(getattr(found, f.name), getattr(again, f.name))


@pytest.mark.parametrize(
    ("other", "size", "times"),
    [
        (spec(ChainMesh(), SpringsEffect(scaling_rule="fixed", stretch=K + 1.0), *SWING[1:]), 3, TIMES),
        (spec(ChainMesh(), *SWING, velocity=(0.0, 0.0, 0.1)), 3, TIMES),
        (spec(ChainMesh(), *SWING), 4, TIMES),
        (spec(ChainMesh(), *SWING), 3, (0.3, 0.9)),
    ],
    ids=["stiffness", "speed", "size", "times"],
)
def test_other_settings_have_another_trajectory(tmp_path, other, size, times):
    store = ReferenceStore(tmp_path)
    one = store.load_trajectory(spec(ChainMesh(), *SWING), 3, TIMES, error=1e-3).positions
    two = store.load_trajectory(other, size, times, error=1e-3).positions
    assert one.shape != two.shape or np.abs(one - two).max() > 1e-4


def test_a_trajectory_of_equations_that_have_changed_is_integrated_again(tmp_path, monkeypatch):
    """As after a change of the code: the scene's digest is the same, its springs are not."""
    store, requested = ReferenceStore(tmp_path), spec(ChainMesh(), *SWING)
    before = store.load_trajectory(requested, 3, TIMES, error=1e-3)
    stiffer = build_exact_scene(spec(ChainMesh(), SpringsEffect(scaling_rule="fixed", stretch=K + 1.0), *SWING[1:]), 3)
    monkeypatch.setattr(equations_of_motion, "build_exact_scene", lambda *question: stiffer)
    after = store.load_trajectory(requested, 3, TIMES, error=1e-3)
    assert np.abs(after.positions - before.positions).max() > 1e-4
    np.testing.assert_array_equal(after.positions, integrate_motion(stiffer, TIMES).positions)
