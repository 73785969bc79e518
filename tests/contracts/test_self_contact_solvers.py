"""A mesh that cannot pass through itself, by every solver: no crossing in any frame, or refused by name."""

from __future__ import annotations

import functools
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from springbench.harness.config.config_loader import load_scene
from springbench.harness.errors import InputError
from springbench.harness.scenes import collision_primitives
from springbench.harness.scenes.effects.effect_interface import SceneEffect
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.self_contact_effect import SelfContactEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.key_frames import KeyFrame, KeyFrameMotion
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.scenes.mesh.stack_mesh import StackMesh
from springbench.harness.scenes.scene_builder import Scene, build_scene
from springbench.harness.scenes.scene_spec import SceneSpec
from springbench.harness.scenes.start_positions import CollapsedStart, ScaledStart
from springbench.harness.simulation.instrumentation_pass import count_intersections
from springbench.harness.simulation.time_loop import (
    MotionState,
    build_initial_state,
    build_problem,
    prepare,
    simulate_scene,
)
from springbench.solvers.contact.contact_potential import SelfContact as Energy
from springbench.solvers.iteration.idle_contact import _Certificate
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model import integrators
from springbench.solvers.model.barrier_energy import max_step_size
from springbench.solvers.model.step_problem import StepProblem, StopRule, Unsupported
from springbench.solvers.registry import SOLVERS, load_target

from tests.oracles.verify_scene import verify_terms
from tests.scene_builders import build_test_scene

SOON = ("newton", "newton-cg", "pncg", "lbfgs", "hybrid", "vbd", "anderson")
"""Those that are near a minimum within some hundred iterations."""
TAKE = (*SOON, "vbd-ogc", "chebyshev", "sparse", "numba")
CONFIGS = Path(__file__).resolve().parents[2] / "configs"
is_idle_at = _Certificate.is_idle_at
THICKNESS = 0.01
SELF_CONTACT = SelfContactEffect(min_distance=THICKNESS)


def upside_down(*effects: SceneEffect) -> Scene:
    """A sheet that is pinned at its top corners falls upwards, and onto itself."""
    grid, up = GridMesh(plane="vertical", diagonals="one"), GravityEffect(acceleration=(0.0, 9.81, 0.0))
    return build_test_scene(
        grid, SpringsEffect(stretch=100.0, shear=20.0), up, PinsEffect(parts=("top_corners",)), *effects, size=7
    )


def solver(name: str):
    return load_target(SOLVERS[name])()


@pytest.mark.parametrize("name", TAKE)
def test_a_sheet_that_falls_onto_itself_passes_through_nowhere(name):
    made, touched = upside_down(SELF_CONTACT), 0
    (energy,) = (e for e in made.system.energies if isinstance(e, Energy))
    rule = StopRule(60, 1e-3)
    for step in simulate_scene(made, prepare(made, solver(name)), rule, initial_guess="extrapolated", frames=14):
        assert count_intersections(made, step.positions, 0.0) == 0
        assert not energy.find_violated_pairs(step.positions)
        touched = max(touched, len(energy.hessian_blocks(step.positions).vertices))
    assert touched >= 3


def test_without_the_effect_it_does_pass_through():
    made, (apart,) = upside_down(), upside_down(SELF_CONTACT).intersection_checks
    steps = simulate_scene(
        made, prepare(made, NewtonSolver()), StopRule(60, 1e-3), initial_guess="extrapolated", frames=14
    )
    assert any(apart.find_intersections(step.positions, 0.0) for step in steps)
    assert count_intersections(made, made.mesh.rest_positions, 0.0) is None


@functools.cache
def build_touching_start() -> tuple[Scene, MotionState]:
    """A step in which it touches."""
    made = upside_down(SELF_CONTACT)
    rule = StopRule(60, 1e-3)
    *_, last = simulate_scene(made, prepare(made, NewtonSolver()), rule, initial_guess="extrapolated", frames=9)
    return made, last.state


@pytest.mark.parametrize("name", TAKE)
def test_every_iterate_and_the_path_to_it_are_intersection_free(name):
    made, state = build_touching_start()
    stated = build_problem(made, state, "inertial")
    (energy,) = (e for e in made.system.energies if isinstance(e, Energy))
    p = stated.initial_guess
    for q in islice(prepare(made, solver(name)).iterates(stated), 12):
        for t in np.linspace(0.0, 1.0, 5):
            assert (
                not energy.find_violated_pairs(p + t * (q - p)) or name == "hybrid"
            )  # whose iterates are rounds of many steps
        assert not energy.find_violated_pairs(q)
        p = q.copy()


