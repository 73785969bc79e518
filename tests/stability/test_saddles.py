"""Saddles: steps that start at one end below it, at a minimum, and no step at a saddle passes for solved."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from itertools import islice, pairwise
from pathlib import Path

import numpy as np
import pytest
from springbench.harness.config.config_loader import load_scene
from springbench.harness.reference.hessian_curvature import compute_curvature
from springbench.harness.reference.step_verifier import StepVerifier
from springbench.harness.reference.step_verifier import is_minimum as minimum
from springbench.harness.report.robustness import TOLERANCE_SLACK
from springbench.harness.scenes.effects.pins_effect import PinsEffect as PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect as SpringsEffect
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.scenes.mesh.solid_meshes import TowerMesh
from springbench.harness.scenes.scene_builder import Scene, build_scene
from springbench.harness.simulation.time_loop import MotionState, build_problem, prepare, simulate_scene
from springbench.solvers.methods.newton.hybrid_newton import HybridNewton
from springbench.solvers.methods.newton.newton_cg import NewtonCG
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.methods.quasi_newton.lbfgs import Lbfgs
from springbench.solvers.methods.quasi_newton.nonlinear_cg import NonlinearCG
from springbench.solvers.methods.quasi_newton.windowed_acceleration import PreparedAccelerated
from springbench.solvers.methods.vertex_block.vbd import VertexBlockDescent
from springbench.solvers.model.integrators import INTEGRATORS, Motion
from springbench.solvers.model.step_problem import Positions, Solver, StepProblem, StopRule

from tests.scene_builders import build_test_scene

solvers = pytest.mark.parametrize("solver", [NewtonSolver(), HybridNewton()], ids=lambda s: type(s).__name__)

STOP = StopRule(300, 1e-6)


def squeeze_scene(mesh, size: int, pins: str, factors: tuple[float, float, float]) -> tuple[Scene, Positions]:
    """A scene whose time step leaves the springs to themselves, and its shape squeezed evenly about its mean."""
    made = build_test_scene(
        mesh,
        SpringsEffect(stretch=1e3),
        PinsEffect.model_validate({"parts": [pins], "weight": "exact"}),
        size=size,
        time_step=1.0,
    )
    c = made.mesh.rest_positions.mean(axis=0)
    return made, c + np.array(factors) * (made.mesh.rest_positions - c)


SADDLES = {
    "a chain pressed along its line": lambda: squeeze_scene(ChainMesh(), 9, "ends", (0.5, 1, 1)),
    "a sheet pressed evenly in its plane": lambda: squeeze_scene(GridMesh(), 5, "corners", (0.5, 1, 0.5)),
    "a tower pressed to half its height": lambda: squeeze_scene(TowerMesh(), 4, "base", (1, 0.5, 1)),
}
saddles = pytest.mark.parametrize("saddle", SADDLES)


@lru_cache
def at_a_saddle(saddle: str, integrator: str) -> tuple[Scene, StepProblem]:
    """A step that starts where the gradient vanishes and the Hessian is not positive definite: the forces are such."""
    made, p = SADDLES[saddle]()
    method = INTEGRATORS[integrator]
    made = replace(made, integrator=method, system=replace(made.system, inertia_factor=method.inertia_factor))
    made = replace(made, pin_targets=p[made.system.pins.vertices])
    still = Motion(p, np.zeros_like(p))
    stated = build_problem(made, MotionState(still, still, 1), "previous")
    return made, replace(stated, external_force=stated.external_force + stated.gradient(p))


def at_the_bottom(given: StepProblem, p: Positions, saddle: str) -> bool:
    """Whether p is a minimum; of a chain whose ends stay on its line also one of those that turn about it, a valley."""
    found = compute_curvature(given, p)
    return found.is_convex or (found.is_degenerate and saddle == "a chain pressed along its line")


@saddles
@pytest.mark.parametrize("integrator", INTEGRATORS)
@solvers
def test_a_step_that_starts_at_a_saddle_ends_at_a_minimum_below_it(solver: Solver, saddle: str, integrator: str):
    made, given = at_a_saddle(saddle, integrator)
    start = given.initial_guess
    judge = StepVerifier(made, None, is_minimiser=True)
    assert np.abs(given.gradient(start)).max() <= 1e-12 * made.system.inertia_diagonal.max()
    assert not minimum(given, start)
    solution = solver.prepare(given.system).solve(given, STOP)
    p = solution.positions
    assert at_the_bottom(given, p, saddle)
    assert solution.termination_reason != "max-iter"
    assert judge.measure_stationarity(given, p).above_roundoff == 0.0, (
        "the initial residual is round-off, and so is all that may be left"
    )
    assert given.value(p) < given.value(start) - 1e-6 * given.value_scale(start)


@saddles
@solvers
def test_a_saddle_is_left_in_the_same_direction_twice_and_downwards(solver: Solver, saddle: str):
    _, given = at_a_saddle(saddle, "implicit-euler")
    one, two = (
        [given.initial_guess, *(p.copy() for p in islice(solver.prepare(given.system).iterates(given), 60))]
        for _ in range(2)
    )
    np.testing.assert_array_equal(one, two)
    slack = 1e-12 * max(map(given.value_scale, one))  # round-off of sums of a thousand terms
    assert all(b <= a + slack for a, b in pairwise(map(given.value, one)))


GRADIENT_METHODS = (Lbfgs(), NonlinearCG(), NewtonCG(), VertexBlockDescent())
"""Methods that do not factorise the Hessian, one of each kind."""
STOP_AT_SADDLE = StopRule(1000, 1e-6, atol=1e-3)
"""At a saddle the residual to which a relative tolerance refers is round-off; that of a millimetre is hundreds of times
this one."""
gradient_methods = pytest.mark.parametrize("solver", GRADIENT_METHODS, ids=lambda s: type(s).__name__)


@saddles
@gradient_methods
def test_a_method_without_a_factor_leaves_a_saddle_for_a_minimum(solver: Solver, saddle: str):
    _, given = at_a_saddle(saddle, "implicit-euler")
    start, solution = given.initial_guess, solver.prepare(given.system).solve(given, STOP_AT_SADDLE)
    assert solution.termination_reason in ("converged", "roundoff")
    assert at_the_bottom(given, solution.positions, saddle)
    assert given.value(solution.positions) < given.value(start) - 1e-6 * given.value_scale(start)


@saddles
def test_a_solve_that_may_not_leave_a_saddle_reports_it(saddle: str, monkeypatch):
    _, given = at_a_saddle(saddle, "implicit-euler")
    prepared = Lbfgs().prepare(given.system)
    no_iteration = prepared.solve(given, replace(STOP_AT_SADDLE, max_iterations=1))
    monkeypatch.setattr(PreparedAccelerated, "can_leave_saddles", False)
    no_way = prepared.solve(given, STOP_AT_SADDLE)
    for solution in (no_iteration, no_way):
        assert solution.termination_reason == "saddle"
        np.testing.assert_allclose(solution.positions, given.initial_guess, rtol=0.0, atol=1e-9)  # round-off moves it


def test_only_a_close_tolerance_requires_a_minimum():
    """Far from stationary points the Hessian shows nothing."""
    _, given = at_a_saddle("a chain pressed along its line", "implicit-euler")
    guess = given.initial_guess.copy()
    guess[given.system.free_vertices, 0] += 1e-3 * np.cos(
        np.arange(len(given.system.free_vertices))
    )  # remains in the saddle's plane
    given, prepared = replace(given, current_positions=guess, initial_guess=guess), NewtonSolver().prepare(given.system)
    coarse, close = (prepared.solve(given, StopRule(300, tolerance)) for tolerance in (1e-2, 1e-6))
    assert coarse.termination_reason == "converged"
    assert at_the_bottom(given, close.positions, "a chain pressed along its line")
    assert coarse.num_iterations < close.num_iterations


CONFIGS = Path(__file__).resolve().parents[2] / "configs" / "hard"
CASES = {path.stem: path for path in sorted(CONFIGS.glob("*.yaml"))}
SADDLE_CASES = [case for case in CASES if case.startswith("saddle")] + [
    "contact-pressed-sphere",
    "motion-burst",
    "motion-pushed-together",
    "numbers-mostly-massless",
]
"""Where a residual alone would end some step at no minimum."""
VALLEY = {"numbers-stiffness-number-1e12", "numbers-stiffness-number-1e8"}
"""Where thousands of iterations follow a curved valley, in steps as short as it is narrow."""
DEGENERATE = {"numbers-massless-vertices", "saddle-pressed-chain", "saddle-standing-chain"}
"""Where steps may end at no certified minimum. A vertex without mass at the end of a chain turns freely about its
neighbour, and a chain that stands on a point, or is pressed along its line, buckles to any side: their minima are a
sphere and circles, along which the curvature is zero, and round-off gives it a sign."""


OUT_OF_REACH = {"effects-strain-limits-1e18", "scales-cubes-1e9-m-apart", "scales-links-1e12"}
"""Where Newton's method does not reach the tolerance, and must not claim to."""


