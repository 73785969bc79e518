"""Contact with every solver: those that take it agree and descend, others refuse it by name; idle, it costs no bit."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import islice

import numpy as np
import pytest
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.simulation.time_loop import prepare, simulate_scene
from springbench.solvers.methods.local_global import half_space_contact as method
from springbench.solvers.model.step_problem import Positions, Solver, StepProblem, StopRule, Unsupported
from springbench.solvers.registry import SOLVERS, load_target

from tests.contact_scenes import OBSTACLE_SPECS, build_contact, build_sheet, collect_steps

SOLVER_INSTANCES: dict[str, Solver] = {name: load_target(target)() for name, target in SOLVERS.items()}
PREFACTORED_SOLVERS = ("sparse", "numba", "anderson", "chebyshev", "lbfgs")
TAKE = (*PREFACTORED_SOLVERS, "vbd", "hybrid", "newton", "newton-cg")
FLOOR = build_contact(OBSTACLE_SPECS["plane"], friction=0.4)
FALL = (0.5, -6.0, 0.0)


def build_pinned_scene(weight: float | str) -> Scene:
    return build_sheet(FLOOR, PinsEffect.model_validate({"parts": ["top_corners"], "weight": weight}), velocity=FALL)


SCENES = {
    "frictionless": lambda: build_sheet(build_contact(OBSTACLE_SPECS["plane"]), velocity=FALL),
    "friction": lambda: build_sheet(FLOOR, velocity=FALL),
    "two obstacles": lambda: build_sheet(
        build_contact(OBSTACLE_SPECS["sphere"], OBSTACLE_SPECS["capsule"], friction=0.2), velocity=FALL
    ),
    "held by penalty": lambda: build_pinned_scene(1e10),
    "held exactly": lambda: build_pinned_scene("exact"),
}


@cache
def find_contact_step(scene: str) -> tuple[StepProblem, Positions]:
    """The step at which most presses and something is in friction, and its minimum by Newton's method."""
    step = collect_steps(SCENES[scene](), 4, stop=StopRule(100, 1e-12))[-1]
    energy = step.problem.energies[-1]
    before, after = step.problem.current_positions, step.solution.positions
    rows = energy.build_penalty_rows(before, after, majorise=False)  # pyright: ignore[reportAttributeAccessIssue]
    assert len(rows.vertices) > 3
    return step.problem, step.solution.positions


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("solver", TAKE)
def test_solvers_agree_at_convergence(solver, scene):
    problem, expected = find_contact_step(scene)
    found = SOLVER_INSTANCES[solver].prepare(problem.system).solve(problem, StopRule(1500, 1e-9))
    # Local-global converges linearly: what is left is some hundred times the last step, 1e-9 of the first.
    np.testing.assert_allclose(found.positions, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("solver", sorted(set(SOLVER_INSTANCES) - {*TAKE, "avbd", "vbd-ogc"}))  # both are vbd here
def test_others_refuse_contact_by_name(solver):
    with pytest.raises(Unsupported, match="Contact"):
        SOLVER_INSTANCES[solver].prepare(SCENES["friction"]().system)


@pytest.mark.parametrize("few", [method._MAX_WOODBURY_ROWS, 0], ids=["Woodbury", "conjugate gradients"])
@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("solver", [*PREFACTORED_SOLVERS, "vbd"])
def test_no_iteration_raises_the_objective(solver, scene, few, monkeypatch):
    monkeypatch.setattr(method, "_MAX_WOODBURY_ROWS", few)
    problem, expected = find_contact_step(scene)
    problem = replace(problem, initial_guess=problem.inertial_target)  # deep inside
    values = [problem.value(problem.initial_guess)]
    for p in islice(SOLVER_INSTANCES[solver].prepare(problem.system).iterates(problem), 30):
        values.append(problem.value(p))
        assert values[-1] <= values[-2] + 1e-12 * problem.value_scale(p)  # sums of some hundred terms
    scale = values[0] - problem.value(expected)
    assert values[-1] - problem.value(expected) <= 1e-2 * scale


@pytest.mark.parametrize("scene", ["friction", "held exactly"])
def test_conjugate_gradients_correct_as_woodburys_formula_does(scene, monkeypatch):
    problem, _ = find_contact_step(scene)
    rng = np.random.default_rng(0)
    prepared = method.prepare_with_half_spaces(SOLVER_INSTANCES["sparse"], problem.system)
    corrections, (energy,) = prepared.corrections, method.begin_active_contacts(problem)
    p = problem.current_positions
    gradient = rng.normal(size=p.shape)
    gradient[problem.system.pins.vertices[problem.system.pins.exact_mask]] = 0.0
    plain = corrections.solve_without_contact(gradient)
    exact, rows = corrections.solve_with_contact([energy], p, gradient, plain, majorise=True)
    monkeypatch.setattr(method, "_MAX_WOODBURY_ROWS", 0)
    monkeypatch.setattr(method, "_MAX_CG_ITERATIONS", 2000)
    monkeypatch.setattr(method, "_CG_RTOL", 1e-12)
    found = corrections.solve_with_rows(rows, gradient, plain)
    # Weights lie six orders above Q: so many digits of sixteen are lost, on both ways.
    np.testing.assert_allclose(found, exact, rtol=0, atol=1e-6 * np.abs(exact).max())


@pytest.mark.parametrize("solver", [*PREFACTORED_SOLVERS, "vbd"])
def test_contact_that_is_idle_changes_no_bit(solver):
    far = build_contact({"kind": "plane", "point": (0, -50, 0)}, friction=0.5)
    runs = [
        [
            step.positions
            for step in simulate_scene(
                made, prepare(made, SOLVER_INSTANCES[solver]), StopRule(10), initial_guess="previous", frames=4
            )
        ]
        for made in (build_sheet(), build_sheet(far))
    ]
    np.testing.assert_array_equal(runs[0], runs[1])


@pytest.mark.parametrize("solver", TAKE)
def test_a_solve_ends_at_exactly_the_iterate_of_its_number(solver):
    problem, _ = find_contact_step("friction")
    prepared = SOLVER_INSTANCES[solver].prepare(problem.system)
    for count in (1, 3):
        expected = [p.copy() for p in islice(prepared.iterates(problem), count)][-1]
        np.testing.assert_array_equal(prepared.solve(problem, StopRule(count)).positions, expected)
