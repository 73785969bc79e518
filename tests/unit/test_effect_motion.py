"""Key frames, the pins that follow them and the attachments that are tied to them."""

from __future__ import annotations

import logging
from itertools import pairwise

import numpy as np
import pytest
from pydantic import ValidationError
from springbench.harness.errors import InputError
from springbench.harness.scenes.effects.attachments_effect import AttachmentsEffect
from springbench.harness.scenes.effects.ether_drag_effect import EtherDragEffect
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.effects.wind_effect import WindEffect
from springbench.harness.scenes.key_frames import KeyFrame, KeyFrameMotion
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.simulation.time_loop import prepare, simulate_scene
from springbench.solvers.methods.local_global.reference_local_global import SparseLocalGlobal
from springbench.solvers.model.step_problem import StopRule

from tests.effect_scenes import compute_rest_shape, with_integrator
from tests.scene_builders import build_test_scene

POINTS = np.array([[1.0, 0.0, 0.0], [0.0, 2.0, 1.0]])
LIFT = KeyFrameMotion(
    key_frames=(
        KeyFrame(time=1.0),
        KeyFrame(time=2.0, offset=(0.0, 3.0, 0.0)),
        KeyFrame(time=4.0, offset=(0.0, 1.0, 0.0)),
    )
)
INTEGRATORS = ("implicit-euler", "bdf2", "midpoint")


@pytest.mark.parametrize(
    ("time", "height"), [(0.0, 0.0), (1.0, 0.0), (1.5, 1.5), (2.0, 3.0), (3.0, 2.0), (4.0, 1.0), (9.0, 1.0)]
)
def test_points_move_straight_from_key_to_key_and_rest_before_and_after(time, height):
    np.testing.assert_allclose(LIFT.transform_points(POINTS, time), POINTS + np.array([0.0, height, 0.0]), rtol=1e-15)


def test_a_smooth_motion_passes_its_keys_and_never_overshoots():
    smooth = LIFT.model_copy(update={"interpolation": "smooth"})
    times = np.linspace(0.0, 5.0, 501)
    heights = np.array([smooth.transform_points(POINTS, t)[0, 1] for t in times])
    assert heights.min() == 0.0
    assert heights.max() == 3.0
    for key in LIFT.key_frames:
        np.testing.assert_allclose(
            smooth.transform_points(POINTS, key.time), LIFT.transform_points(POINTS, key.time), rtol=1e-15
        )
    speed = np.diff(heights[100:401]) / 0.01
    assert np.abs(np.diff(speed)).max() < 0.3  # no corner: straight ones turn by 4 m/s at two seconds


def test_a_turn_is_about_its_axis():
    motion = KeyFrameMotion(
        key_frames=(KeyFrame(time=0.0), KeyFrame(time=1.0, angle=180.0)), axis=(0.0, 0.0, 2.0), pivot=(1.0, 1.0, 5.0)
    )
    np.testing.assert_allclose(motion.transform_points(np.array([[3.0, 1.0, 0.0]]), 0.5), [[1.0, 3.0, 0.0]], atol=1e-15)
    np.testing.assert_allclose(
        motion.transform_points(np.array([[3.0, 1.0, 0.0]]), 1.0), [[-1.0, 1.0, 0.0]], atol=1e-15
    )


def test_a_rotation_of_many_turns_preserves_distances():
    motion = KeyFrameMotion(key_frames=(KeyFrame(time=0.0), KeyFrame(time=1.0, angle=3600.0)), axis=(1.0, 2.0, 3.0))
    for t in (0.013, 0.4, 0.77):
        a, b = motion.transform_points(POINTS, t)
        assert np.linalg.norm(a - b) == pytest.approx(6**0.5, rel=1e-14)
    np.testing.assert_allclose(motion.transform_points(POINTS, 1.0), POINTS, atol=1e-13)  # ten rounds, of 63 radians


@pytest.mark.parametrize(
    "data",
    [
        {"key_frames": []},
        {"key_frames": [{"time": 1.0}, {"time": 1.0}]},
        {"key_frames": [{"time": 1.0}, {"time": 0.5}]},
        {"key_frames": [{"time": -1.0}]},
        {"key_frames": [{"time": 0.0}], "axis": [0.0, 0.0, 0.0]},
    ],
    ids=str,
)
def test_invalid_key_frames_are_refused(data):
    with pytest.raises(ValidationError):
        KeyFrameMotion.model_validate(data)


SWING = KeyFrameMotion(key_frames=(KeyFrame(time=0.0), KeyFrame(time=0.3, offset=(0.2, 0.1, 0.0), angle=60.0)))


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("weight", [1e10, "exact"])
def test_pins_are_on_their_path_at_the_end_of_each_step(integrator, weight):
    pins = PinsEffect.model_validate({"parts": ["top"], "weight": weight, "motion": SWING.model_dump()})
    made = with_integrator(
        build_test_scene(GridMesh(), SpringsEffect(stretch=100.0), GravityEffect(), pins, size=4), integrator
    )
    pinned = made.system.pins.vertices
    for step in simulate_scene(
        made, prepare(made, SparseLocalGlobal()), StopRule(60), initial_guess="previous", frames=12
    ):
        expected = SWING.transform_points(made.mesh.rest_positions[pinned], step.index / 30)
        # A penalty gives way by some newtons over 1e10 N/m, which midpoint carries on from step to step.
        np.testing.assert_allclose(step.positions[pinned], expected, rtol=0, atol=1e-8 if weight == 1e10 else 1e-14)


