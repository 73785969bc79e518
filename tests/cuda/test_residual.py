"""Residuals of solves on a device are those of the reference evaluator."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from springbench.harness.reference.reference_evaluator import ReferenceEvaluator
from springbench.solvers.iteration import vertex_terms
from springbench.solvers.methods.newton.newton_cg import NewtonCG
from springbench.solvers.methods.vertex_block.vbd import VertexBlockDescent
from springbench.solvers.model.step_problem import StepProblem

from tests.cuda.test_touching import touching
from tests.effect_scenes import AIR_DRAG_EFFECT, BENDING_EFFECT, DASHPOT_EFFECT, build_moving_problem
from tests.effect_scenes import build_effect_cloth as cloth_with
from tests.scene_builders import SCENE_BUILDERS, build_cloth, build_first_problem, build_random_problem

PROBLEMS: dict[str, Callable[[], StepProblem]] = {
    "cloth, pinned exactly": lambda: build_first_problem(build_cloth(4, "exact")),
    "chain": lambda: build_first_problem(SCENE_BUILDERS["chain"]("exact")),
    "random, not pinned": lambda: build_random_problem(1, weights=()),
    "bending, dashpots and drag": lambda: build_moving_problem(
        cloth_with(BENDING_EFFECT, DASHPOT_EFFECT, AIR_DRAG_EFFECT)
    ),
    "random, pins by penalty": lambda: build_random_problem(0, weights=(1e4, np.inf, 1e2)),
    "a sheet on a sphere": lambda: touching("sphere"),
    "chain, stiff pins": lambda: build_first_problem(SCENE_BUILDERS["chain"](1e10)),
}
ROUND_OFF = 1e-6
"""Of the reference's factor, where pins are 1e10 times as stiff as what they are left out of; 1e-9 elsewhere."""

METHODS: dict[str, Callable[[], Any]] = {
    "vbd": lambda: VertexBlockDescent(device="cuda"),
    "newton-cg": lambda: NewtonCG(preconditioner="schwarz", device="cuda"),
}


@pytest.mark.parametrize("name", PROBLEMS)
@pytest.mark.parametrize("method", METHODS)
def test_the_residual_is_that_of_the_reference_evaluator(name: str, method: str) -> None:
    """At the guess, and at points near it."""
    problem = PROBLEMS[name]()
    if (method == "vbd" and "dashpots" in name) or (method != "vbd" and "sphere" in name):
        return
    prepared, oracle = METHODS[method]().prepare(problem.system), ReferenceEvaluator(problem.system)
    rng = np.random.default_rng(0)
    for p in (problem.initial_guess, problem.initial_guess + 0.01 * rng.normal(size=problem.inertial_target.shape)):
        p = vertex_terms.apply_exact_pins(p, problem)
        residual, begun = prepared.residual_at(problem, p), prepared.init_state(problem, p)
        assert residual == pytest.approx(oracle.compute_residual(problem, p), rel=ROUND_OFF)
        assert begun.residual() == pytest.approx(residual, rel=1e-9)
