"""Explicit integrators: orders with each drag, stability, what symplectic ones keep, how an error steers the steps."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import DOP853
from springbench.harness.reference.reference_trajectory import ReferenceTrajectory, integrate_motion
from springbench.harness.scenes.effects.air_drag_effect import AirDragEffect
from springbench.harness.scenes.effects.bending_effect import BendingEffect
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
from springbench.harness.simulation.time_loop import (
    MotionState,
    build_initial_state,
    build_problem,
    prepare,
    simulate_scene,
)
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.methods.time_stepping import explicit_integrators
from springbench.solvers.methods.time_stepping.explicit_forces import estimate_max_frequency
from springbench.solvers.methods.time_stepping.explicit_integrators import PreparedExplicit
from springbench.solvers.methods.time_stepping.explicit_tableaus import (
    BLANES_MOAN_4,
    DORMAND_PRINCE_8,
    RUNGE_KUTTA_4,
    TSITOURAS_5,
    VELOCITY_VERLET,
    integrate_drag,
)
from springbench.solvers.model.integrators import Motion
from springbench.solvers.model.step_problem import StopRule, Unsupported
from springbench.solvers.registry import SOLVERS, load_target

END, ONCE = 0.3, StopRule(1)
FIRST_PIN, SOFT = PinsEffect(parts=("first",), weight="exact"), SpringsEffect(stretch=20.0)
METHODS = {
    "velocity-verlet": (2, 16),
    "blanes-moan-4": (4, 8),
    "blanes-moan-6": (6, 8),
    "runge-kutta-4": (4, 24),
    "tsitouras-5": (5, 12),
    "dormand-prince-8": (8, 6),
}
"""Order, and substeps to begin with."""
EFFECTS: dict[str, tuple[Any, ...]] = {
    "none": (),
    "ether drag": (EtherDragEffect(decay_rate=3.0),),
    "air": (AirDragEffect(coefficient=2.0),),
    "Rayleigh's damping of masses": (RayleighEffect(mass_coefficient=1.5),),
}


def build_unit_scene(*effects: Any, time_step: float = END, mesh: Any = None, size: int = 4) -> Scene:
    """A scene of 1 kg, which solvers integrate by themselves."""
    given = {"mesh": mesh or ChainMesh(), "effects": effects, "velocity": (0.5, 1.0, 2.0), "time_step": time_step}
    return build_scene(SceneSpec(mass=1.0, frames=1, path=Path("scene.yaml"), **given), size, "substepping")


def prepare_explicit(name: str, scene: Scene, **parameters: Any) -> PreparedExplicit:
    return load_target(SOLVERS[name])(**parameters).prepare(scene.system)


def fix_substeps(name: str, scene: Scene, substeps: int) -> PreparedExplicit:
    """With substeps of one length."""
    one: Any = prepare_explicit(name, scene)
    taken = replace(one.substep_choice, num_substeps=substeps, tolerance=0.0)
    method = (
        replace(one.method, error_exponent=0.0)
        if hasattr(one.method, "error_exponent") and one.substep_choice.tolerance
        else one.method
    )
    return replace(one, substep_choice=taken, method=method)


def run(scene: Scene, ready: Any, frames: int = 1, state: MotionState | None = None) -> list[Motion]:
    state = state or build_initial_state(scene)
    return [
        s.state.motion
        for s in simulate_scene(scene, ready, ONCE, initial_guess="previous", frames=frames, initial_state=state)
    ]


@cache
def integrate_reference(effects: str) -> ReferenceTrajectory:
    return integrate_motion(build_unit_scene(SOFT, GravityEffect(), FIRST_PIN, *EFFECTS[effects]), [END])


@pytest.mark.parametrize("effects", EFFECTS)
@pytest.mark.parametrize("name", METHODS)
def test_the_error_falls_with_the_methods_order(name, effects):
    scene, (order, first) = build_unit_scene(SOFT, GravityEffect(), FIRST_PIN, *EFFECTS[effects]), METHODS[name]
    paths = (run(scene, fix_substeps(name, scene, k * first)) for k in (1, 2))
    coarse, fine = (integrate_reference(effects).measure_error(0, path[-1].positions) for path in paths)
    # The next terms of the error are smaller by a substep times the fastest frequency, up to a half, of the highest
    # orders; they have the sign that makes it fall faster.
    assert order - 0.25 < np.log2(coarse / fine) < order + 1.3


@pytest.mark.parametrize("name", ["tsitouras-5", "dormand-prince-8"])
def test_the_requested_error_controls_the_measured_one(name):
    scene = build_unit_scene(SOFT, GravityEffect(), FIRST_PIN, time_step=END / 3)
    errors = [
        integrate_reference("none").measure_error(
            0, run(scene, prepare_explicit(name, scene, error_tolerance=requested), 3)[-1].positions
        )
        for requested in (1e-4, 1e-6, 1e-8, 1e-10)
    ]
    assert errors[0] < 1e-3
    assert errors[-1] < 1e-9
    assert all(b < a for a, b in pairwise(errors))


def test_it_agrees_with_an_implicit_integrator():
    """Bending is a force as well; SDIRK of order 4 has it as an energy."""
    pins = PinsEffect(parts=("top_corners",), weight="exact")
    effects = (SpringsEffect(stretch=5.0), BendingEffect(stiffness=1e-3), GravityEffect(), pins)
    scene = build_unit_scene(*effects, mesh=GridMesh(), time_step=0.02)
    other = build_scene(SceneSpec(mesh=GridMesh(), mass=1.0, frames=1, path=Path("scene.yaml"), effects=effects,
                            velocity=(0.5, 1.0, 2.0), time_step=0.02), 4, "sdirk-4")  # fmt: skip
    path = simulate_scene(
        other, prepare(other, NewtonSolver()), StopRule(100, 1e-12), initial_guess="extrapolated", frames=5
    )
    expected = [step.positions for step in path][-1]
    found = run(scene, prepare_explicit("dormand-prince-8", scene, error_tolerance=1e-9), 5)[-1].positions
    moved = np.abs(expected - scene.mesh.rest_positions).max()
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-4 * moved)  # the error of order 4 at these steps


@pytest.mark.parametrize("name", ["velocity-verlet", "blanes-moan-4", "blanes-moan-6"])
def test_the_energy_of_symplectic_methods_stays_near_over_a_hundred_thousand_steps(name):
    scene = build_unit_scene(SpringsEffect(scaling_rule="fixed", stretch=25.0), size=3, time_step=1.0)
    ready, substeps = prepare_explicit(name, scene), 2000
    h = 0.25 / ready.substep_choice.num_substeps  # of the longest that is stable
    system = replace(scene.system, time_step=substeps * h)
    taken = replace(ready.substep_choice, num_substeps=substeps)
    scene, ready = replace(scene, system=system), replace(ready, system=system, substep_choice=taken)
    begun = MotionState(Motion(1.1 * scene.mesh.rest_positions, np.random.default_rng(0).normal(size=(3, 3))), None, 0)
    path = [begun.motion, *run(scene, ready, 50, begun)]
    energy = np.array([0.5 * system.mass @ (v**2).sum(axis=1) + scene.all_springs.value(p) for p, v in path])
    # It swings by (omega h)^2 at most, and does not drift.
    assert np.ptp(energy) < 0.1 * energy[0]
    assert abs(energy[-10:].mean() - energy[:10].mean()) < 0.05 * energy[0]


@pytest.mark.parametrize("name", METHODS)
def test_momentum_is_conserved(name):
    scene = build_unit_scene(SpringsEffect(stretch=30.0), mesh=GridMesh(), time_step=0.1)
    v = np.random.default_rng(1).normal(size=scene.mesh.rest_positions.shape)
    path = run(scene, prepare_explicit(name, scene), 10, MotionState(Motion(scene.mesh.rest_positions, v), None, 0))
    m = scene.system.mass
    np.testing.assert_allclose([m @ w for _, w in path], np.tile(m @ v, (10, 1)), rtol=0, atol=1e-12)  # round-off
    if name in ("velocity-verlet", "blanes-moan-4", "blanes-moan-6"):
        spin = [np.cross(p, m[:, None] * w).sum(axis=0) for p, w in path]
        np.testing.assert_allclose(np.diff(spin, axis=0), 0.0, rtol=0, atol=1e-12)  # a quadratic invariant


@pytest.mark.parametrize("name", METHODS)
def test_the_same_steps_give_the_same_bits(name):
    scene = build_unit_scene(SOFT, GravityEffect(), FIRST_PIN)
    one, two = (run(scene, prepare_explicit(name, scene), 4) for _ in "ab")
    np.testing.assert_array_equal(np.array(one), np.array(two))


@pytest.mark.parametrize("name", METHODS)
def test_frames_of_one_call_are_those_of_single_calls(name):
    scene = build_unit_scene(SOFT, GravityEffect(), FIRST_PIN, EtherDragEffect(decay_rate=3.0))
    ready, state, h, single = prepare_explicit(name, scene), build_initial_state(scene), None, list[Any]()
    problem = build_problem(scene, state, "previous")
    for index in range(4):
        (p, v), step_stats = ready.integrate_frames(build_problem(scene, state, "previous"), 1, h)
        h, state = step_stats[0, 2], MotionState(Motion(p[0], v[0]), None, index + 1)
        single.append((p[0], v[0], step_stats[0]))
    (p, v), step_stats = ready.integrate_frames(problem, 4)
    for found, expected in zip((p, v, step_stats), zip(*single, strict=True), strict=True):
        np.testing.assert_array_equal(found, expected)


def test_frames_before_one_that_takes_too_many_steps_are_returned(monkeypatch):
    scene = build_unit_scene(SOFT, GravityEffect(), FIRST_PIN, time_step=0.05)
    p = scene.mesh.rest_positions
    problem = build_problem(scene, MotionState(Motion(p, 0.0 * p), None, 0), "previous")
    motions, step_stats = prepare_explicit("tsitouras-5", scene).integrate_frames(problem, 40)
    tried = step_stats[:, :2].sum(axis=1)
    limit = tried[0]
    done = int(np.argmax(tried > limit))
    assert done > 0
    monkeypatch.setattr(explicit_integrators, "compute_max_steps", lambda count, tolerance: limit)
    some, _ = prepare_explicit("tsitouras-5", scene).integrate_frames(problem, 40)
    np.testing.assert_array_equal(some.positions, motions.positions[:done])


def test_one_drag_rate_for_all_vertices_gives_the_bits_of_a_rate_for_each():
    scene = build_unit_scene(SOFT, GravityEffect(), FIRST_PIN, EtherDragEffect(decay_rate=2.0))  # 2 m/m is exact
    problem = build_problem(scene, build_initial_state(scene), "previous")
    one, each = (prepare_explicit("blanes-moan-4", scene) for _ in "ab")
    steps = one._splitting_steps
    assert steps.velocity_factor.shape[1] == 1
    decay, gain = integrate_drag(BLANES_MOAN_4.kicks, steps.step_size, one.explicit_forces.frame_forces.drag_rate)
    vars(each)["_splitting_steps"] = steps._replace(velocity_factor=decay, gained=gain)
    np.testing.assert_array_equal(one.integrate_frames(problem, 3)[0], each.integrate_frames(problem, 3)[0])


def test_the_largest_frequency_is_bounded_closely():
    scene = build_unit_scene(SpringsEffect(stretch=300.0, shear=100.0), GravityEffect(), mesh=GridMesh(), size=9)
    K = scene.all_springs.stiffness_matrix(81).toarray()
    most = np.sqrt(np.linalg.eigvals(K / scene.system.mass[:, None]).real.max())
    assert most <= estimate_max_frequency(scene.system) <= 1.05 * most


def test_limits_of_stability_are_those_of_textbooks():
    assert VELOCITY_VERLET.stability_limit == pytest.approx(2.0, abs=0.02)
    assert RUNGE_KUTTA_4.stability_limit == pytest.approx(2.0 * 2.0**0.5, abs=0.02)  # Hairer and Wanner, section IV.2
    assert BLANES_MOAN_4.stability_limit > 3.0
    np.testing.assert_allclose(TSITOURAS_5.stage_times[-1], 1.0, rtol=1e-14)


def test_unsupported_effects_are_refused_by_name():
    scene = build_unit_scene(SOFT, DashpotsEffect(stretch=0.4), FIRST_PIN)
    with pytest.raises(Unsupported, match=r"dormand-prince-8.*Dashpots"):
        prepare_explicit("dormand-prince-8", scene)
    with pytest.raises(ValueError, match=r"error_tolerance: should be from 1e-14 to 1, not 0\.0"):
        prepare_explicit("tsitouras-5", build_unit_scene(SOFT), error_tolerance=0.0)


def test_an_error_that_no_step_meets_ends_with_the_fraction_of_the_frame_that_was_reached():
    scene = build_unit_scene(SOFT, GravityEffect(), FIRST_PIN)
    broken = replace(scene, constant_force=np.full_like(scene.constant_force, np.nan))
    ready = prepare_explicit("tsitouras-5", broken)
    with pytest.raises(RuntimeError, match="was not reached within"):
        run(broken, ready)


def test_a_minimiser_has_nothing_to_do_where_the_solver_should_integrate():
    scene = build_unit_scene(SOFT, GravityEffect(), FIRST_PIN)
    with pytest.raises(Unsupported, match="substepping"):
        run(scene, prepare(scene, NewtonSolver()))


def test_the_coefficients_of_order_8_are_those_of_scipy():
    a = DORMAND_PRINCE_8.a
    np.testing.assert_array_equal(a[:12, :12], DOP853.A)
    np.testing.assert_array_equal(a[12, :12], DOP853.B)
    assert not a[:, 12].any()
    np.testing.assert_array_equal(DORMAND_PRINCE_8.error_weights, [DOP853.E5, DOP853.E3])
