"""L-BFGS on a device, with A-Jacobi's matrix in the place of Q^-1: the processor's iterates, in both precisions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np
import pytest

from solvers.cuda.run import DeviceIterative
from solvers.methods.lbfgs import Lbfgs
from solvers.problem import Prepared, StepProblem, StopRule, Unsupported
from tests.cuda.near import same_iterates
from tests.effects import BEND, DASHPOTS, DRAG, LIMITS, stepped
from tests.effects import SCENES as EFFECTS
from tests.effects import cloth as cloth_with
from tests.scenes import SCENES, cloth, first_problem, random_problem


def jacobi(**given: Any) -> Lbfgs:
    return Lbfgs(preconditioner="a-jacobi", **given)


def on_device(problem: StepProblem, **given: Any) -> DeviceIterative:
    prepared: Prepared = jacobi(device="cuda", **given).prepare(problem.system)
    assert isinstance(prepared, DeviceIterative)
    return prepared


PROBLEMS: dict[str, Callable[[], StepProblem]] = {
    "chain": lambda: first_problem(SCENES["chain"]("exact")),
    "cloth": lambda: first_problem(cloth(4, 1e10)),
    "bending, dashpots and drag": lambda: stepped(cloth_with(BEND, DASHPOTS, DRAG)),
    "random": lambda: random_problem(0, weights=(1e4, np.inf, 1e2)),
}


@pytest.mark.parametrize("make", PROBLEMS.values(), ids=list(PROBLEMS))
def test_iterates_are_those_of_the_processor(make: Callable[[], StepProblem]) -> None:
    same_iterates(jacobi, make(), 4)


def test_a_full_window_of_other_sweeps_has_the_iterates_of_the_processor() -> None:
    same_iterates(lambda **on: jacobi(pairs=2, sweeps=3, **on), first_problem(cloth(3, "exact")), 6)


def test_it_ends_where_the_processor_does() -> None:
    """Vectors in float32, and a minimum in float64."""
    problem, rule = first_problem(cloth(3, "exact")), StopRule(200, 1e-7)
    there, here = (made.solve(problem, rule) for made in (on_device(problem, precision="float32"), _here(problem)))
    assert (there.stopped, here.stopped) == ("tolerance", "tolerance")
    assert there.iterations <= 1.3 * here.iterations + 8  # a residual is asked for after each eighth
    np.testing.assert_allclose(there.positions, here.positions, rtol=0, atol=1e-6)


def _here(problem: StepProblem) -> Prepared:
    return jacobi().prepare(problem.system)


def test_a_step_that_would_rise_is_shortened_as_on_the_processor() -> None:
    """From where springs are turned inside out no step is taken at full length."""
    problem = first_problem(SCENES["chain"]("exact"))
    same_iterates(jacobi, replace(problem, first_guess=-3.0 * problem.first_guess), 4)


def test_bits_do_not_depend_on_who_looks() -> None:
    problem = first_problem(cloth(3, 1e10))
    prepared = on_device(problem, precision="float32")
    looked_at = [p.copy() for p in islice(prepared.iterates(problem), 5)][-1]
    np.testing.assert_array_equal(prepared.replay(problem, 5)[0].positions, looked_at)
    np.testing.assert_array_equal(prepared.solve(problem, StopRule(5)).positions, looked_at)


@pytest.mark.parametrize(
    ("make", "solver", "named"),
    [
        (lambda: cloth_with(LIMITS), jacobi(device="cuda"), "device: cuda: .*StrainLimits"),
        (EFFECTS["contact"], jacobi(device="cuda"), "no rows for what begins to touch"),
        (lambda: cloth(3, 1e4), Lbfgs(device="cuda"), "knows preconditioner: a-jacobi .*not factor by auto in float64"),
        (lambda: cloth(3, 1e4), jacobi(device="cuda", precision="float16"), "not a-jacobi by auto in float16"),
    ],
    ids=["strain limits", "contact", "factor", "float16"],
)
def test_what_it_does_not_know_it_refuses_by_name(make: Callable[[], Any], solver: Lbfgs, named: str) -> None:
    with pytest.raises(Unsupported, match=named):
        solver.prepare(make().system)
