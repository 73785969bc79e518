"""Newton's method with contact: friction is settled at each trial point, and steps look ahead into half-spaces."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from springbench.harness.config.config_loader import load_scene
from springbench.harness.scenes.scene_builder import Scene, build_scene
from springbench.harness.simulation.time_loop import prepare, simulate_scene
from springbench.solvers.iteration.descent_method import PreparedDescent
from springbench.solvers.methods.newton.friction_gauss_seidel import FrictionGaussSeidel
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.step_problem import Solution, StepProblem, StopRule
from springbench.solvers.objective.fixed_objective import FixedObjective
from springbench.solvers.objective.step_objective import StepObjective

SCENES = Path(__file__).parents[2] / "configs" / "scenes"
STOP = StopRule(500, 1e-9)
FRAMES = 40
"""The ball has met the net, and slides on it."""


@pytest.fixture(scope="module")
def scene() -> Scene:
    return build_scene(load_scene(SCENES / "net-catches-ball.yaml"), 9)


@pytest.fixture(scope="module")
def solved_steps(scene) -> list[tuple[StepProblem, Solution]]:
    prepared = prepare(scene, NewtonSolver())
    run = simulate_scene(scene, prepared, STOP, initial_guess="previous", frames=FRAMES)
    return [(step.problem, prepared.solve(step.problem, STOP)) for step in run]


def test_it_finds_the_minima_of_newtons_method_alone_in_less_than_half_of_the_iterations(scene, solved_steps):
    alone = NewtonSolver().prepare(scene.system)
    assert isinstance(alone, PreparedDescent)
    alone.method._friction_search = None  # pyright: ignore[reportAttributeAccessIssue]
    iterations = 0
    for problem, solution in solved_steps[20:]:
        expected = alone.solve(problem, STOP)
        np.testing.assert_allclose(solution.positions, expected.positions, rtol=0, atol=1e-6)
        iterations += expected.num_iterations
    assert 2 * sum(solution.num_iterations for _, solution in solved_steps[20:]) < iterations


def test_settling_lowers_the_objective_and_leaves_a_minimum_where_it_is(scene, solved_steps):
    prepared, objective = NewtonSolver().prepare(scene.system), FixedObjective(scene.system)
    assert isinstance(prepared, PreparedDescent)
    settling, noise = FrictionGaussSeidel(prepared.metric), np.random.default_rng(0)
    lowered = 0
    for problem, solution in solved_steps[20:]:
        step, p = StepObjective(objective, problem), solution.positions
        np.testing.assert_allclose(
            settling.relax_friction(step, p), p, rtol=0, atol=1e-7
        )  # ten times what a tolerance of 1e-9 leaves to go
        away = step.apply_exact_pins(p + 1e-3 * noise.normal(size=p.shape))
        settled = settling.relax_friction(step, away)
        lowered += settled is not away
        assert problem.value(settled) <= problem.value(away)
    assert lowered == len(solved_steps[20:])
