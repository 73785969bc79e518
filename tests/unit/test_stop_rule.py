"""When a solve ends, and what it reports."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from springbench.harness.config.config_loader import load_scene
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect as PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect as SpringsEffect
from springbench.harness.scenes.mesh.grid_mesh import NetMesh
from springbench.harness.scenes.scene_builder import Scene, build_scene
from springbench.harness.simulation.instrumentation_pass import EnergyNorm, trace_convergence
from springbench.harness.simulation.time_loop import prepare, simulate_scene
from springbench.solvers.methods.local_global.prefactored import require_only_springs
from springbench.solvers.methods.local_global.reference_local_global import SparseLocalGlobal
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.methods.quasi_newton.lbfgs import Lbfgs
from springbench.solvers.model.rounding_bound import (
    ROUNDOFF_FACTOR,
    gradient_roundoff,
    is_gradient_roundoff,
    stable_row_norms,
)
from springbench.solvers.model.step_problem import StepProblem, StopRule

from tests.scene_builders import (
    LOCAL_GLOBAL_BACKENDS,
    build_cloth,
    build_first_problem,
    build_random_problem,
    build_test_scene,
    join_problems,
    shift_problem,
)

HARD = Path(__file__).resolve().parents[2] / "configs" / "hard"

HALF_THE_DIGITS = 1e-7
"""A residual is the root of a sum that cancels, added up in another order by each backend."""

backends = pytest.mark.parametrize("backend", LOCAL_GLOBAL_BACKENDS, ids=lambda b: type(b).__name__)


def without_motion(problem: StepProblem) -> StepProblem:
    """The same system with nothing that moves it."""
    p = problem.current_positions
    return replace(problem, inertial_target=p, external_force=np.zeros_like(p), initial_guess=p)


@backends
def test_without_a_tolerance_all_iterations_are_done(backend):
    problem = without_motion(build_first_problem(build_cloth(6)))
    solution = backend.prepare(problem.system).solve(problem, StopRule(17))
    assert (solution.num_iterations, solution.termination_reason) == (17, "max-iter")
    assert np.isnan(solution.initial_residual)
    assert np.isfinite(solution.residual)


@backends
def test_a_tolerance_ends_a_solve_at_the_first_residual_below_it(backend):
    problem = build_first_problem(build_cloth(8))
    prepared = backend.prepare(problem.system)
    curve = trace_convergence(prepared, problem, EnergyNorm(problem.system), 100).residuals
    solution = prepared.solve(problem, StopRule(100, 0.05))
    below = [k for k, residual in enumerate(curve, 1) if residual <= 0.05 * curve[0]]
    assert (solution.num_iterations, solution.termination_reason) == (below[0], "converged")
    assert solution.initial_residual == pytest.approx(
        curve[0], rel=HALF_THE_DIGITS
    )  # the guess is the current positions
    assert solution.residual == pytest.approx(curve[below[0] - 1], rel=HALF_THE_DIGITS)
    assert solution.residual <= 0.05 * solution.initial_residual


@backends
def test_the_limit_ends_a_solve_that_the_tolerance_does_not(backend):
    problem = build_first_problem(build_cloth(8))
    solution = backend.prepare(problem.system).solve(problem, StopRule(5, 1e-12))
    assert (solution.num_iterations, solution.termination_reason) == (5, "max-iter")
    assert solution.residual > 1e-12 * solution.initial_residual


@backends
@pytest.mark.parametrize("offset", [0.0, 1e3], ids="{:g} m from the origin".format)
def test_a_scene_at_rest_stops_after_one_iteration(backend, offset):
    """Its residual is round-off, of which no fraction would ever be reached; the floor is its size."""
    problem = without_motion(build_first_problem(build_cloth(12)))
    away = {
        name: getattr(problem, name) + offset
        for name in ("inertial_target", "pin_targets", "current_positions", "initial_guess")
    }
    solution = backend.prepare(problem.system).solve(replace(problem, **away), StopRule(50, 1e-6))
    assert solution.num_iterations == 1
    assert solution.termination_reason in (
        "roundoff",
        "converged",
    )  # "converged" where the residual is exactly zero


@backends
def test_the_floor_does_not_stop_a_scene_that_moves(backend):
    """Free fall from rest, the slowest start there is."""
    problem = build_first_problem(build_cloth(12))
    solution = backend.prepare(problem.system).solve(problem, StopRule(50, 1e-6))
    assert solution.termination_reason != "roundoff"
    assert solution.num_iterations > 1


@backends
def test_the_floor_can_be_taken_away(backend):
    problem = without_motion(build_first_problem(build_cloth(12)))
    solution = backend.prepare(problem.system).solve(problem, StopRule(3, 1e-9, roundoff_floor=0.0))
    assert solution.termination_reason != "roundoff"


@backends
def test_the_initial_residual_is_taken_at_the_current_positions_whatever_the_first_guess(backend):
    """A guess nearer to the solution makes a solve shorter, never stricter."""
    made = replace(build_cloth(8), initial_velocity=(1.0, 0.0, 0.0))
    current, inertial = (build_first_problem(made, guess) for guess in ("previous", "inertial"))
    prepared = backend.prepare(made.system)
    found = [prepared.solve(problem, StopRule(100, 0.05)) for problem in (current, inertial)]
    first = next(iter(prepared.iterates(current)))
    residual = EnergyNorm(made.system)(first - current.current_positions)
    for solution in found:
        assert solution.initial_residual == pytest.approx(residual, rel=HALF_THE_DIGITS)
    assert found[0].num_iterations != found[1].num_iterations  # the guesses do differ


@backends
def test_the_residual_leaves_pinned_vertices_out(backend):
    """The assignment's guess leaves pins off their targets; with a weight of 1e10 that would be all one sees."""
    problem = build_random_problem(0, weights=(1e10, 1e10))
    prepared = backend.prepare(problem.system)
    moved = problem.initial_guess.copy()
    moved[:2] += 1e-3
    solution = prepared.solve(replace(problem, initial_guess=moved), StopRule(1))
    (p,) = islice(prepared.iterates(replace(problem, initial_guess=moved)), 1)
    e = moved - p
    e[:2] = 0.0
    springs = require_only_springs(problem.system, "the test")
    A = e[springs.edges[:, 0]] - e[springs.edges[:, 1]]
    inertia = problem.system.mass / problem.system.time_step**2 @ np.sum(e**2, axis=1)
    expected = np.sqrt(inertia + springs.stiffness @ np.sum(A**2, axis=1))
    assert solution.residual == pytest.approx(expected, rel=HALF_THE_DIGITS)


