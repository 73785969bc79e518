"""Residuals of what is solved on a device: the oracle's."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from harness.reference.oracle import Oracle
from solvers.core import vertex_terms
from solvers.methods.newton_cg import NewtonCG
from solvers.methods.vbd import VertexBlockDescent
from solvers.problem import StepProblem
from tests.cuda.test_touching import touching
from tests.effects import BEND, DASHPOTS, DRAG, stepped
from tests.effects import cloth as cloth_with
from tests.scenes import SCENES, cloth, first_problem, random_problem

PROBLEMS: dict[str, Callable[[], StepProblem]] = {
    "cloth, pinned exactly": lambda: first_problem(cloth(4, "exact")),
    "chain": lambda: first_problem(SCENES["chain"]("exact")),
    "random, not pinned": lambda: random_problem(1, weights=()),
    "bending, dashpots and drag": lambda: stepped(cloth_with(BEND, DASHPOTS, DRAG)),
    "random, pins by penalty": lambda: random_problem(0, weights=(1e4, np.inf, 1e2)),
    "a sheet on a sphere": lambda: touching("sphere"),
    "chain, stiff pins": lambda: first_problem(SCENES["chain"](1e10)),
}
ROUND_OFF = 1e-6
"""Of the oracle's factor, where pins are 1e10 times as stiff as what they are left out of; 1e-9 elsewhere."""

METHODS: dict[str, Callable[[], Any]] = {
    "vbd": lambda: VertexBlockDescent(device="cuda"),
    "newton-cg": lambda: NewtonCG(preconditioner="schwarz", device="cuda"),
}


@pytest.mark.parametrize("name", PROBLEMS)
@pytest.mark.parametrize("method", METHODS)
def test_it_is_the_oracles(name: str, method: str) -> None:
    """At the guess, and at points beside it."""
    problem = PROBLEMS[name]()
    if (method == "vbd" and "dashpots" in name) or (method != "vbd" and "sphere" in name):
        return
    prepared, oracle = METHODS[method]().prepare(problem.system), Oracle(problem.system)
    rng = np.random.default_rng(0)
    for p in (problem.first_guess, problem.first_guess + 0.01 * rng.normal(size=problem.target.shape)):
        p = vertex_terms.placed(p, problem)
        told, begun = prepared.residual_at(problem, p), prepared.begin(problem, p)
        assert told == pytest.approx(oracle.residual(problem, p), rel=ROUND_OFF)
        assert begun.residual() == pytest.approx(told, rel=1e-9)
