"""Linearly implicit methods: orders with each effect, what stiff springs do to them, what they refuse."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from springbench.harness.reference.reference_trajectory import ReferenceTrajectory, integrate_motion
from springbench.harness.scenes.effects.air_drag_effect import AirDragEffect
from springbench.harness.scenes.effects.bending_effect import BendingEffect
from springbench.harness.scenes.effects.contact_effect import ContactEffect
from springbench.harness.scenes.effects.dashpots_effect import DashpotsEffect
from springbench.harness.scenes.effects.ether_drag_effect import EtherDragEffect
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.rayleigh_effect import RayleighEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.scenes.scene_builder import Scene, build_scene
from springbench.harness.scenes.scene_spec import SceneSpec
from springbench.harness.simulation.time_loop import build_initial_state, build_problem, prepare, simulate_scene
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.integrators import Motion
from springbench.solvers.model.step_problem import NotPositiveDefinite, StopRule, Unsupported
from springbench.solvers.registry import SOLVERS, load_target

END, ONCE = 0.3, StopRule(1)
FIRST_PIN, SOFT = PinsEffect(parts=("first",), weight="exact"), SpringsEffect(stretch=20.0)
EVENLY = PinsEffect.model_validate(
    {
        "parts": ["first"],
        "weight": "exact",
        "motion": {"key_frames": [{"time": 0.0}, {"time": 1.0, "offset": [0.5, 1.0, 0.0]}]},
    }
)
EFFECTS: dict[str, tuple[Any, ...]] = {
    "none": (FIRST_PIN,),
    "bending": (PinsEffect(parts=("top_corners",), weight="exact"), BendingEffect(stiffness=1e-3)),
    "ether drag": (FIRST_PIN, EtherDragEffect(decay_rate=3.0)),
    "air": (FIRST_PIN, AirDragEffect(coefficient=2.0)),
    "Rayleigh's damping of masses": (FIRST_PIN, RayleighEffect(mass_coefficient=1.5)),
}
ORDERS = {"ros2": 2, "ros3p": 3, "rodas": 4}
OWN = [("ros2", "substepping"), ("ros3p", "substepping"), ("rodas", "substepping")]
OF_STEPS = {("baraff-witkin", "implicit-euler"): 1, ("baraff-witkin", "bdf2"): 2, ("baraff-witkin", "midpoint"): 2}


def build_unit_scene(
    *effects: Any, integrator: str = "substepping", time_step: float = END, mesh: Any = None, size: int = 4
) -> Scene:
    """A scene of 1 kg."""
    given = {"mesh": mesh or ChainMesh(), "effects": effects, "velocity": (0.5, 1.0, 2.0), "time_step": time_step}
    return build_scene(SceneSpec(mass=1.0, frames=1, path=Path("scene.yaml"), **given), size, integrator)


def run(scene: Scene, solver: str, frames: int = 1, **parameters: Any) -> list[Motion]:
    ready = prepare(scene, load_target(SOLVERS[solver])(**parameters))
    path = simulate_scene(scene, ready, ONCE, initial_guess="previous", frames=frames)
    return [build_initial_state(scene).motion, *(s.state.motion for s in path)]


def mesh_of(effects: str) -> Any:
    return GridMesh() if effects == "bending" else ChainMesh()


@cache
def integrate_reference(effects: str) -> ReferenceTrajectory:
    return integrate_motion(build_unit_scene(SOFT, GravityEffect(), *EFFECTS[effects], mesh=mesh_of(effects)), [END])


@pytest.mark.parametrize("effects", EFFECTS)
@pytest.mark.parametrize("name", ORDERS)
def test_the_error_falls_with_the_methods_order(name, effects):
    scene = build_unit_scene(SOFT, GravityEffect(), *EFFECTS[effects], mesh=mesh_of(effects))
    errors = [
        integrate_reference(effects).measure_error(0, run(scene, name, refinement_factor=k)[-1].positions)
        for k in (24, 48)
    ]
    # The next term of the error is smaller by a step times the fastest frequency, at most a quarter.
    assert ORDERS[name] - 0.3 < np.log2(errors[0] / errors[1]) < ORDERS[name] + 0.6


@pytest.mark.parametrize(("name", "integrator"), OF_STEPS)
@pytest.mark.parametrize("effects", ["none", "air"])
def test_the_linearised_step_has_the_order_of_its_integrator(name, integrator, effects):
    errors = []
    for frames in (48, 96):
        scene = build_unit_scene(
            SOFT, GravityEffect(), *EFFECTS[effects], integrator=integrator, time_step=END / frames
        )
        errors.append(integrate_reference(effects).measure_error(0, run(scene, name, frames)[-1].positions))
    np.testing.assert_allclose(np.log2(errors[0] / errors[1]), OF_STEPS[name, integrator], atol=0.25)


@pytest.mark.parametrize("name", ORDERS)
def test_pins_that_move_evenly_retain_the_order(name):
    expected = integrate_motion(build_unit_scene(SOFT, GravityEffect(), EVENLY, integrator="esdirk-4"), [END])
    scene = build_unit_scene(SOFT, GravityEffect(), EVENLY)
    errors = [expected.measure_error(0, run(scene, name, refinement_factor=k)[-1].positions) for k in (24, 48)]
    assert np.log2(errors[0] / errors[1]) > ORDERS[name] - 0.3


def test_the_linearised_step_is_that_of_baraff_and_witkin():
    """(M - dt^2 df/dx) dv = dt (f + dt df/dx v), by a dense matrix."""
    pins = PinsEffect(parts=("top_corners",), weight="exact")
    effects = SpringsEffect(stretch=300.0), GravityEffect(), pins
    scene = build_unit_scene(*effects, mesh=GridMesh(), integrator="implicit-euler", time_step=1 / 30)
    (p, v), dt, free = build_initial_state(scene).motion, 1 / 30, scene.system.free_vertices
    K = np.asarray(scene.all_springs.hessian(p).toarray())
    f = scene.constant_force.copy()
    pull = np.zeros_like(p)
    scene.all_springs.add_gradient(p, pull)
    f -= pull
    inside = np.add.outer(3 * free, np.arange(3)).ravel()
    v = v.copy()
    v[scene.system.pins.vertices] = 0.0
    M = np.repeat(scene.system.mass, 3)
    right = dt * (f.ravel() - dt * (K @ v.ravel()))
    dv = np.linalg.solve((np.diag(M) + dt**2 * K)[np.ix_(inside, inside)], right[inside])
    expected = (p + dt * v).ravel()
    expected[inside] += dt * dv
    found = run(scene, "baraff-witkin")[-1].positions
    np.testing.assert_allclose(found.ravel(), expected, rtol=0, atol=1e-13)  # round-off of positions of about 1 m


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("baraff-witkin", "at the start of the step the Hessian has entries that are not finite"),
        ("ros2", "0 s after the start of the frame the Hessian has entries that are not finite"),
    ],
)
def test_a_step_without_a_factor_names_the_cause(name: str, message: str):
    integrator = "implicit-euler" if name == "baraff-witkin" else "substepping"
    scene = build_unit_scene(SOFT, FIRST_PIN, integrator=integrator)
    problem = build_problem(scene, build_initial_state(scene), "previous")
    p = 1e200 * problem.current_positions  # squared lengths overflow
    start = replace(problem.step_start, positions=p)
    with pytest.raises(NotPositiveDefinite, match=message):
        prepare(scene, load_target(SOLVERS[name])()).solve(
            replace(problem, current_positions=p, step_start=start), ONCE
        )


@pytest.mark.parametrize(("name", "saved"), [("baraff-witkin", 0.01), ("ros2", 0.01), ("rodas", 0.01), ("ros3p", 0.8)])
def test_a_stiff_spring_does_not_ring_after_one_step(name, saved):
    """One spring of 1e5 1/s along its own line, stretched by a thousandth: L-stable methods forget it at once, and
    ROS3P retains 0.73 of it (Lang and Verwer 2001)."""
    integrator = "implicit-euler" if name == "baraff-witkin" else "substepping"
    scene = build_unit_scene(SpringsEffect(stretch=1e10), FIRST_PIN, integrator=integrator, time_step=1 / 30, size=2)
    state = build_initial_state(scene)
    along = scene.mesh.rest_positions[1] - scene.mesh.rest_positions[0]
    p = scene.mesh.rest_positions.copy()
    p[1] += 1e-3 * along
    still = type(state)(Motion(p, np.zeros_like(p)), None, 0)
    ready = prepare(scene, load_target(SOLVERS[name])())
    after = next(simulate_scene(scene, ready, ONCE, initial_guess="previous", frames=1, initial_state=still)).positions
    assert np.linalg.norm(after - scene.mesh.rest_positions) <= saved * 1e-3 * np.linalg.norm(along)


@pytest.mark.parametrize("name", ORDERS)
def test_the_requested_error_controls_the_measured_one(name):
    scene = build_unit_scene(SOFT, GravityEffect(), FIRST_PIN, time_step=END / 3)
    requested = (1e-2, 1e-3, 1e-4, 1e-5)
    errors = [
        integrate_reference("none").measure_error(0, run(scene, name, 3, error_tolerance=e)[-1].positions)
        for e in requested
    ]
    assert errors[-1] < 1e-3
    assert all(b < a for a, b in pairwise(errors))


@pytest.mark.parametrize("name", [*ORDERS, "baraff-witkin"])
def test_a_crushed_sheet_in_long_steps_stays_finite(name):
    """Its springs are compressed to a half, so the exact Hessian of a frame has no factor."""
    integrator = "implicit-euler" if name == "baraff-witkin" else "substepping"
    effects = SpringsEffect(stretch=1e4), PinsEffect(parts=("top_corners",), weight="exact")
    scene = build_unit_scene(*effects, mesh=GridMesh(), size=6, integrator=integrator, time_step=1 / 30)
    state = build_initial_state(scene)
    crushed = type(state)(Motion(0.5 * scene.mesh.rest_positions, np.zeros_like(scene.mesh.rest_positions)), None, 0)
    ready = prepare(scene, load_target(SOLVERS[name])())
    for step in simulate_scene(scene, ready, ONCE, initial_guess="previous", frames=10, initial_state=crushed):
        assert np.isfinite(step.positions).all()


REFUSED_EFFECTS = {
    "dashpots": (DashpotsEffect(stretch=0.4), "Dashpots"),
    "contact": (ContactEffect.model_validate({"obstacles": [{"kind": "plane", "point": [0.0, -9.0, 0.0]}]}), "Contact"),
}


@pytest.mark.parametrize("effect", REFUSED_EFFECTS)
@pytest.mark.parametrize("name", ORDERS)
def test_what_has_no_exact_derivative_is_refused_by_name(name, effect):
    more, named = REFUSED_EFFECTS[effect]
    with pytest.raises(Unsupported, match=named):
        prepare(build_unit_scene(SOFT, GravityEffect(), FIRST_PIN, more), load_target(SOLVERS[name])())


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"refinement_factor": 0}, "refinement_factor: should be at least 1, not 0"),
        ({"error_tolerance": 2.0}, r"error_tolerance: should be from 0 to 1, not 2\.0"),
    ],
)
def test_parameters_out_of_range_are_refused(parameters, message):
    with pytest.raises(ValueError, match=message):
        load_target(SOLVERS["ros2"])(**parameters)


def test_the_linearised_step_refuses_contact_and_stages():
    with pytest.raises(Unsupported, match="Contact"):
        prepare(
            build_unit_scene(SOFT, FIRST_PIN, REFUSED_EFFECTS["contact"][0], integrator="implicit-euler"),
            load_target(SOLVERS["baraff-witkin"])(),
        )
    with pytest.raises(Unsupported, match="implicit-euler, bdf2 or midpoint"):
        prepare(build_unit_scene(SOFT, FIRST_PIN, integrator="sdirk-4"), load_target(SOLVERS["baraff-witkin"])())


def test_newton_from_the_start_begins_with_the_linearised_step():
    """Where the exact Hessian is definite and nothing is halved, both are the same step."""
    scene = build_unit_scene(SOFT, GravityEffect(), FIRST_PIN, integrator="implicit-euler", time_step=1e-3)
    once = next(
        simulate_scene(scene, prepare(scene, NewtonSolver()), ONCE, initial_guess="previous", frames=1)
    ).positions
    np.testing.assert_allclose(run(scene, "baraff-witkin")[-1].positions, once, rtol=0, atol=1e-14)
