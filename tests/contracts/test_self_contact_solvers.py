"""A mesh that cannot pass through itself, by every solver: no crossing in any frame, or refused by name."""

from __future__ import annotations

import functools
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from harness.base.errors import InputError
from harness.config.load import load_scene
from harness.scenes import touching
from harness.scenes.bind import Scene, build
from harness.scenes.effects.base import Effect
from harness.scenes.effects.gravity import Gravity
from harness.scenes.effects.pins import Pins
from harness.scenes.effects.self_contact import SelfContact
from harness.scenes.effects.springs import Springs
from harness.scenes.mesh.grid import Grid
from harness.scenes.mesh.stack import Stack
from harness.scenes.motion import Key, KeyedMotion
from harness.scenes.spec import SceneSpec
from harness.scenes.start import Collapsed, Scaled
from harness.simulation.observe import intersections
from harness.simulation.opinion.second import second_opinion
from harness.simulation.step import State, prepare, problem, simulate, start
from solvers import integrators
from solvers.contact.self_contact import SelfContact as Energy
from solvers.methods.newton import Newton
from solvers.problem import StopRule, Unsupported
from solvers.registry import SOLVERS, load
from tests.scenes import scene

SOON = ("newton", "newton-cg", "pncg", "lbfgs", "hybrid", "vbd", "anderson")
"""Those that are near a minimum within some hundred iterations."""
TAKE = (*SOON, "chebyshev", "sparse", "numba")
CONFIGS = Path(__file__).resolve().parents[2] / "configs"
THICKNESS = 0.01
APART = SelfContact(thickness=THICKNESS)


def upside_down(*effects: Effect) -> Scene:
    """A sheet that is held at its top corners falls upwards, and onto itself."""
    grid, up = Grid(plane="vertical", diagonals="one"), Gravity(acceleration=(0.0, 9.81, 0.0))
    return scene(grid, Springs(stretch=100.0, shear=20.0), up, Pins(at=("top_corners",)), *effects, size=7)


def solver(name: str):
    return load(SOLVERS[name])()


@pytest.mark.parametrize("name", TAKE)
def test_a_sheet_that_falls_onto_itself_passes_through_nowhere(name):
    made, touched = upside_down(APART), 0
    (energy,) = (e for e in made.system.energies if isinstance(e, Energy))
    rule = StopRule(60, 1e-3)
    for step in simulate(made, prepare(made, solver(name)), rule, first_guess="motion", frames=14):
        assert intersections(made, step.positions, 0.0) == 0
        assert not energy.closed(step.positions)
        touched = max(touched, len(energy.blocks(step.positions).vertices))
    assert touched > 5


def test_without_the_effect_it_does_pass_through():
    made, (apart,) = upside_down(), upside_down(APART).apart
    steps = simulate(made, prepare(made, Newton()), StopRule(60, 1e-3), first_guess="motion", frames=14)
    assert any(apart.crossings(step.positions, 0.0) for step in steps)
    assert intersections(made, made.mesh.rest, 0.0) is None


@functools.cache
def begun() -> tuple[Scene, State]:
    """A step in which it touches."""
    made = upside_down(APART)
    rule = StopRule(60, 1e-3)
    *_, last = simulate(made, prepare(made, Newton()), rule, first_guess="motion", frames=9)
    return made, last.state


@pytest.mark.parametrize("name", TAKE)
def test_every_iterate_is_free_and_the_way_to_it(name):
    made, state = begun()
    stated = problem(made, state, "inertial")
    (energy,) = (e for e in made.system.energies if isinstance(e, Energy))
    p = stated.first_guess
    for q in islice(prepare(made, solver(name)).iterates(stated), 12):
        for t in np.linspace(0.0, 1.0, 5):
            assert not energy.closed(p + t * (q - p)) or name == "hybrid"  # whose iterates are rounds of many steps
        assert not energy.closed(q)
        p = q.copy()


def test_all_methods_find_the_same_minimum_from_near_it():
    made, state = begun()
    stated = problem(made, state, "inertial")
    (energy,) = (e for e in made.system.energies if isinstance(e, Energy))
    lowest = prepare(made, Newton()).solve(stated, StopRule(300, 1e-9)).positions
    assert len(energy.blocks(lowest).vertices) > 3
    away = 1e-4 * np.random.default_rng(0).normal(size=lowest.shape)
    stated = replace(stated, first_guess=lowest + energy.largest_step(lowest, away) * away)
    for name in SOON:
        found = prepare(made, solver(name)).solve(stated, StopRule(3000, 1e-7)).positions
        # |Q^-1 grad g|_Q has fallen to 1e-7 of the yardstick, about 1 J^.5, over the softest curvature of about 1 N/m.
        np.testing.assert_allclose(found, lowest, atol=5e-6)


@pytest.mark.parametrize("name", sorted(set(SOLVERS) - {*TAKE, "avbd"}))  # which is vbd where no length is exact
def test_all_other_solvers_refuse_it_by_name(name):
    with pytest.raises(Unsupported, match="SelfContact"):
        solver(name).prepare(upside_down(APART).system)


@pytest.mark.parametrize("name", ["newton", "hybrid"])
def test_sheets_that_all_but_touch_fall_as_one(name):
    # Gaps of a billionth of the range are 1e15 N/m stiff: of 30 mm that all fall, too few digits were left for them.
    spec = load_scene(CONFIGS / "hard-touch" / "coplanar-sheets.yaml")
    made = build(spec, 4)
    steps = simulate(made, prepare(made, solver(name)), StopRule(20, 1e-4), first_guess="current", frames=2)
    assert all(step.solution.stopped == "tolerance" for step in steps)