@backends
def test_a_solve_that_diverged_reports_it_and_does_not_pass_for_converged(backend):
    problem = build_random_problem(0, weights=())
    lost = np.full_like(problem.initial_guess, np.nan)
    solution = backend.prepare(problem.system).solve(replace(problem, initial_guess=lost), StopRule(4, 1e-3))
    assert (solution.num_iterations, solution.termination_reason) == (4, "max-iter")
    assert np.isnan(solution.residual)


def hard(name: str) -> StepProblem:
    """The first step of a hard scene."""
    spec = load_scene(HARD / f"{name}.yaml")
    return build_first_problem(build_scene(spec, spec.default_size or 0))


methods = pytest.mark.parametrize(
    "method", [SparseLocalGlobal(), Lbfgs(), NewtonSolver()], ids=lambda method: type(method).__name__
)


@methods
@pytest.mark.parametrize(
    "case", ["effects-strain-limits-1e13", "effects-strain-limits-1e18", "scales-cubes-1e6-m-apart", "scales-far-chain"]
)
def test_a_stiff_or_far_part_does_not_pass_for_round_off_of_the_others(method, case: str):
    """Q weighs limits that no spring reaches, and the far part's coordinates are large; neither is the gradient's."""
    problem = hard(case)
    assert not is_gradient_roundoff(problem, problem.current_positions)
    solution = method.prepare(problem.system).solve(problem, StopRule(300, 1e-14))
    assert solution.termination_reason != "roundoff" or is_gradient_roundoff(problem, solution.positions)
    assert solution.num_iterations > 1


@pytest.mark.parametrize("case", ["effects-strain-limits-1e13", "effects-strain-limits-1e18"])
def test_a_chain_falls_whatever_the_limits_that_it_does_not_reach(case: str):
    """As far as it would without them."""
    problem = hard(case)
    solution = NewtonSolver().prepare(problem.system).solve(problem, StopRule(300, 1e-14))
    free = replace(problem, system=replace(problem.system, energies=problem.system.energies[:1]))
    expected = NewtonSolver().prepare(free.system).solve(free, StopRule(300, 1e-14)).positions
    fall = problem.value(solution.positions) - problem.value(problem.current_positions)
    assert fall == pytest.approx(problem.value(expected) - problem.value(problem.current_positions), rel=1e-9)


@pytest.mark.parametrize("method", [SparseLocalGlobal(), Lbfgs()], ids=lambda method: type(method).__name__)
@pytest.mark.parametrize("away", [0.0, 1e6], ids="{:g} m away".format)
def test_another_component_does_not_change_where_the_first_one_stops(method, away: float):
    problem = build_random_problem(1)
    both, n = join_problems(problem, shift_problem(build_random_problem(2), away)), problem.system.num_vertices
    ends = []
    for given in (problem, both):
        solution = method.prepare(given.system).solve(given, StopRule(20_000, 1e-300))
        assert solution.termination_reason in ("roundoff", "stalled")
        ends.append(solution.positions[:n])
    bound = ROUNDOFF_FACTOR * gradient_roundoff(problem, ends[0])
    for p in ends:
        assert (stable_row_norms(problem.gradient(p)) <= bound)[problem.system.unpinned_mask].all()


@pytest.mark.parametrize("away", [3.2e7, 1e6])
def test_a_tolerance_far_from_the_origin_ends_where_round_off_does(away: float):
    """Against the same motion at the origin: as near as steps without a tolerance come, and not at a bound of sums."""
    corners = PinsEffect.model_validate({"parts": ["corners"], "weight": "exact"})
    here = build_test_scene(NetMesh(), SpringsEffect(stretch=300.0), GravityEffect(), corners, size=8)
    shift = np.array([away, 0.0, 0.0])
    there = replace(
        here,
        mesh=replace(here.mesh, rest_positions=here.mesh.rest_positions + shift),
        pin_targets=here.pin_targets + shift,
    )

    def simulate_ends(bound: Scene, tolerance: float | None) -> NDArray[np.float64]:
        rule = StopRule(100, tolerance)
        run = simulate_scene(bound, prepare(bound, NewtonSolver()), rule, initial_guess="previous", frames=9)
        return np.array([step.positions for step in run])

    best = simulate_ends(here, 1e-12)
    with_tolerance, without = (np.abs(simulate_ends(there, t) - shift - best).max() for t in (1e-6, None))
    assert with_tolerance <= 2.0 * without + 1e-7  # which the tolerance itself leaves at the origin
