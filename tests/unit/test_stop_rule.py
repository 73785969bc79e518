"""When a solve ends, and what it reports."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from harness.config.load import load_scene
from harness.scenes.bind import Scene, build
from harness.scenes.effects.gravity import Gravity
from harness.scenes.effects.pins import Pins as PinsEffect
from harness.scenes.effects.springs import Springs as SpringsEffect
from harness.scenes.mesh.grid import Net
from harness.simulation.step import prepare, simulate
from harness.simulation.trace import EnergyNorm, trace
from solvers.core.prefactored import only_springs
from solvers.methods.lbfgs import Lbfgs
from solvers.methods.local_global import SparseLocalGlobal
from solvers.methods.newton import Newton
from solvers.problem import StepProblem, StopRule
from solvers.round_off import FACTOR, at_rest, gradient_round_off, lengths
from tests.scenes import BACKENDS, beside, cloth, first_problem, moved, random_problem, scene

HARD = Path(__file__).resolve().parents[2] / "configs" / "hard"

HALF_THE_DIGITS = 1e-7
"""A residual is the root of a sum that cancels, added up in another order by each backend."""

backends = pytest.mark.parametrize("backend", BACKENDS, ids=lambda b: type(b).__name__)


def without_motion(problem: StepProblem) -> StepProblem:
    """The same system with nothing that moves it."""
    p = problem.current
    return replace(problem, target=p, force=np.zeros_like(p), first_guess=p)


@backends
def test_without_a_tolerance_all_iterations_are_done(backend):
    problem = without_motion(first_problem(cloth(6)))
    solution = backend.prepare(problem.system).solve(problem, StopRule(17))
    assert (solution.iterations, solution.stopped) == (17, "iterations")
    assert np.isnan(solution.yardstick)
    assert np.isfinite(solution.residual)


@backends
def test_a_tolerance_ends_a_solve_at_the_first_residual_below_it(backend):
    problem = first_problem(cloth(8))
    prepared = backend.prepare(problem.system)
    curve = trace(prepared, problem, EnergyNorm(problem.system), 100).residuals
    solution = prepared.solve(problem, StopRule(100, 0.05))
    below = [k for k, residual in enumerate(curve, 1) if residual <= 0.05 * curve[0]]
    assert (solution.iterations, solution.stopped) == (below[0], "tolerance")
    assert solution.yardstick == pytest.approx(curve[0], rel=HALF_THE_DIGITS)  # the guess is the current positions
    assert solution.residual == pytest.approx(curve[below[0] - 1], rel=HALF_THE_DIGITS)
    assert solution.residual <= 0.05 * solution.yardstick


@backends
def test_the_limit_ends_a_solve_that_the_tolerance_does_not(backend):
    problem = first_problem(cloth(8))
    solution = backend.prepare(problem.system).solve(problem, StopRule(5, 1e-12))
    assert (solution.iterations, solution.stopped) == (5, "iterations")
    assert solution.residual > 1e-12 * solution.yardstick


@backends
@pytest.mark.parametrize("offset", [0.0, 1e3], ids="{:g} m from the origin".format)
def test_a_scene_at_rest_stops_after_one_iteration(backend, offset):
    """Its residual is round-off, of which no fraction would ever be reached; the floor knows its size."""
    problem = without_motion(first_problem(cloth(12)))
    away = {name: getattr(problem, name) + offset for name in ("target", "pin_targets", "current", "first_guess")}
    solution = backend.prepare(problem.system).solve(replace(problem, **away), StopRule(50, 1e-6))
    assert solution.iterations == 1
    assert solution.stopped in ("floor", "tolerance")  # "tolerance" where the residual is exactly zero


@backends
def test_the_floor_does_not_stop_a_scene_that_moves(backend):
    """Free fall from rest, the slowest start there is."""
    problem = first_problem(cloth(12))
    solution = backend.prepare(problem.system).solve(problem, StopRule(50, 1e-6))
    assert solution.stopped != "floor"
    assert solution.iterations > 1


@backends
def test_the_floor_can_be_taken_away(backend):
    problem = without_motion(first_problem(cloth(12)))
    solution = backend.prepare(problem.system).solve(problem, StopRule(3, 1e-9, floor=0.0))
    assert solution.stopped != "floor"


@backends
def test_the_yardstick_is_taken_at_the_current_positions_whatever_the_first_guess(backend):
    """A guess nearer to the solution makes a solve shorter, never stricter."""
    made = replace(cloth(8), velocity=(1.0, 0.0, 0.0))
    current, inertial = (first_problem(made, guess) for guess in ("current", "inertial"))
    prepared = backend.prepare(made.system)
    found = [prepared.solve(problem, StopRule(100, 0.05)) for problem in (current, inertial)]
    first = next(iter(prepared.iterates(current)))
    residual = EnergyNorm(made.system)(first - current.current)
    for solution in found:
        assert solution.yardstick == pytest.approx(residual, rel=HALF_THE_DIGITS)
    assert found[0].iterations != found[1].iterations  # the guesses do differ


@backends
def test_the_residual_leaves_pinned_vertices_out(backend):
    """The assignment's guess leaves pins off their targets; with a weight of 1e10 that would be all one sees."""
    problem = random_problem(0, weights=(1e10, 1e10))
    prepared = backend.prepare(problem.system)
    moved = problem.first_guess.copy()
    moved[:2] += 1e-3
    solution = prepared.solve(replace(problem, first_guess=moved), StopRule(1))
    (p,) = islice(prepared.iterates(replace(problem, first_guess=moved)), 1)
    e = moved - p
    e[:2] = 0.0
    springs = only_springs(problem.system, "the test")
    A = e[springs.edges[:, 0]] - e[springs.edges[:, 1]]
    inertia = problem.system.mass / problem.system.time_step**2 @ np.sum(e**2, axis=1)
    wanted = np.sqrt(inertia + springs.stiffness @ np.sum(A**2, axis=1))
    assert solution.residual == pytest.approx(wanted, rel=HALF_THE_DIGITS)