def ends(case: str, solver: Solver, frames: int, *, is_claimed_only: bool = False) -> list[str]:
    """The steps of a hard scene that end at no certified minimum; all, or those that claim convergence."""
    spec = load_scene(CASES[case])
    made = build_scene(spec, spec.default_size or 0)
    judge, wrong = StepVerifier(made, None, is_minimiser=True), []
    stop = StopRule(20_000, 1e-6) if case in VALLEY else STOP
    for step in simulate_scene(made, prepare(made, solver), stop, initial_guess="previous", frames=frames):
        assert np.isfinite(step.positions).all()
        found = judge(step)
        if is_claimed_only and step.solution.termination_reason != "converged":
            continue
        if not (found["is_local_minimum"] and found["stationarity_above_roundoff"] <= TOLERANCE_SLACK * 1e-6):
            wrong.append(
                f"step {step.index}: {found}, {step.solution.termination_reason} after {step.solution.num_iterations}"
            )
    return wrong


@pytest.mark.parametrize("case", SADDLE_CASES)
@solvers
def test_a_step_that_a_residual_would_end_too_early_ends_at_a_certified_minimum(case: str, solver: Solver):
    wrong = ends(case, solver, 3)
    assert not wrong or case in DEGENERATE, wrong


@pytest.mark.long
@pytest.mark.parametrize("case", CASES)
@solvers
def test_all_steps_of_a_hard_scene_end_at_certified_minima(case: str, solver: Solver):
    is_out_of_reach = isinstance(solver, NewtonSolver) and case in OUT_OF_REACH
    wrong = ends(case, solver, 10, is_claimed_only=is_out_of_reach)
    assert not wrong or case in DEGENERATE, wrong


@pytest.mark.slow
@pytest.mark.parametrize("case", SADDLE_CASES)
def test_no_step_of_lbfgs_passes_for_solved_at_a_saddle(case: str):
    spec = load_scene(CASES[case])
    made = build_scene(spec, spec.default_size or 0)
    for step in simulate_scene(made, prepare(made, Lbfgs()), STOP, initial_guess="previous", frames=3):
        solved = step.solution.termination_reason in ("converged", "roundoff")
        assert not (solved and compute_curvature(step.problem, step.solution.positions).is_saddle), step.index