@pytest.mark.parametrize("name", ["newton", "hybrid", "sparse", "numba", "vbd"])
def test_where_nothing_is_near_the_motion_is_that_without(name):
    runs = []
    for effects in ((), (SelfContact(thickness=1e-4),)):
        pins = Pins(at=("top_corners",))
        made = scene(Grid(), Springs(stretch=100.0, shear=20.0), Gravity(), pins, *effects, size=7)
        steps = simulate(made, prepare(made, solver(name)), StopRule(50, 1e-4), first_guess="motion", frames=3)
        runs.append([step.positions for step in steps])
    np.testing.assert_array_equal(*runs)


def test_two_free_sheets_that_collide_keep_their_momentum():
    made = scene(Stack(apart=0.05), Springs(stretch=100.0, shear=20.0), APART, size=5)
    p, v = made.mesh.rest, np.zeros_like(made.mesh.rest)
    v[len(p) // 2 :] = (0.1, -2.0, 0.0)
    state, mass = State(integrators.Motion(p, v), None, 0), made.system.mass
    before, touched = mass @ v, 0
    (energy,) = (e for e in made.system.energies if isinstance(e, Energy))
    rule = StopRule(100, 1e-11)
    for step in simulate(made, prepare(made, Newton()), rule, first_guess="motion", frames=6, state=state):
        touched += len(energy.blocks(step.positions).vertices)
        # Forces of pairs add up to nothing; what is left is the solve's tolerance.
        np.testing.assert_allclose(mass @ step.state.now.velocity, before, atol=1e-8)
        assert intersections(made, step.positions, 0.0) == 0
    assert touched > 50


STARTS = {
    "through itself": (Scaled(factors=(1.0, 0.0, 1.0)), "passes through itself"),
    "collapsed": (Collapsed(), "passes through itself"),
    "too near": (Scaled(factors=(1.0, 0.02, 1.0)), "pairs start nearer than the thickness.*vertex|edges"),
}


@pytest.mark.parametrize("name", STARTS)
def test_a_start_that_is_not_free_is_refused_with_the_pairs(name):
    begin, words = STARTS[name]
    made = scene(Stack(apart=0.2), Springs(stretch=100.0), APART, size=3)
    (check,) = APART.bind(made.mesh, made.system.mass, 1 / 30).checks
    with pytest.raises(InputError, match=words):
        check(begin.positions(made.mesh.rest), ())
    check(start(made).now.positions, ())


def test_a_mesh_through_itself_at_rest_is_refused():
    with pytest.raises(InputError, match=r"passes through itself at rest.*edge \d+-\d+ through triangle"):
        scene(Stack(apart=0.0), Springs(stretch=100.0), APART, size=3)


def test_exact_pins_that_move_are_refused():
    moves = KeyedMotion(keys=(Key(time=0.0), Key(time=1.0, offset=(0.1, 0.0, 0.0))))
    pins = Pins(at=("left",), motion=moves, weight="exact")
    with pytest.raises(InputError, match="exact pins that move"):
        scene(Grid(), Springs(stretch=100.0), pins, APART, size=4)


@pytest.mark.parametrize("name", ["midpoint", "sdirk-2", "generalised-alpha"])
def test_integrators_whose_unknowns_lie_elsewhere_are_refused(name):
    given = {"mesh": Grid(), "mass": 1.0, "time_step": 0.02, "frames": 1, "path": "scene.yaml"}
    spec = SceneSpec.model_validate(given | {"effects": (Springs(stretch=1.0), APART)})
    with pytest.raises(InputError, match=f"end of a step, and {name} has other unknowns"):
        build(spec, 4, name)
    assert build(spec, 4, "bdf2").apart


def test_a_fine_mesh_with_edges_below_the_thickness_runs():
    fine = SelfContact(thickness=0.2)
    made = scene(Grid(), Springs(stretch=100.0, shear=20.0), Gravity(), Pins(at=("left",)), fine, size=9)
    assert made.mesh.spacing < fine.thickness
    for step in simulate(made, prepare(made, Newton()), StopRule(30, 1e-4), first_guess="current", frames=2):
        assert intersections(made, step.positions, 0.0) == 0


@pytest.mark.parametrize("friction", [0.0, 0.4])
@pytest.mark.parametrize(("stiff", "told"), [(0.1, "agrees"), (0.1001, "disagrees: effects[1] self-contact")])
def test_the_second_opinion_agrees_with_the_barrier_and_with_no_other(stiff, told, friction, monkeypatch):
    given = {"mesh": Grid(), "mass": 1.0, "time_step": 0.02, "frames": 3, "path": "scene.yaml"}
    spec = SceneSpec.model_validate(
        given | {"effects": (Springs(stretch=100.0), SelfContact(thickness=0.4, friction=friction))}
    )
    monkeypatch.setattr(touching, "_STIFF", stiff)
    assert second_opinion(spec, build(spec, 3), "implicit-euler").startswith(told)


def test_the_second_opinion_knows_another_friction(monkeypatch):
    given = {"mesh": Grid(), "mass": 1.0, "time_step": 0.02, "frames": 3, "path": "scene.yaml"}
    rough = SelfContact(thickness=0.4, friction=0.4)
    spec = SceneSpec.model_validate(given | {"effects": (Springs(stretch=100.0), rough)})
    made = build(spec, 3)
    (energy,) = (e for e in made.system.energies if isinstance(e, Energy))
    object.__setattr__(energy, "friction", 0.401)
    assert second_opinion(spec, made, "implicit-euler").startswith("disagrees: effects[1] self-contact")