def test_all_methods_find_the_same_minimum_from_near_it():
    made, state = build_touching_start()
    stated = build_problem(made, state, "inertial")
    (energy,) = (e for e in made.system.energies if isinstance(e, Energy))
    lowest = prepare(made, NewtonSolver()).solve(stated, StopRule(300, 1e-9)).positions
    assert len(energy.hessian_blocks(lowest).vertices) > 3
    away = 1e-4 * np.random.default_rng(0).normal(size=lowest.shape)
    stated = replace(stated, initial_guess=lowest + energy.collision_free_step_size(lowest, away) * away)
    for name in SOON:
        found = prepare(made, solver(name)).solve(stated, StopRule(3000, 1e-7)).positions
        # |Q^-1 grad g|_Q has fallen to 1e-7 of the initial one, about 1 J^.5, over a softest curvature of 1 N/m.
        np.testing.assert_allclose(found, lowest, atol=5e-6)


@pytest.mark.parametrize("name", sorted(set(SOLVERS) - {*TAKE, "avbd"}))  # which is vbd where no length is exact
def test_all_other_solvers_refuse_it_by_name(name):
    with pytest.raises(Unsupported, match="SelfContact"):
        solver(name).prepare(upside_down(SELF_CONTACT).system)


@pytest.mark.parametrize("name", ["newton", "hybrid"])
def test_sheets_that_all_but_touch_fall_as_one(name):
    # Gaps of a billionth of the range are 1e15 N/m stiff: of 30 mm that all fall, too few digits were left for them.
    spec = load_scene(CONFIGS / "hard-touch" / "coplanar-sheets.yaml")
    made = build_scene(spec, 4)
    steps = simulate_scene(made, prepare(made, solver(name)), StopRule(20, 1e-4), initial_guess="previous", frames=2)
    assert all(step.solution.termination_reason == "converged" for step in steps)


@pytest.mark.parametrize("name", TAKE)
def test_where_nothing_is_near_the_motion_is_that_without(name, monkeypatch):
    calls = []
    monkeypatch.setattr(_Certificate, "is_idle_at", lambda *given: calls.append(given) or is_idle_at(*given))
    runs = []
    for effects in ((), (SelfContactEffect(min_distance=1e-4),)):
        pins = PinsEffect(parts=("top_corners",))
        made = build_test_scene(
            GridMesh(), SpringsEffect(stretch=100.0, shear=20.0), GravityEffect(), pins, *effects, size=7
        )
        steps = simulate_scene(
            made, prepare(made, solver(name)), StopRule(50, 1e-4), initial_guess="extrapolated", frames=3
        )
        runs.append([step.positions for step in steps])
    np.testing.assert_array_equal(*runs)
    assert len(calls) == 3  # one certificate a step


@functools.cache
def first_touch() -> tuple[Scene, StepProblem]:
    """The first step that begins without and ends with active pairs."""
    made = upside_down(SELF_CONTACT)
    (energy,) = (e for e in made.system.energies if isinstance(e, Energy))
    for step in simulate_scene(
        made, prepare(made, NewtonSolver()), StopRule(60, 1e-3), initial_guess="previous", frames=14
    ):
        if energy.value(step.positions) > 0.0:
            return made, step.problem
    raise AssertionError("nothing touches")


@pytest.mark.parametrize("name", TAKE)
def test_a_solve_of_the_first_touch_ends_at_exactly_the_iterate_of_its_number(name):
    made, stated = first_touch()
    prepared = prepare(made, solver(name))
    path = [p.copy() for p in islice(prepared.iterates(stated), 6)]
    for count in (1, 3, 6):
        np.testing.assert_array_equal(prepared.solve(stated, StopRule(count)).positions, path[count - 1])


def test_an_iterate_without_contact_counts_only_where_its_path_is_free():
    made, stated = first_touch()
    certificate = _Certificate(stated)
    p, (energy,) = stated.initial_guess, (e for e in made.system.energies if isinstance(e, Energy))
    beyond = p.copy()
    beyond[:, 1] = -1.0 - p[:, 1]  # what is on one side of a plane comes to the other, through itself
    assert certificate.can_be_idle()
    assert certificate.is_idle_at(p + 1e-6)
    assert energy.value(beyond) == 0.0
    assert not certificate.is_idle_at(beyond)
    touching = prepare(made, NewtonSolver()).solve(stated, StopRule(60, 1e-3)).positions
    assert energy.value(touching) > 0.0
    assert max_step_size([energy], p, touching - p) == 1.0
    assert not certificate.is_idle_at(touching)
    assert not certificate.is_idle_at(np.full_like(p, np.nan))


