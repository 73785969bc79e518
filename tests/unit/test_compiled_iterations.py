"""Compiled iterations of A-Jacobi, nonlinear conjugate gradients and Newton's methods, and their interpreted loops."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from springbench.solvers.methods.local_global.aggregated_jacobi import AggregatedJacobi
from springbench.solvers.methods.newton.newton_cg import NewtonCG
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.methods.quasi_newton.nonlinear_cg import NonlinearCG
from springbench.solvers.model.step_problem import StopRule

from tests.effect_scenes import EFFECT_SCENES, build_moving_problem
from tests.scene_builders import build_cloth, build_first_problem

HANGING = build_first_problem(build_cloth(8, "exact", stretch=100.0))


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
        found, wanted = compiled.solve(problem, stop), interpreted.solve(problem, stop)
        assert found.num_iterations == wanted.num_iterations
        np.testing.assert_allclose(found.positions, wanted.positions, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    "method", [AggregatedJacobi(), NonlinearCG(), NewtonSolver(), NewtonCG()], ids=lambda one: type(one).__name__
)
def test_solves_at_the_same_time_have_separate_work_arrays(method):
    prepared = method.prepare(HANGING.system)
    alone = [p.copy() for p in islice(prepared.iterates(HANGING), 4)]
    one, other = prepared.iterates(HANGING), prepared.iterates(HANGING)
    for wanted in alone:
        np.testing.assert_array_equal(next(one), wanted)
        np.testing.assert_array_equal(next(other), wanted)
        prepared.solve(HANGING, StopRule(3))
