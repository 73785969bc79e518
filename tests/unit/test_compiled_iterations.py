"""Compiled iterations of A-Jacobi, nonlinear conjugate gradients and Newton's methods, and their interpreted loops.

The steps of Newton's methods in `hybrid`, too.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from springbench.solvers.kernels.iteration_loop import RESIDUAL_NEVER, LoopLimits
from springbench.solvers.methods.local_global.aggregated_jacobi import AggregatedJacobi
from springbench.solvers.methods.newton.hybrid_newton import HybridNewton, PreparedHybrid
from springbench.solvers.methods.newton.newton_cg import NewtonCG
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.methods.newton.newton_kernel import NEWTON_PROGRESS_DTYPE
from springbench.solvers.methods.quasi_newton.nonlinear_cg import NonlinearCG
from springbench.solvers.model.step_problem import StepProblem, StopRule
from springbench.solvers.objective.step_objective import StepObjective

from tests.effect_scenes import EFFECT_SCENES, build_moving_problem
from tests.scene_builders import build_cloth, build_first_problem

HANGING = build_first_problem(build_cloth(8, "exact", stretch=100.0))


def lighten(problem: StepProblem, fraction: float = 1e-5) -> StepProblem:
    """A step of a scene with a fraction of the mass and of the forces, so that its springs are stiff."""
    system = replace(problem.system, mass=fraction * problem.system.mass)
    return replace(problem, system=system, external_force=fraction * problem.external_force)


def squeeze(problem: StepProblem) -> StepProblem:
    """A step that begins with the edges moved together by a tenth: its Hessian is indefinite."""
    squeezed = problem.current_positions * [0.9, 1.0, 1.0]
    return replace(problem, initial_guess=squeezed, inertial_target=squeezed)


STIFF_STEPS = {
    "exact pins": lighten(HANGING),
    "penalty pins": lighten(build_first_problem(build_cloth(8, stretch=100.0))),
    "squeezed": squeeze(lighten(HANGING)),
    "bending": lighten(build_moving_problem(EFFECT_SCENES["bending"]()), 1e-6),
    "attachments": lighten(build_moving_problem(EFFECT_SCENES["attachments"]())),
}


@pytest.mark.parametrize(
    ("method", "compiled_part"),
    [(AggregatedJacobi(), "_engine"), (NonlinearCG(), "compiled_method")],
    ids=["a-jacobi", "pncg"],
)
@pytest.mark.parametrize("scene", ["bending", "attachments", "moved exact pins"])
def test_compiled_iterations_are_the_interpreted_ones(method, compiled_part, scene):
    if scene == "moved exact pins":
        problem = replace(HANGING, pin_targets=HANGING.pin_targets + 0.1)
    else:
        problem = build_moving_problem(EFFECT_SCENES[scene]())
    compiled, interpreted = method.prepare(problem.system), method.prepare(problem.system)
    assert getattr(compiled, compiled_part) is not None
    vars(interpreted)[compiled_part] = None
    for stop in (StopRule(10), StopRule(50, 1e-3)):
        found, expected = compiled.solve(problem, stop), interpreted.solve(problem, stop)
        assert found.num_iterations == expected.num_iterations
        np.testing.assert_allclose(found.positions, expected.positions, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("scene", STIFF_STEPS)
def test_compiled_newton_steps_of_the_hybrid_are_the_interpreted_ones(scene):
    problem, stop = STIFF_STEPS[scene], StopRule(300, 1e-8)
    compiled, interpreted = (HybridNewton().prepare(problem.system) for _ in range(2))
    assert isinstance(compiled, PreparedHybrid)
    assert isinstance(interpreted, PreparedHybrid)
    assert compiled.method.compiled_newton is not None
    vars(interpreted.method)["_compiled_newton"] = None
    found, expected = compiled.solve(problem, stop), interpreted.solve(problem, stop)
    phases, expected_phases = found.solver_phases, expected.solver_phases
    assert phases is not None
    assert expected_phases is not None
    assert phases.keys() - {"lbfgs"}
    counts, expected_counts = ({name: phase[0] for name, phase in some.items()} for some in (phases, expected_phases))
    assert counts == expected_counts
    for name, phase in phases.items():
        assert phase[1] == pytest.approx(expected_phases[name][1], rel=1e-12)  # counted from other intermediate sums
    assert found.num_iterations == expected.num_iterations
    assert found.termination_reason == expected.termination_reason
    assert found.residual == pytest.approx(expected.residual, rel=1e-12)
    np.testing.assert_array_equal(found.positions, expected.positions)


@pytest.mark.parametrize(
    "method", [AggregatedJacobi(), NonlinearCG(), NewtonSolver(), NewtonCG()], ids=lambda one: type(one).__name__
)
def test_solves_at_the_same_time_have_separate_work_arrays(method):
    prepared = method.prepare(HANGING.system)
    alone = [p.copy() for p in islice(prepared.iterates(HANGING), 4)]
    one, other = prepared.iterates(HANGING), prepared.iterates(HANGING)
    for expected in alone:
        np.testing.assert_array_equal(next(one), expected)
        np.testing.assert_array_equal(next(other), expected)
        prepared.solve(HANGING, StopRule(3))


@pytest.mark.parametrize(("max_ratio", "num_steps"), [(0.0, 1), (np.inf, 2)])
def test_measured_steps_end_where_they_converge_too_slowly(max_ratio, num_steps):
    problem = STIFF_STEPS["exact pins"]
    prepared = HybridNewton().prepare(problem.system)
    assert isinstance(prepared, PreparedHybrid)
    compiled, step = prepared.method.compiled_newton, StepObjective(prepared.fixed_objective, problem)
    assert compiled is not None
    p = NewtonSolver().prepare(problem.system).solve(problem, StopRule(300, 1e-2)).positions
    p, gradient, decreases, progress = p.copy(), step.gradient(p), np.empty(8), np.zeros(1, NEWTON_PROGRESS_DTYPE)
    fixed, limits = (compiled.arrays, step.step_data, step.exact_pins), LoopLimits(2, 0.0, 0.0, RESIDUAL_NEVER)
    count, _, _ = compiled.run_measured_steps.kernel(*fixed, limits, max_ratio, p, gradient, decreases, progress)
    assert count == num_steps
    assert progress["agrees_with_model"] == 1
    assert 0.0 < progress["decrement_ratio"] < 0.1
    np.testing.assert_array_equal(gradient, step.gradient(p))