@backends
def test_a_solve_that_diverged_says_so_and_does_not_pass_for_converged(backend):
    problem = random_problem(0, weights=())
    lost = np.full_like(problem.first_guess, np.nan)
    solution = backend.prepare(problem.system).solve(replace(problem, first_guess=lost), StopRule(4, 1e-3))
    assert (solution.iterations, solution.stopped) == (4, "iterations")
    assert np.isnan(solution.residual)


def hard(name: str) -> StepProblem:
    """The first step of a hard scene."""
    spec = load_scene(HARD / f"{name}.yaml")
    return first_problem(build(spec, spec.default_size or 0))


methods = pytest.mark.parametrize(
    "method", [SparseLocalGlobal(), Lbfgs(), Newton()], ids=lambda method: type(method).__name__
)


@methods
@pytest.mark.parametrize(
    "case", ["effects-strain-limits-1e13", "effects-strain-limits-1e18", "scales-cubes-1e6-m-apart", "scales-far-chain"]
)
def test_a_stiff_or_far_part_does_not_pass_for_round_off_of_the_others(method, case: str):
    """Q weighs limits that no spring reaches, and the far part's coordinates are large; neither is the gradient's."""
    problem = hard(case)
    assert not at_rest(problem, problem.current)
    solution = method.prepare(problem.system).solve(problem, StopRule(300, 1e-14))
    assert solution.stopped != "floor" or at_rest(problem, solution.positions)
    assert solution.iterations > 1


@pytest.mark.parametrize("case", ["effects-strain-limits-1e13", "effects-strain-limits-1e18"])
def test_a_chain_falls_whatever_the_limits_that_it_does_not_reach(case: str):
    """As far as it would without them."""
    problem = hard(case)
    solution = Newton().prepare(problem.system).solve(problem, StopRule(300, 1e-14))
    free = replace(problem, system=replace(problem.system, energies=problem.system.energies[:1]))
    wanted = Newton().prepare(free.system).solve(free, StopRule(300, 1e-14)).positions
    fall = problem.value(solution.positions) - problem.value(problem.current)
    assert fall == pytest.approx(problem.value(wanted) - problem.value(problem.current), rel=1e-9)


@pytest.mark.parametrize("method", [SparseLocalGlobal(), Lbfgs()], ids=lambda method: type(method).__name__)
@pytest.mark.parametrize("away", [0.0, 1e6], ids="{:g} m away".format)
def test_another_component_does_not_change_where_the_first_one_stops(method, away: float):
    problem = random_problem(1)
    both, n = beside(problem, moved(random_problem(2), away)), problem.system.vertices
    ends = []
    for given in (problem, both):
        solution = method.prepare(given.system).solve(given, StopRule(20_000, 1e-300))
        assert solution.stopped in ("floor", "stalled")
        ends.append(solution.positions[:n])
    bound = FACTOR * gradient_round_off(problem, ends[0])
    for p in ends:
        assert (lengths(problem.gradient(p)) <= bound)[problem.system.unpinned].all()


@pytest.mark.parametrize("away", [3.2e7, 1e6])
def test_a_tolerance_far_from_the_origin_ends_where_round_off_does(away: float):
    """Beside the same motion at the origin: as near as steps without a tolerance come, and not at a bound of sums."""
    corners = PinsEffect.model_validate({"at": ["corners"], "weight": "exact"})
    here = scene(Net(), SpringsEffect(stretch=300.0), Gravity(), corners, size=8)
    shift = np.array([away, 0.0, 0.0])
    there = replace(here, mesh=replace(here.mesh, rest=here.mesh.rest + shift), pin_targets=here.pin_targets + shift)

    def ended(bound: Scene, tolerance: float | None) -> NDArray[np.float64]:
        rule = StopRule(100, tolerance)
        run = simulate(bound, prepare(bound, Newton()), rule, first_guess="current", frames=9)
        return np.array([step.positions for step in run])

    best = ended(here, 1e-12)
    with_tolerance, without = (np.abs(ended(there, t) - shift - best).max() for t in (1e-6, None))
    assert with_tolerance <= 2.0 * without + 1e-7  # which the tolerance itself leaves at the origin
