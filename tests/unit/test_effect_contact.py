"""Contact against its specification: depth at speed, Coulomb's law, rest without creep, no energy from nowhere."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from springbench.harness.errors import InputError
from springbench.harness.scenes.effects.contact_effect import ContactEffect
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.key_frames import KeyFrame, KeyFrameMotion
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.solvers.model.step_problem import StopRule

from tests.contact_scenes import (
    CONTACT_THICKNESS,
    OBSTACLE_SPECS,
    TIME_STEP,
    build_contact,
    build_sheet,
    build_sliding_block,
    collect_steps,
    penetration_depth,
)
from tests.effect_scenes import with_integrator
from tests.scene_builders import build_test_scene

TOLERANCE = CONTACT_THICKNESS / 10.0
"""What the effect states where a scene does not say."""


@pytest.mark.parametrize("speed", [0.0, 1.0, 10.0], ids="{:g} m/s".format)
@pytest.mark.parametrize("name", OBSTACLE_SPECS)
def test_nothing_ends_a_step_deeper_than_the_tolerance_nor_passes_through(name, speed):
    made = build_sheet(build_contact(OBSTACLE_SPECS[name], friction=0.3), velocity=(0.0, -speed, 0.0))
    p, deepest = made.mesh.rest_positions, []
    for step in collect_steps(made, 12):
        deepest.append(penetration_depth(made, step.positions, step.index * TIME_STEP))
        # The plate's 1 cm are a thirtieth of the fastest way: 150 points on it cannot all miss the plate.
        for s in np.linspace(0.0, 1.0, 150):
            assert penetration_depth(made, p + s * (step.positions - p), step.index * TIME_STEP) <= CONTACT_THICKNESS
        p = step.positions
    assert max(deepest) <= TOLERANCE
    # It has arrived: on round obstacles what slides leaves the tangent plane of a step by a fraction of a millimetre.
    assert not speed or max(deepest) > -TOLERANCE


@pytest.mark.parametrize("speed", [1.0, 10.0], ids="{:g} m/s".format)
@pytest.mark.parametrize("name", ["sphere", "capsule", "plate"])
def test_a_moving_obstacle_takes_a_resting_sheet_along(name, speed):
    up = {"key_frames": [{"time": 0}, {"time": 0.2, "offset": (0, 0.2 * speed, 0)}]}
    made = build_sheet(build_contact(OBSTACLE_SPECS[name] | {"motion": up}))
    deepest = [penetration_depth(made, step.positions, step.index * TIME_STEP) for step in collect_steps(made, 8)]
    assert max(deepest) <= TOLERANCE
    assert speed < 10.0 or max(deepest) > -TOLERANCE  # it has arrived


@pytest.mark.parametrize("integrator", ["bdf2", "midpoint"])
def test_the_depth_is_that_of_the_steps_end_with_other_integrators(integrator):
    made = with_integrator(
        build_sheet(build_contact(OBSTACLE_SPECS["plate"], friction=0.3), velocity=(0.0, -10.0, 0.0)), integrator
    )
    assert (
        max(penetration_depth(made, step.positions, step.index * TIME_STEP) for step in collect_steps(made, 8))
        <= TOLERANCE
    )


@pytest.mark.parametrize("friction", [0.2, 0.5])
def test_a_block_slides_on_a_slope_above_the_friction_angle(friction):
    made = build_sliding_block(1.05 * friction, friction)
    weight = made.system.mass / made.system.mass.sum()
    x = np.array([weight @ step.positions[:, 0] for step in collect_steps(made, 120)])
    angle = np.arctan(1.05 * friction)
    expected = 9.81 * (np.sin(angle) - friction * np.cos(angle))
    found = np.diff(x, 2)[60:].mean() * 60**2
    assert found == pytest.approx(expected, rel=1e-2)  # the block still rocks a little from its start


@pytest.mark.parametrize("friction", [0.2, 0.5])
def test_a_block_rests_on_a_slope_below_the_friction_angle(friction):
    made = build_sliding_block(0.95 * friction, friction)
    p = [step.positions for step in collect_steps(made, 120)]
    assert np.abs(p[-1] - p[-11]).max() <= 1.1 * 1e-5 * 10 / 60  # the creep, and what still rings


def test_a_resting_sheet_does_not_creep():
    ground = build_contact({"kind": "plane", "point": (0, -CONTACT_THICKNESS, 0)}, friction=0.5)
    made = build_test_scene(
        GridMesh(), SpringsEffect(stretch=300.0), GravityEffect(acceleration=(0.5, -9.8, 0)), ground, size=4
    )
    p = [step.positions for step in collect_steps(made, 1000, stop=StopRule(20, 1e-8))]
    # What is pulled at a part of friction's limit, 0.5 of 0.5 times 9.8 m/s^2, creeps at that part of 1e-5 m/s.
    np.testing.assert_allclose((p[-1] - p[20])[:, 0], 0.5 / 4.9 * 1e-5 * 979 / 30, rtol=0.05)


def test_energy_does_not_grow_without_friction():
    made = build_sheet(build_contact(OBSTACLE_SPECS["plane"]), velocity=(0.5, -5.0, 0.0))
    mass, total = made.system.mass, []
    for step in collect_steps(made, 20, stop=StopRule(60, 1e-12)):
        v = step.state.motion.velocity
        p, problem = step.positions, step.problem
        kinetic = 0.5 * float(mass @ np.einsum("ij,ij->i", v, v))
        stored = sum(energy.value(p) for energy in problem.energies)
        total.append(kinetic + stored + 9.81 * float(mass @ p[:, 1]))
    # Implicit Euler loses energy; what is left of the solve's tolerance is far below a millionth of 12 J.
    assert all(b <= a + 1e-6 for a, b in pairwise(total))
    assert total[-1] < total[0]


def test_the_momentum_that_a_sheet_loses_is_what_the_obstacle_took():
    made = build_sheet(build_contact(OBSTACLE_SPECS["capsule"], friction=0.4), velocity=(1.0, -4.0, 0.0))
    mass, before = made.system.mass, np.array([1.0, -4.0, 0.0])
    for step in collect_steps(made, 8, stop=StopRule(60, 1e-12)):
        after = mass @ step.state.motion.velocity / mass.sum()
        force = made.constant_force.copy()
        energy = step.problem.energies[-1]
        pushed = np.zeros_like(force)
        energy.add_gradient(step.solution.positions, pushed)
        # Springs exchange momentum among vertices alone; the solve's tolerance of 1e-12 leaves nine digits.
        np.testing.assert_allclose(after - before, TIME_STEP * (force - pushed).sum(axis=0) / mass.sum(), atol=1e-8)
        before = after


def test_friction_is_what_a_moving_belt_carries_things_by():
    belt = {"kind": "plane", "point": (0, -CONTACT_THICKNESS, 0)}
    belt |= {"motion": {"key_frames": [{"time": 0}, {"time": 10, "offset": (5, 0, 0)}]}}
    made = build_sheet(build_contact(belt, friction=0.5), size=4)
    last = collect_steps(made, 30)[-1]
    np.testing.assert_allclose(last.state.motion.velocity[:, 0], 0.5, rtol=1e-3)  # the springs still ring


def net(**pins: Any) -> PinsEffect:
    return PinsEffect.model_validate({"parts": ["corners"]} | pins)


CONFLICTS = {
    "thickness": ([build_contact(OBSTACLE_SPECS["plane"], min_distance=0.3)], ["contact", "min_distance", "springs"]),
    "pin": (
        [build_contact({"kind": "sphere", "center": (0.5, 0, 0.5), "radius": 0.1}), net()],
        ["contact", "pins", "sphere"],
    ),
    "pin that moves inside": (
        [
            build_contact(OBSTACLE_SPECS["plane"]),
            net(motion=KeyFrameMotion(key_frames=(KeyFrame(time=0), KeyFrame(time=2, offset=(0, -3, 0))))),
        ],
        ["contact", "pins", " s", "plane"],
    ),
    "start": (
        [build_contact({"kind": "box", "low": (-1, -1, -1), "high": (0.1, 0.1, 0.1)})],
        ["contact", "starts", "box"],
    ),
}


@pytest.mark.parametrize("case", CONFLICTS)
def test_conflicts_are_refused_with_both_names(case):
    effects, named = CONFLICTS[case]
    with pytest.raises(InputError) as refusal:
        build_test_scene(GridMesh(), SpringsEffect(stretch=300.0), *effects, size=6)
    assert all(name in str(refusal.value) for name in named)


@pytest.mark.parametrize(
    "given",
    [
        {"obstacles": []},
        {"obstacles": [{"kind": "plane", "normal": (0, 0, 0)}]},
        {"obstacles": [{"kind": "capsule", "end_points": ((0, 0, 0), (0, 0, 0)), "radius": 1}]},
        {"obstacles": [{"kind": "box", "low": (0, 0, 0), "high": (1, 0, 1)}]},
        {"obstacles": [{"kind": "sphere", "radius": -1}]},
        {"obstacles": [{"kind": "plane"}], "min_distance": 0.01, "penetration_tolerance": 0.01},
        {"obstacles": [{"kind": "plane"}], "friction": -0.1},
    ],
    ids=str,
)
def test_parameters_without_a_meaning_are_refused(given):
    with pytest.raises(ValueError):
        ContactEffect.model_validate(given)