def test_two_free_sheets_that_collide_conserve_momentum():
    made = build_test_scene(
        StackMesh(layer_spacing=0.05), SpringsEffect(stretch=100.0, shear=20.0), SELF_CONTACT, size=5
    )
    p, v = made.mesh.rest_positions, np.zeros_like(made.mesh.rest_positions)
    v[len(p) // 2 :] = (0.1, -2.0, 0.0)
    state, mass = MotionState(integrators.Motion(p, v), None, 0), made.system.mass
    before, touched = mass @ v, 0
    (energy,) = (e for e in made.system.energies if isinstance(e, Energy))
    rule = StopRule(100, 1e-11)
    for step in simulate_scene(
        made, prepare(made, NewtonSolver()), rule, initial_guess="extrapolated", frames=6, initial_state=state
    ):
        touched += len(energy.hessian_blocks(step.positions).vertices)
        # Forces of pairs add up to nothing; what is left is the solve's tolerance.
        np.testing.assert_allclose(mass @ step.state.motion.velocity, before, atol=1e-8)
        assert count_intersections(made, step.positions, 0.0) == 0
    assert touched > 50


STARTS = {
    "through itself": (ScaledStart(factors=(1.0, 0.0, 1.0)), "passes through itself"),
    "collapsed": (CollapsedStart(), "passes through itself"),
    "too near": (ScaledStart(factors=(1.0, 0.02, 1.0)), "pairs start nearer than the min_distance.*vertex|edges"),
}


@pytest.mark.parametrize("name", STARTS)
def test_an_intersecting_start_is_refused_with_the_pairs(name):
    begin, words = STARTS[name]
    made = build_test_scene(StackMesh(layer_spacing=0.2), SpringsEffect(stretch=100.0), SELF_CONTACT, size=3)
    (check,) = SELF_CONTACT.build_contribution(made.mesh, made.system.mass, 1 / 30).scene_checks
    with pytest.raises(InputError, match=words):
        check(begin.compute_positions(made.mesh.rest_positions), ())
    check(build_initial_state(made).motion.positions, ())


def test_a_mesh_through_itself_at_rest_is_refused():
    with pytest.raises(InputError, match=r"passes through itself at rest.*edge \d+-\d+ through triangle"):
        build_test_scene(StackMesh(layer_spacing=0.0), SpringsEffect(stretch=100.0), SELF_CONTACT, size=3)


def test_exact_pins_that_move_are_refused():
    moves = KeyFrameMotion(key_frames=(KeyFrame(time=0.0), KeyFrame(time=1.0, offset=(0.1, 0.0, 0.0))))
    pins = PinsEffect(parts=("left",), motion=moves, weight="exact")
    with pytest.raises(InputError, match="exact pin of vertex 0 moves"):
        build_test_scene(GridMesh(), SpringsEffect(stretch=100.0), pins, SELF_CONTACT, size=4)


@pytest.mark.parametrize("name", ["midpoint", "sdirk-2", "generalised-alpha"])
def test_integrators_whose_stages_are_at_other_times_are_refused(name):
    given = {"mesh": GridMesh(), "mass": 1.0, "time_step": 0.02, "frames": 1, "path": "scene.yaml"}
    spec = SceneSpec.model_validate(given | {"effects": (SpringsEffect(stretch=1.0), SELF_CONTACT)})
    with pytest.raises(InputError, match=f"end of a step, and {name} has stages at other times"):
        build_scene(spec, 4, name)
    assert build_scene(spec, 4, "bdf2").intersection_checks


def test_a_fine_mesh_with_edges_below_the_thickness_runs():
    fine = SelfContactEffect(min_distance=0.2)
    made = build_test_scene(
        GridMesh(), SpringsEffect(stretch=100.0, shear=20.0), GravityEffect(), PinsEffect(parts=("left",)), fine, size=9
    )
    assert made.mesh.spacing < fine.min_distance
    for step in simulate_scene(
        made, prepare(made, NewtonSolver()), StopRule(30, 1e-4), initial_guess="previous", frames=2
    ):
        assert count_intersections(made, step.positions, 0.0) == 0


@pytest.mark.parametrize("friction", [0.0, 0.4])
@pytest.mark.parametrize(("stiff", "expected"), [(0.1, "agrees"), (0.1001, "disagrees: effects[1] self-contact")])
def test_the_reference_terms_agree_with_this_barrier_and_no_other(stiff, expected, friction, monkeypatch):
    given = {"mesh": GridMesh(), "mass": 1.0, "time_step": 0.02, "frames": 3, "path": "scene.yaml"}
    spec = SceneSpec.model_validate(
        given | {"effects": (SpringsEffect(stretch=100.0), SelfContactEffect(min_distance=0.4, friction=friction))}
    )
    monkeypatch.setattr(collision_primitives, "_STIFFNESS_FRACTION", stiff)
    assert verify_terms(spec, build_scene(spec, 3), "implicit-euler").startswith(expected)


def test_the_reference_terms_differ_from_another_friction(monkeypatch):
    given = {"mesh": GridMesh(), "mass": 1.0, "time_step": 0.02, "frames": 3, "path": "scene.yaml"}
    rough = SelfContactEffect(min_distance=0.4, friction=0.4)
    spec = SceneSpec.model_validate(given | {"effects": (SpringsEffect(stretch=100.0), rough)})
    made = build_scene(spec, 3)
    (energy,) = (e for e in made.system.energies if isinstance(e, Energy))
    object.__setattr__(energy, "friction", 0.401)
    assert verify_terms(spec, made, "implicit-euler").startswith("disagrees: effects[1] self-contact")