def test_a_chain_pulled_at_both_ends_gets_there():
    """Both ends go 1 m along; what hangs between them follows and comes to rest a metre further, through drag."""
    along = KeyFrameMotion(key_frames=(KeyFrame(time=0.0), KeyFrame(time=0.5, offset=(1.0, 0.0, 0.0))))
    pins = PinsEffect(parts=("ends",), weight="exact", motion=along)
    made = build_test_scene(ChainMesh(), SpringsEffect(stretch=100.0), pins, EtherDragEffect(decay_rate=10.0), size=6)
    *_, last = simulate_scene(
        made, prepare(made, SparseLocalGlobal()), StopRule(50), initial_guess="previous", frames=90
    )
    np.testing.assert_allclose(last.positions, made.mesh.rest_positions + np.array([1.0, 0.0, 0.0]), rtol=0, atol=1e-3)


def test_a_scene_may_have_resting_and_moving_pins():
    made = build_test_scene(
        GridMesh(), PinsEffect(parts=("bottom",)), PinsEffect(parts=("top",), weight="exact", motion=SWING), size=3
    )
    targets = made.compute_pin_targets(0.15)
    np.testing.assert_array_equal(made.system.pins.vertices, [0, 1, 2, 6, 7, 8])
    np.testing.assert_array_equal(targets[3:], made.mesh.rest_positions[6:])
    np.testing.assert_array_equal(targets[:3], SWING.transform_points(made.mesh.rest_positions[:3], 0.15))
    assert made.compute_pin_targets(0.15) is not made.pin_targets
    np.testing.assert_array_equal(made.pin_targets, made.mesh.rest_positions[made.system.pins.vertices])


def test_a_vertex_pinned_to_rest_and_to_move_is_refused_with_both_names():
    with pytest.raises(InputError, match=r"vertex 0 is pinned twice, by effects\[0\] and effects\[1\]"):
        build_test_scene(GridMesh(), PinsEffect(parts=("left",)), PinsEffect(parts=("top",), motion=SWING), size=3)
    both = build_test_scene(
        GridMesh(), PinsEffect(parts=("left",), motion=SWING), PinsEffect(parts=("top",), motion=SWING), size=3
    )
    assert len(both.system.pins.vertices) == 5


def hanging(*attachments: AttachmentsEffect):
    return build_test_scene(
        ChainMesh(direction=(0.0, -1.0, 0.0)),
        SpringsEffect(stretch=1e4),
        GravityEffect(),
        *attachments,
        size=4,
        mass=2.0,
    )


def test_an_attachment_yields_by_the_weight_over_its_stiffness():
    p = compute_rest_shape(hanging(AttachmentsEffect(parts=("first",), stiffness=50.0)))
    assert p[0, 1] == pytest.approx(-2.0 * 9.81 / 50.0, rel=1e-7)  # inertia has a stiffness of 2e-6 N/m


def test_attachments_share_their_stiffness():
    p = compute_rest_shape(hanging(AttachmentsEffect(stride=1, indices=(0, 1, 2, 3), stiffness=50.0)))
    assert p.mean(axis=0)[1] - (-0.5) == pytest.approx(-2.0 * 9.81 / 50.0, rel=1e-3)  # masses are 1 2 2 1


def test_attachments_pull_to_the_points_that_they_name():
    one, each = ((2.0, 0.0, 0.0),), ((0.0, 1.0, 0.0), (1.0, 1.0, 0.0))
    mesh = build_test_scene(ChainMesh(), AttachmentsEffect(parts=("ends",), stiffness=3.0, anchors=each), size=3)
    np.testing.assert_allclose(compute_rest_shape(mesh)[[0, 2]], each, rtol=0, atol=1e-6)  # as above
    mesh = build_test_scene(ChainMesh(), AttachmentsEffect(parts=("ends",), stiffness=3.0, anchors=one), size=3)
    np.testing.assert_allclose(compute_rest_shape(mesh)[[0, 2]], one * 2, rtol=0, atol=1e-6)
    with pytest.raises(InputError, match="got 2 points for 1 vertices"):
        build_test_scene(ChainMesh(), AttachmentsEffect(parts=("first",), stiffness=3.0, anchors=each), size=3)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_an_attachment_pulls_a_free_mass_behind_its_point_by_the_equation_of_motion(integrator):
    """m x'' = -k (x - v t): x = v (t - sin(w t) / w)."""
    speed, w, seconds = 2.0, 5.0, 1.0
    motion = KeyFrameMotion(key_frames=(KeyFrame(time=0.0), KeyFrame(time=10.0, offset=(10 * speed, 0.0, 0.0))))
    expected, errors = speed * (seconds - np.sin(w * seconds) / w), []
    for dt in (0.01, 0.005, 0.0025):
        ends = AttachmentsEffect(parts=("ends",), stiffness=2 * w**2, motion=motion)
        made = with_integrator(build_test_scene(ChainMesh(), ends, size=2, mass=2.0, time_step=dt), integrator)
        run = simulate_scene(
            made, prepare(made, SparseLocalGlobal()), StopRule(1), initial_guess="previous", frames=round(1 / dt)
        )
        *_, last = run
        errors.append(last.positions[0, 0] - expected)
    order = 1 if integrator == "implicit-euler" else 2
    for coarse, fine in pairwise(errors):
        assert coarse / fine == pytest.approx(2**order, rel=0.15)  # the next order is w dt = 5 % and less


def test_an_effect_that_does_nothing_is_omitted_and_logged(caplog):
    with caplog.at_level(logging.INFO, "springbench"):
        made = build_test_scene(
            ChainMesh(),
            SpringsEffect(stretch=1.0),
            WindEffect(strength=0.0),
            AttachmentsEffect(parts=("first",), stiffness=0.0),
            size=3,
        )
    assert len(made.system.energies) == 1
    assert [record.getMessage() for record in caplog.records] == [
        "effects[1] (wind) does nothing with these parameters and is left out",
        "effects[2] (attachments) does nothing with these parameters and is left out",
    ]
