"""Strain limits: nothing within them, and nothing much beyond."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.effects.strain_limits_effect import StrainLimitsEffect
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.solvers.model.energies import strain_limit_energy

from tests.effect_scenes import compute_rest_shape
from tests.scene_builders import build_test_scene


def ratios(made, p) -> np.ndarray:
    return made.all_springs.edge_lengths(p) / made.all_springs.rest_length


def test_no_spring_is_beyond_the_limit_when_converged():
    free, limited = (
        build_test_scene(
            GridMesh(plane="vertical"),
            SpringsEffect(stretch=10.0),
            GravityEffect(),
            PinsEffect(parts=("top",)),
            *limits,
            size=9,
            mass=0.5,
        )
        for limits in ((), (StrainLimitsEffect(max_stretch=1.1, stiffness=2e4),))
    )
    assert ratios(free, compute_rest_shape(free)).max() > 1.15
    stretched = ratios(limited, compute_rest_shape(limited))
    # The weight of 4.9 N hangs on a metre of width: a strain of 2.5e-4 over 2e4 N/m, and twice that at the corners.
    assert 1.1 < stretched.max() <= 1.1 + 1e-3


def test_a_chain_at_its_limit_yields_by_the_force_over_the_stiffness():
    """The springs carry EA (l - 1), the limits EA' (l - 1.1), and both together the weight that hangs below."""
    ea, stiff, mass, size = 50.0, 5e4, 2.0, 6
    made = build_test_scene(
        ChainMesh(direction=(0.0, -1.0, 0.0)),
        SpringsEffect(stretch=ea),
        GravityEffect(),
        StrainLimitsEffect(max_stretch=1.1, stiffness=stiff),
        PinsEffect(parts=("first",), weight="exact"),
        size=size,
        mass=mass,
    )
    tension = 9.81 * np.cumsum(made.system.mass[::-1])[:-1][::-1]
    expected = 1 + np.where(tension > 0.1 * ea, (tension + 0.1 * stiff) / (ea + stiff), tension / ea)
    np.testing.assert_allclose(ratios(made, compute_rest_shape(made)), expected, rtol=1e-8)  # of convergence


def test_springs_within_their_limits_have_no_force():
    mesh = GridMesh().build_mesh(5)
    limits = StrainLimitsEffect(max_stretch=1.2, min_stretch=0.8, stiffness=100.0)
    (energy,) = limits.build_contribution(mesh, np.ones(len(mesh.rest_positions)), 0.1).energies
    for scale in (0.81, 1.0, 1.19):
        p, out = scale * mesh.rest_positions, np.zeros_like(mesh.rest_positions)
        energy.add_gradient(p, out)
        # Lengths of a fifth of a metre have 1e-17; what is within the limits is left as it is.
        assert energy.value(p) == 0.0
        assert not out.any()
        assert energy.hessian(p).nnz == 0
    for scale in (0.79, 1.21):
        assert energy.value(scale * mesh.rest_positions) > 0.0


def test_a_spring_pressed_to_a_point_is_pushed_to_its_shortest_length():
    mesh = ChainMesh().build_mesh(2)
    (energy,) = StrainLimitsEffect(min_stretch=0.5, stiffness=10.0).build_contribution(mesh, np.ones(2), 0.1).energies
    assert isinstance(energy, strain_limit_energy.StrainLimits)
    p, out = np.zeros((2, 3)), np.zeros((2, 3))
    energy.add_gradient(p, out)
    assert np.linalg.norm(out[0]) == pytest.approx(5.0, rel=1e-14)
    np.testing.assert_array_equal(out[0], -out[1])
    assert energy.value(p) == pytest.approx(1.25, rel=1e-14)


@pytest.mark.parametrize(
    "data", [{"max_stretch": 0.9}, {"min_stretch": 1.1}, {"max_stretch": 1.0, "min_stretch": 1.0}], ids=str
)
def test_invalid_limits_are_refused(data):
    with pytest.raises(ValidationError):
        StrainLimitsEffect.model_validate({"stiffness": 1.0, **data})
