"""Binding a scene: masses, pins from several effects, and what does not fit together."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from springbench.harness.errors import InputError
from springbench.harness.scenes.effects.contact_effect import ContactEffect
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.scenes.mesh.surface_meshes import SkirtMesh
from springbench.harness.scenes.scene_builder import build_scene
from springbench.harness.scenes.scene_spec import SceneSpec
from springbench.harness.simulation.instrumentation_pass import compute_penetration

from tests.oracles.verify_scene import verify_terms
from tests.scene_builders import build_test_scene


def test_the_total_mass_is_dealt_out_by_the_meshs_shares():
    made = build_test_scene(ChainMesh(), size=5, mass=8.0)
    np.testing.assert_allclose(made.system.mass, [1, 2, 2, 2, 1], rtol=1e-15)


def test_a_mesh_without_masses_needs_a_total_mass():
    spec = SceneSpec(mesh=ChainMesh(), time_step=0.1, frames=1, path=Path("scene.yaml"))
    with pytest.raises(InputError, match="mass: is missing"):
        build_scene(spec, 3)


def test_a_woven_cloth_of_a_mass_per_area_weighs_that_and_the_reference_terms_agree():
    woven = SpringsEffect.model_validate({"stretch": {"warp": 400, "weft": 200, "bias": 10, "direction": (0, 1, 0)}})
    given: dict[str, Any] = {"mass_per_area": 0.2, "time_step": 0.1, "frames": 1, "effects": (woven,)}
    given["path"] = Path("scene.yaml")
    spec = SceneSpec(mesh=SkirtMesh(), **given)
    made = build_scene(spec, 8)
    corners = made.mesh.rest_positions[made.mesh.triangles]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    assert made.system.mass.sum() == pytest.approx(0.2 * area, rel=1e-12)
    assert verify_terms(spec, made, "implicit-euler") == "agrees"
    for mesh, more, message in (
        (ChainMesh(), {}, "needs a surface"),
        (SkirtMesh(), {"mass": 1.0}, "cannot be combined with `mass`"),
    ):
        with pytest.raises(InputError, match=message):
            build_scene(SceneSpec.model_validate({"mesh": mesh, **given, **more}), 8)


def test_pins_of_several_effects_are_joined_in_the_order_of_their_vertices():
    made = build_test_scene(
        ChainMesh(), PinsEffect(indices=(4, 1), weight=10.0), PinsEffect(indices=(2,), weight="exact"), size=5
    )
    pins = made.system.pins
    assert (pins.vertices.tolist(), pins.weight.tolist()) == ([1, 2, 4], [10.0, np.inf, 10.0])
    np.testing.assert_array_equal(made.pin_targets, made.mesh.rest_positions[[1, 2, 4]])
    assert made.system.free_vertices.tolist() == [0, 1, 3, 4]
    assert made.system.unpinned_mask.tolist() == [True, False, False, True, False]


def test_a_vertex_may_be_pinned_twice_by_equal_pins():
    made = build_test_scene(ChainMesh(), PinsEffect(parts=("ends",)), PinsEffect(indices=(0,)), size=4)
    assert made.system.pins.vertices.tolist() == [0, 3]


def test_a_vertex_pinned_twice_with_different_weights_is_refused():
    with pytest.raises(InputError, match="vertex 0 is pinned twice"):
        build_test_scene(ChainMesh(), PinsEffect(parts=("ends",)), PinsEffect(indices=(0,), weight="exact"), size=4)


def test_springs_of_several_effects_are_all_the_springs():
    made = build_test_scene(
        ChainMesh(),
        SpringsEffect(stretch=1.0, scaling_rule="fixed"),
        SpringsEffect(stretch=2.0, scaling_rule="fixed"),
        size=3,
    )
    assert made.all_springs.stiffness.tolist() == [1.0, 1.0, 2.0, 2.0]
    assert len(build_test_scene(ChainMesh(), size=3).all_springs.edges) == 0


def test_gravity_twice_is_refused_with_both_places():
    with pytest.raises(InputError, match=r"effects\[2\]: gravity repeats effects\[0\]"):
        build_test_scene(
            ChainMesh(),
            GravityEffect(),
            SpringsEffect(stretch=1.0),
            GravityEffect(acceleration=(0.0, 0.0, -1.0)),
            size=4,
        )


def test_a_gravity_of_zero_is_none():
    build_test_scene(
        ChainMesh(), GravityEffect(), SpringsEffect(stretch=1.0), GravityEffect(acceleration=(0.0, 0.0, 0.0)), size=4
    )


@pytest.mark.parametrize(
    ("time_step", "effects", "said"),
    [
        (60.0, [SpringsEffect(stretch=1.0)], "a time step of 60 s is long"),
        (0.1, [SpringsEffect(stretch=1.0), SpringsEffect(stretch=1.0)], "effects[1] repeats effects[0] (springs)"),
        (1.0, [SpringsEffect(stretch=1.0), SpringsEffect(stretch=2.0)], ""),
    ],
)
def test_unusual_valid_values_get_a_warning(
    time_step: float, effects: list[SpringsEffect], said: str, caplog: pytest.LogCaptureFixture
):
    with caplog.at_level("WARNING", logger="springbench"):
        build_test_scene(ChainMesh(), *effects, size=4, time_step=time_step)
    assert (said in caplog.text) if said else not caplog.records


def test_scenes_without_warnings_have_none_for_the_other_time_step(caplog: pytest.LogCaptureFixture):
    spec = SceneSpec(
        mesh=ChainMesh(),
        mass=1.0,
        time_step=0.1,
        alternate_time_step=60.0,
        frames=1,
        effects=(SpringsEffect(stretch=1.0),),
        path=Path("scene.yaml"),
    )
    with caplog.at_level("WARNING", logger="springbench"):
        build_scene(spec, 4, log_warnings=False)
        assert not caplog.records
        build_scene(spec, 4)
    assert "a time step of 60 s is long" in caplog.text


@pytest.mark.parametrize(("height", "deep"), [(0.5, 0.0), (-0.25, 0.25)])
def test_penetration_is_the_depth_of_the_deepest_vertex_in_an_obstacle(height: float, deep: float):
    floor = ContactEffect.model_validate({"obstacles": [{"kind": "plane", "point": [0, -5, 0]}]})
    made = build_test_scene(ChainMesh(), SpringsEffect(stretch=1.0), floor, size=4)
    p = made.mesh.rest_positions.copy()
    p[2, 1] = -5.0 + height
    assert compute_penetration(made, p, 0.0) == pytest.approx(deep, abs=1e-12)
    assert compute_penetration(build_test_scene(ChainMesh(), SpringsEffect(stretch=1.0), size=4), p, 0.0) is None
