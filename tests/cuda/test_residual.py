"""Residuals on a device, without a factor: the oracle's, and never less."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from harness.reference.oracle import Oracle
from solvers.core import vertex_terms
from solvers.cuda import residual
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
    "newton-cg": lambda: NewtonCG(preconditioner="block-jacobi", device="cuda"),
}


@pytest.mark.parametrize("name", PROBLEMS)
@pytest.mark.parametrize("method", METHODS)
def test_it_is_the_oracles_and_no_less(name: str, method: str) -> None:
    """At the guess, and at points beside it."""
    problem = PROBLEMS[name]()
    if (method == "vbd" and "dashpots" in name) or (method != "vbd" and "sphere" in name):
        return
    prepared, oracle = METHODS[method]().prepare(problem.system), Oracle(problem.system)
    rng = np.random.default_rng(0)
    for p in (problem.first_guess, problem.first_guess + 0.01 * rng.normal(size=problem.target.shape)):
        p = vertex_terms.placed(p, problem)
        told, truth = prepared.residual_at(problem, p), oracle.residual(problem, p)
        assert (1.0 - ROUND_OFF) * truth <= told <= (1.0 + residual.ACCURACY + ROUND_OFF) * truth


@pytest.mark.parametrize("weight", ["exact", 1e10], ids=["pinned exactly", "by penalty"])
def test_at_a_minimum_it_is_nothing_and_of_nan_it_is_nan(weight: float | str) -> None:
    problem = first_problem(cloth(3, weight))
    prepared = METHODS["newton-cg"]().prepare(problem.system)
    begun = prepared.begin(problem, problem.first_guess)
    assert begun.residual() > 0.0
    begun.stream.put(np.zeros(begun.g.shape), begun.g)
    assert begun.residual() == 0.0
    begun.stream.put(np.full(begun.g.shape, np.nan), begun.g)
    assert np.isnan(begun.residual())


def test_ended_early_it_is_no_less_than_the_truth(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(residual, "MOST", 1)
    monkeypatch.setattr(residual, "TOGETHER", 1)
    problem = first_problem(cloth(4, "exact"))
    told = METHODS["newton-cg"]().prepare(problem.system).residual_at(problem, problem.current)
    truth = Oracle(problem.system).residual(problem, problem.current)
    assert (1.0 + residual.ACCURACY) * truth < told < np.inf


def test_a_vertex_without_mass_leaves_no_bound_and_the_truth() -> None:
    problem = first_problem(cloth(3, "exact"))
    mass = problem.system.mass.copy()
    mass[4] = 0.0  # in the middle
    problem = replace(problem, system=replace(problem.system, mass=mass))
    told = METHODS["newton-cg"]().prepare(problem.system).residual_at(problem, problem.current)
    assert told == pytest.approx(Oracle(problem.system).residual(problem, problem.current), rel=1e-9)
