"""Newton's method by conjugate gradients on a device: the processor's iterates, in both precisions."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest

from solvers.core.preconditioning import Preconditioning
from solvers.cuda import sums
from solvers.cuda.device import simulated
from solvers.cuda.target import cuda
from solvers.linear import schwarz
from solvers.methods.newton_cg import NewtonCG
from solvers.problem import StepProblem, StopRule, Unsupported
from tests.cuda.near import same_iterates
from tests.effects import BEND, DASHPOTS, DRAG, LIMITS, stepped
from tests.effects import SCENES as EFFECTS
from tests.effects import cloth as cloth_with
from tests.scenes import SCENES, cloth, first_problem, random_problem

schwarz_cg = partial(NewtonCG, preconditioner="schwarz")

PROBLEMS: dict[str, Callable[[], StepProblem]] = {
    "chain": lambda: first_problem(SCENES["chain"](1e10)),
    "cloth": lambda: first_problem(cloth(4, "exact")),
    "bending, dashpots and drag": lambda: stepped(cloth_with(BEND, DASHPOTS, DRAG)),
    "random": lambda: random_problem(0, weights=(1e4, np.inf, 1e2)),
}


@pytest.mark.parametrize("make", PROBLEMS.values(), ids=list(PROBLEMS))
def test_iterates_are_those_of_the_processor(make: Callable[[], StepProblem]) -> None:
    same_iterates(schwarz_cg, make(), 3)


@pytest.mark.parametrize(
    ("name", "make"), [(n, m) for n, m in PROBLEMS.items() if n != "chain"], ids=list(PROBLEMS)[1:]
)
def test_iterates_on_several_levels_are_those_of_the_processor(
    name: str, make: Callable[[], StepProblem], monkeypatch: pytest.MonkeyPatch
) -> None:
    """In patches of three, so that small scenes have three levels, and a last patch that is not full."""
    monkeypatch.setattr(schwarz, "PATCH", 3)
    same_iterates(schwarz_cg, make(), 2)


def test_it_ends_where_the_processor_does() -> None:
    """Kernels in float32, and a minimum in float64."""
    problem, rule = first_problem(cloth(3, "exact")), StopRule(200, 1e-8)
    there = schwarz_cg(device="cuda").prepare(problem.system).solve(problem, rule)
    here = schwarz_cg().prepare(problem.system).solve(problem, rule)
    assert there.stopped == "tolerance"
    np.testing.assert_allclose(there.positions, here.positions, rtol=0, atol=1e-7)


@pytest.mark.parametrize(
    ("make", "preconditioner", "named"),
    [
        (lambda: stepped(cloth_with(LIMITS)), "schwarz", "StrainLimits"),
        (lambda: stepped(EFFECTS["contact"]()), "schwarz", "ContactEnergy|Contact"),
        (lambda: stepped(EFFECTS["gas"]()), "schwarz", "Gas"),
        (lambda: first_problem(cloth(3, "exact")), "factor", "knows preconditioner: schwarz, not factor"),
        (lambda: first_problem(cloth(3, "exact")), "block-jacobi", "knows preconditioner: schwarz, not block-jacobi"),
    ],
    ids=["strain limits", "contact", "gas", "factor", "block-jacobi"],
)
def test_what_it_does_not_know_it_refuses_by_name(
    make: Callable[[], StepProblem], preconditioner: Preconditioning, named: str
) -> None:
    with pytest.raises(Unsupported, match=f"device: cuda: .*({named})"):
        NewtonCG(preconditioner=preconditioner, device="cuda").prepare(make().system)


def test_sums_of_blocks_are_added_by_a_tree(monkeypatch: pytest.MonkeyPatch) -> None:
    if simulated():
        monkeypatch.setattr(sums, "THREADS", 8)
    count = 3 * sums.THREADS + 1
    terms = np.random.default_rng(0).normal(size=(2, count))
    given, out = cuda.to_device(terms), cuda.to_device(np.zeros(2))
    for _ in range(2):  # whoever of the threads goes first
        sums.collect[1, sums.THREADS](2, given, count, out)
        np.testing.assert_allclose(out.copy_to_host(), terms.sum(axis=1), rtol=1e-12)
