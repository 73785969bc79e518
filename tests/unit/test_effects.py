"""Effects: each against its formula, and nothing at all where a scene has none."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from pydantic import ValidationError
from springbench.harness.errors import InputError
from springbench.harness.scenes.effects.constant_force_effect import ConstantForceEffect
from springbench.harness.scenes.effects.effect_interface import EffectContribution
from springbench.harness.scenes.effects.effect_table import EFFECT_CLASSES
from springbench.harness.scenes.effects.ether_drag_effect import EtherDragEffect
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.effects.wind_effect import WindEffect
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.scenes.spring_stiffness import compute_spring_stiffness
from springbench.solvers.model.energies.spring_energy import Springs as SpringsEnergy
from springbench.solvers.registry import load_target

from tests.oracles.scene_declaration import SceneDeclaration
from tests.oracles.vertex_selection import select_vertices as reference_selection
from tests.scene_builders import build_test_scene

MESH = GridMesh(width=2.0, height=1.0, bend_springs=True).build_mesh(5)
N = len(MESH.rest_positions)
MASS = np.linspace(1.0, 2.0, N)
DT = 0.1

RNG = np.random.default_rng(0)
P, V, T = RNG.normal(size=(N, 3)), RNG.normal(size=(N, 3)), 1.7

EFFECTS_OF_NOTHING = [
    GravityEffect(acceleration=(0.0, 0.0, 0.0)),
    ConstantForceEffect(force=(0.0, 0.0, 0.0)),
    WindEffect(strength=0.0),
    WindEffect(field="assignment", strength=0.0),
    WindEffect(force=(0.0, 0.0, 0.0)),
    EtherDragEffect(decay_rate=0.0),
    SpringsEffect(stretch=0.0),
]


def force_of(effect) -> np.ndarray:
    (force,) = build_contribution(effect).forces
    return force(P, V, T)


def build_contribution(effect) -> EffectContribution:
    return effect.build_contribution(MESH, MASS, DT)


def select_vertices(**selectors) -> list[int]:
    (pin,) = build_contribution(PinsEffect(**selectors)).pins
    np.testing.assert_array_equal(pin.targets, MESH.rest_positions[pin.vertices])
    return pin.vertices.tolist()


@pytest.mark.parametrize("effect", EFFECTS_OF_NOTHING, ids=repr)
def test_an_effect_of_nothing_leaves_nothing(effect):
    contribution = build_contribution(effect)
    assert all(getattr(contribution, field.name) == () for field in fields(contribution))


def test_a_scene_without_effects_has_nothing_in_any_place():
    made = build_test_scene(ChainMesh(), size=3)
    assert (made.system.energies, made.varying_forces, made.velocity_filters) == ((), (), ())
    assert len(made.system.pins.vertices) == len(made.pin_targets) == 0
    assert not made.constant_force.any()


def test_forces_that_never_change_are_added_up_once():
    effects = GravityEffect(), ConstantForceEffect(force=(1.0, 2.0, 3.0)), WindEffect(force=(0.0, 0.0, 6.0))
    made = build_test_scene(ChainMesh(), *effects, size=4, mass=3.0)
    expected = (
        np.outer(made.system.mass, [0, -9.81, 0]) + np.outer(made.mesh.mass_fractions, [0, 0, 6]) + np.array([1, 2, 3])
    )
    np.testing.assert_allclose(made.constant_force, expected, rtol=1e-15)
    assert made.varying_forces == ()


@pytest.mark.parametrize("kind", EFFECT_CLASSES)
def test_the_name_of_an_effect_is_its_kind(kind):
    assert load_target(EFFECT_CLASSES[kind]).model_fields["kind"].default == kind


def test_gravity_is_mass_times_acceleration():
    expected = np.outer(MASS, [1.0, -9.81, 0.5])
    np.testing.assert_array_equal(force_of(GravityEffect(acceleration=(1.0, -9.81, 0.5))), expected)


def test_a_constant_force_is_the_same_on_every_vertex_whatever_its_mass():
    np.testing.assert_array_equal(force_of(ConstantForceEffect(force=(1, -2, 3))), np.tile([1.0, -2.0, 3.0], (N, 1)))


def test_a_force_that_never_changes_cannot_be_written_to():
    with pytest.raises(ValueError, match="read-only"):
        force_of(GravityEffect())[:] = 0.0


def test_a_constant_wind_is_spread_as_the_mass_is():
    force = force_of(WindEffect(force=(2.0, 0.0, 4.0), strength=3.0))
    np.testing.assert_allclose(force, 3.0 * np.outer(MESH.mass_fractions, [2.0, 0.0, 4.0]), rtol=1e-15)
    np.testing.assert_allclose(force.sum(axis=0), [6.0, 0.0, 12.0], rtol=1e-14)  # a sum of N terms


def test_wind_per_vertex_is_the_same_on_every_vertex():
    force = force_of(WindEffect(force=(2.0, 0.0, 4.0), acts_on="vertex", strength=0.5))
    np.testing.assert_array_equal(force, np.tile([1.0, 0.0, 2.0], (N, 1)))


def test_the_assignments_wind_is_its_formula():
    diagonal = np.sqrt(2.0**2 + 1.0**2)
    for i, force in enumerate(force_of(WindEffect(field="assignment", acts_on="vertex"))):
        phi = P[i, 0] / diagonal + T
        expected = [3 + 1.5 * (1 + np.cos(5 * phi)), 1 + np.cos(0.3 + phi), np.sin(phi)]
        np.testing.assert_allclose(force, expected, rtol=1e-14)  # the phase of a cosine has 1e-15


def test_the_assignments_wind_and_force_make_its_external_force():
    total = force_of(WindEffect(field="assignment", acts_on="vertex")) + force_of(
        ConstantForceEffect(force=(0.0, -9.8, 0.0))
    )
    phi = P[:, 0] / MESH.bounding_box_diagonal + T
    np.testing.assert_allclose(total[:, 1], -9.8 + 1 + np.cos(0.3 + phi), rtol=1e-14)


def test_the_assignments_wind_per_share_is_the_mean_over_the_mass():
    each, shared = (force_of(WindEffect(field="assignment", acts_on=per)) for per in ("vertex", "mass"))
    np.testing.assert_allclose(shared, MESH.mass_fractions[:, None] * each, rtol=1e-15)


def test_ether_drag_scales_the_velocity_once_a_step():
    (decay,) = build_contribution(EtherDragEffect(decay_rate=3.0)).velocity_filters
    np.testing.assert_allclose(decay(V), np.exp(-3.0 * DT) * V, rtol=1e-15)


SELECTIONS = {
    "a part": ({"parts": ("top",)}, MESH.parts["top"]),
    "two parts that overlap": (
        {"parts": ("top", "left")},
        np.union1d(MESH.parts["top"], MESH.parts["left"]),
    ),
    "vertices, in any order and twice": ({"indices": (3, 0, 3)}, [0, 3]),
    "a box, faces included": (
        {"box": {"low": (-1.0, -1.0, -0.5), "high": (0.0, 0.0, -0.5)}},
        [0, 1, 2],
    ),
    "a part and vertices": ({"parts": ("top_corners",), "indices": (7,)}, [0, 4, 7]),
    "a ball, its surface included": ({"sphere": {"center": (0.0, 0.0, -0.5), "radius": 0.5}}, [1, 2, 3, 7]),
    "what is nearest, the first of two alike": ({"nearest_to": ((0.0, 9.0, -0.5), (0.25, 0.0, -9.0))}, [2]),
    "the boundary": ({"boundary_loops": (0,)}, MESH.parts["boundary"]),
    "every third of all": ({"stride": 3}, np.arange(N)[::3]),
    "every second of a part": ({"parts": ("top",), "stride": 2}, [0, 2, 4]),
}


@pytest.mark.parametrize("case", SELECTIONS)
def test_pins_fix_the_vertices_that_their_selectors_name(case):
    selectors, expected = SELECTIONS[case]
    assert select_vertices(**selectors) == list(expected)


@pytest.mark.parametrize(("weight", "expected"), [(5.0, 5.0), ("exact", np.inf)])
def test_pins_have_their_weight(weight, expected):
    (pin,) = build_contribution(PinsEffect(parts=("top",), weight=weight)).pins
    assert pin.weight == expected


def test_pins_weigh_what_the_assignments_do_by_default():
    (pin,) = build_contribution(PinsEffect(parts=("top",))).pins
    assert pin.weight == 1e10


SHEET = GridMesh().build_mesh(5)
SHEET_WITH_HOLE = replace(
    SHEET,
    triangles=SHEET.triangles[~(SHEET.triangles == 12).any(axis=1)],
    attributes={"weight": np.arange(25) / 25},
)
"""Without its middle, which lies between two diagonals."""


@pytest.mark.parametrize(
    ("selectors", "expected"),
    [
        ({"boundary_loops": (1,)}, [6, 7, 11, 13, 17, 18]),
        ({"holes": (0,)}, [6, 7, 11, 13, 17, 18]),
        ({"holes": (0,), "stride": 2}, [6, 11, 17]),
        ({"attribute": {"name": "weight", "low": 0.9}}, [23, 24]),
        ({"attribute": {"name": "weight", "high": 0.08}, "indices": (9,)}, [0, 1, 2, 9]),
    ],
)
def test_holes_and_numbers_of_a_file_select_the_vertices_of_the_reference(selectors, expected):
    pins = PinsEffect.model_validate(selectors)
    assert (
        pins.select_vertices(SHEET_WITH_HOLE, "pins").tolist()
        == expected
        == reference_selection(SceneDeclaration(SHEET_WITH_HOLE, np.ones(25), DT, ()), pins)
    )


def test_a_holeless_sheet_and_unknown_numbers_are_refused():
    for selectors, message in (
        ({"holes": (0,)}, "the mesh has 0 holes"),
        ({"boundary_loops": (1,)}, "the mesh has 1 boundary loops"),
        ({"attribute": {"name": "heat"}}, "got 'heat'; this mesh has none"),
        ({"sphere": {"center": (9.0, 0.0, 0.0), "radius": 0.1}}, "no vertex of the mesh lies in the sphere"),
    ):
        with pytest.raises(InputError, match=message):
            build_contribution(PinsEffect.model_validate(selectors))


def test_selectors_that_are_not_used_are_not_written_down():
    assert set(PinsEffect(parts=("top",)).model_dump()) == {
        "parts",
        "indices",
        "box",
        "stride",
        "kind",
        "weight",
        "motion",
    }


REFUSED_SELECTORS = {
    "an unknown part": ({"parts": ("topp",)}, "did you mean 'top'"),
    "a vertex beyond the last": ({"indices": (0, N)}, f"got {N}; the mesh has the vertices 0 to {N - 1}"),
    "an empty box": ({"box": {"low": (5.0, 5.0, 5.0), "high": (6.0, 6.0, 6.0)}}, "no vertex of the mesh lies in"),
}


@pytest.mark.parametrize("case", REFUSED_SELECTORS)
def test_pins_that_do_not_fit_the_mesh_are_refused(case):
    selectors, message = REFUSED_SELECTORS[case]
    with pytest.raises(InputError, match=message):
        build_contribution(PinsEffect(**selectors))


@pytest.mark.parametrize(
    "data",
    [{}, {"stride": 1}, {"indices": [-1]}, {"parts": ["top"], "weight": 0}, {"parts": ["top"], "weight": "hard"}],
    ids=str,
)
def test_invalid_pins_are_refused(data):
    with pytest.raises(ValidationError):
        PinsEffect.model_validate(data)


def test_springs_take_the_stiffness_of_their_rule():
    (energy,) = build_contribution(SpringsEffect(stretch=100.0, shear=20.0, bend=0.01)).energies
    assert isinstance(energy, SpringsEnergy)
    expected = compute_spring_stiffness(MESH, scaling_rule="continuum", stretch=100.0, shear=20.0, bend=0.01)
    np.testing.assert_array_equal(energy.stiffness, expected)
    np.testing.assert_array_equal(energy.edges, MESH.springs)
    np.testing.assert_allclose(energy.rest_length, MESH.rest_lengths, rtol=1e-15)


def test_springs_shear_as_they_stretch_by_default():
    (energy,) = build_contribution(SpringsEffect(stretch=100.0, scaling_rule="fixed")).energies
    assert isinstance(energy, SpringsEnergy)
    assert set(energy.stiffness) == {100.0}


def test_springs_of_no_stiffness_are_left_out():
    (energy,) = build_contribution(SpringsEffect(stretch=100.0, shear=0.0)).energies
    assert isinstance(energy, SpringsEnergy)
    np.testing.assert_array_equal(energy.edges, MESH.springs[MESH.spring_families["stretch"]])


def test_the_reference_size_sets_the_stiffness_of_liu2013():
    (energy,) = build_contribution(SpringsEffect(stretch=100.0, scaling_rule="liu2013", reference_size=9)).energies
    assert isinstance(energy, SpringsEnergy)
    assert energy.stiffness[0] == 100.0 * (5 - 1) / (9 - 1)
