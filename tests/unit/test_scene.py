"""Binding a scene: masses, pins from several effects, and what does not fit together."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from harness.base.errors import InputError
from harness.scenes.bind import build
from harness.scenes.effects.pins import Pins
from harness.scenes.effects.springs import Springs
from harness.scenes.mesh.chain import Chain
from harness.scenes.spec import SceneSpec
from tests.scenes import scene


def test_the_total_mass_is_dealt_out_by_the_meshs_shares():
    made = scene(Chain(), size=5, mass=8.0)
    np.testing.assert_allclose(made.system.mass, [1, 2, 2, 2, 1], rtol=1e-15)


def test_a_mesh_without_masses_needs_a_total_mass():
    spec = SceneSpec(mesh=Chain(), time_step=0.1, frames=1, path=Path("scene.yaml"))
    with pytest.raises(InputError, match="mass: is missing"):
        build(spec, 3)


def test_pins_of_several_effects_are_joined_in_the_order_of_their_vertices():
    made = scene(Chain(), Pins(indices=(4, 1), weight=10.0), Pins(indices=(2,), weight="exact"), size=5)
    pins = made.system.pins
    assert (pins.vertices.tolist(), pins.weight.tolist()) == ([1, 2, 4], [10.0, np.inf, 10.0])
    np.testing.assert_array_equal(made.pin_targets, made.mesh.rest[[1, 2, 4]])
    assert made.system.free.tolist() == [0, 1, 3, 4]
    assert made.system.unpinned.tolist() == [True, False, False, True, False]


def test_a_vertex_may_be_pinned_twice_in_the_same_way():
    made = scene(Chain(), Pins(at=("ends",)), Pins(indices=(0,)), size=4)
    assert made.system.pins.vertices.tolist() == [0, 3]


def test_a_vertex_pinned_twice_with_different_weights_is_refused():
    with pytest.raises(InputError, match="vertex 0 is pinned twice"):
        scene(Chain(), Pins(at=("ends",)), Pins(indices=(0,), weight="exact"), size=4)


def test_springs_of_several_effects_are_all_the_springs():
    made = scene(Chain(), Springs(stretch=1.0, rule="fixed"), Springs(stretch=2.0, rule="fixed"), size=3)
    assert made.springs.stiffness.tolist() == [1.0, 1.0, 2.0, 2.0]
    assert len(scene(Chain(), size=3).springs.edges) == 0
