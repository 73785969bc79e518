"""Newton's methods: properties of all of them on hard cases, and what the exact one does near a minimum."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice, pairwise

import numpy as np
import pytest
from springbench.harness.reference.hessian_curvature import build_free_hessian
from springbench.harness.scenes.effects.bending_effect import BendingEffect
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect as PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect as SpringsEffect
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.simulation.time_loop import build_problem
from springbench.solvers.iteration.descent_method import PreparedDescent
from springbench.solvers.methods.newton.hybrid_newton import HybridNewton
from springbench.solvers.methods.newton.negative_curvature import is_positive_definite
from springbench.solvers.methods.newton.newton_cg import NewtonCG
from springbench.solvers.methods.newton.newton_direct import NewtonSolver, PreparedExactNewton
from springbench.solvers.model.step_problem import Positions, StepProblem, StopRule
from springbench.solvers.objective.fixed_objective import FixedObjective
from springbench.solvers.objective.step_objective import StepObjective

from tests.scene_builders import build_cloth, build_first_problem, build_random_problem, build_test_scene
from tests.stability.test_hard_cases import CASES, resting

SOLVERS = [NewtonSolver(), NewtonCG(), HybridNewton()]
solvers = pytest.mark.parametrize("solver", SOLVERS, ids=lambda s: type(s).__name__)

ENOUGH = StopRule(300)
"""The hardest case takes 200 iterations to round-off."""


def build_case_step(case) -> StepProblem:
    made = case.scene()
    return build_problem(made, resting(case.start(made.mesh.rest_positions)), "assignment")


def is_certified(found: StepProblem, p: Positions) -> bool:
    step = StepObjective(FixedObjective(found.system), found)
    return is_positive_definite(step, step.apply_exact_pins(p))


@solvers
@pytest.mark.parametrize("case", CASES.values(), ids=list(CASES))
def test_a_hard_case_ends_at_a_certified_minimum(case, solver):
    given = build_case_step(case)
    path = [given.initial_guess.copy()]
    for p in islice(solver.prepare(given.system).iterates(given), 300):
        path.append(p.copy())
        if np.array_equal(path[-1], path[-2]):
            break
    assert np.isfinite(path).all()
    values = [given.value(p) for p in path]
    # The reference's own round-off: lengths are good to eps, energies of stiff springs to that over their strain.
    slack = 1e-12 * max(given.value_scale(p) for p in path[1:])
    assert all(b <= a + slack for a, b in pairwise(values[1:]))
    assert is_certified(given, path[-1])


@solvers
@pytest.mark.parametrize("guess", [1e-3, 1.0, 1e3], ids="{:g} m".format)
def test_a_random_start_ends_at_a_certified_minimum(solver, guess):
    given = build_random_problem(5, n=30, m=80)
    given = replace(given, initial_guess=guess * np.random.default_rng(0).normal(size=given.inertial_target.shape))
    solution = solver.prepare(given.system).solve(given, ENOUGH)
    assert solution.termination_reason == "stalled"
    assert is_certified(given, solution.positions)
    gradient = np.abs(given.gradient(solution.positions)).max()
    assert gradient <= 1e-10 * np.abs(given.gradient(given.current_positions)).max()


# What cannot stretch comes down 1 cm in steps along a curved valley, the narrower the stiffer. With 1e12 the exact
# method takes 2,500 steps of .2 ms; conjugate gradients need too many iterations in each.
RATIOS = [(ratio, s) for s in SOLVERS for ratio in (1e-3, 1.0, 1e3, 1e6, 1e9, 1e12)]
RATIOS = [(ratio, s) for ratio, s in RATIOS if ratio <= 1e6 or not isinstance(s, NewtonCG)]


@pytest.mark.parametrize(("ratio", "solver"), RATIOS, ids=lambda x: type(x).__name__ if x in SOLVERS else f"{x:g}")
def test_any_ratio_of_stiffness_to_inertia_ends_at_a_certified_minimum(ratio, solver):
    given = build_first_problem(build_cloth(6, "exact"))
    dt = given.system.time_step
    mass = np.full(given.system.num_vertices, 300.0 * dt**2 / ratio)
    system = replace(given.system, mass=mass)
    force = np.zeros_like(given.external_force)
    force[:, 1] = -9.8 * mass
    given = replace(given, system=system, external_force=force)
    solution = solver.prepare(system).solve(given, StopRule(4000))
    assert solution.termination_reason == "stalled"
    assert is_certified(given, solution.positions)


def build_bending_cloth() -> StepProblem:
    pins = PinsEffect.model_validate({"parts": ["top_corners"], "weight": "exact"})
    effects = SpringsEffect(stretch=300.0, shear=60.0), GravityEffect(), BendingEffect(stiffness=1e-3), pins
    return build_first_problem(build_test_scene(GridMesh(), *effects, size=8))


@pytest.mark.parametrize(
    "build",
    [
        build_bending_cloth,
        lambda: build_random_problem(5, n=30, m=80),
        *(lambda case=case: build_case_step(case) for case in CASES.values()),
    ],
    ids=["bending", "random springs", *CASES],
)
def test_compiled_iterations_are_those_of_the_interpreted_loop(build):
    given = build()
    compiled, interpreted = (NewtonSolver().prepare(given.system) for _ in range(2))
    assert isinstance(compiled, PreparedExactNewton)
    assert isinstance(interpreted, PreparedExactNewton)
    assert compiled.compiled_method is not None
    vars(interpreted)["compiled_method"] = None
    for p, q in islice(zip(compiled.iterates(given), interpreted.iterates(given), strict=False), 40):
        np.testing.assert_array_equal(p, q)
    for stop in (StopRule(7), StopRule(60, 1e-6), StopRule(300)):
        found, expected = compiled.solve(given, stop), interpreted.solve(given, stop)
        np.testing.assert_array_equal(found.positions, expected.positions)
        assert found.num_iterations == expected.num_iterations
        assert found.termination_reason == expected.termination_reason
        assert found.residual == pytest.approx(expected.residual, rel=1e-12, abs=1e-300)
    factors = [one.fixed_objective.hessian_matrix.factor for one in (compiled, interpreted)]
    assert factors[0].num_factorisations == pytest.approx(factors[1].num_factorisations)


def test_newton_converges_quadratically():
    """Each step on the way from 1e-3 to round-off squares the residual, up to a factor."""
    given = build_first_problem(build_cloth(12, "exact"))
    prepared = NewtonSolver().prepare(given.system)
    assert isinstance(prepared, PreparedDescent)
    step = StepObjective(prepared.fixed_objective, given)
    residuals = [prepared.metric.residual(step.gradient(p.copy())) for p in islice(prepared.iterates(given), 40)]
    start = prepared.metric.residual(step.gradient(given.current_positions))
    assert residuals[-1] <= 1e-12 * start
    near = [r / start for r in residuals if 1e-11 * start < r < 1e-3 * start]
    # A linear method that comes from 1e-3 to 1e-11 at the rate of the clamped one, a half or worse, takes 27 steps.
    assert 1 <= len(near) <= 4


def test_newton_ends_within_few_factorisations_where_clamping_takes_many():
    """k dt^2/m = 6.4e4 at 24 x 24: 25 steps to round-off, where clamping all negative lateral parts takes 96."""
    given = build_first_problem(build_cloth(24, "exact", stretch=1e5))
    solution = NewtonSolver().prepare(given.system).solve(given, StopRule(40))
    assert solution.termination_reason == "stalled"
    assert is_certified(given, solution.positions)


def test_newton_leaves_a_saddle():
    """A chain that is pushed together along its own line feels no force sideways, but is not stable."""
    pins = PinsEffect.model_validate({"parts": ["ends"], "weight": "exact"})
    made = build_test_scene(ChainMesh(length=1.0), SpringsEffect(stretch=1e4), pins, size=9, time_step=1.0)
    given = build_first_problem(made)
    middle = 0.5 * (made.mesh.rest_positions[0] + made.mesh.rest_positions[-1])
    squeezed = middle + 0.5 * (made.mesh.rest_positions - middle)
    targets = squeezed[given.system.pins.vertices]
    given = replace(
        given, inertial_target=squeezed, current_positions=squeezed, initial_guess=squeezed, pin_targets=targets
    )
    assert np.abs(given.gradient(squeezed)).max() <= 1e-9
    assert not is_certified(given, squeezed)
    solution = NewtonSolver().prepare(given.system).solve(given, ENOUGH)
    assert given.value(solution.positions) < 0.5 * given.value(squeezed)
    curvature = np.linalg.eigvalsh(build_free_hessian(given, solution.positions).toarray())
    assert curvature[0] >= -1e-12 * curvature[-1], "zero, where it turns about its own line, but for round-off"


def test_a_step_at_rest_ends_at_once():
    given = build_first_problem(build_cloth(6, "exact"))
    given = replace(given, external_force=np.zeros_like(given.external_force))
    solution = NewtonSolver().prepare(given.system).solve(given, StopRule(50, 1e-6))
    assert solution.num_iterations == 0
    np.testing.assert_array_equal(solution.positions, given.current_positions)


@solvers
def test_nothing_to_solve_for_is_solved(solver):
    given = build_random_problem(0, weights=(np.inf,) * 12)
    solution = solver.prepare(given.system).solve(given, StopRule(5, 1e-3))
    np.testing.assert_array_equal(solution.positions, given.pin_targets)


@solvers
def test_all_newtons_find_the_same_minimum_of_a_taut_cloth(solver):
    """Hanging under its own weight far from rest, springs are taut and the minimum is the only one near."""
    pins = PinsEffect.model_validate({"parts": ["top"], "weight": "exact"})
    made = build_test_scene(
        GridMesh(), SpringsEffect(stretch=300.0, shear=60.0), GravityEffect(), pins, size=8, mass=50.0
    )
    given = build_first_problem(made)
    expected = NewtonSolver().prepare(given.system).solve(given, ENOUGH).positions
    found = solver.prepare(given.system).solve(given, ENOUGH).positions
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11)  # gradients of round-off over a stiffness of 1
