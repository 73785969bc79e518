"""Newton's method by conjugate gradients on a device: the processor's iterates, in both precisions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from springbench.solvers.cuda import device_sums
from springbench.solvers.cuda.cuda_device import is_simulated
from springbench.solvers.cuda.cuda_target import cuda
from springbench.solvers.iteration.preconditioners import PreconditionerName
from springbench.solvers.linalg import additive_schwarz
from springbench.solvers.methods.newton.newton_cg import NewtonCG
from springbench.solvers.model.step_problem import DirichletPins, StepProblem, StopRule, Unsupported

from tests.cuda.near import same_iterates
from tests.effect_scenes import (
    AIR_DRAG_EFFECT,
    BENDING_EFFECT,
    DASHPOT_EFFECT,
    STRAIN_LIMIT_EFFECT,
    build_moving_problem,
)
from tests.effect_scenes import EFFECT_SCENES as EFFECTS
from tests.effect_scenes import build_effect_cloth as cloth_with
from tests.scene_builders import SCENE_BUILDERS, build_cloth, build_first_problem, build_random_problem

schwarz_cg = partial(NewtonCG, preconditioner="schwarz")

PROBLEMS: dict[str, Callable[[], StepProblem]] = {
    "chain": lambda: build_first_problem(SCENE_BUILDERS["chain"](1e10)),
    "cloth": lambda: build_first_problem(build_cloth(4, "exact")),
    "bending, dashpots and drag": lambda: build_moving_problem(
        cloth_with(BENDING_EFFECT, DASHPOT_EFFECT, AIR_DRAG_EFFECT)
    ),
    "random": lambda: build_random_problem(0, weights=(1e4, np.inf, 1e2)),
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
    monkeypatch.setattr(additive_schwarz, "SUBDOMAIN_SIZE", 3)
    same_iterates(schwarz_cg, make(), 2)


def test_it_ends_where_the_processor_does() -> None:
    """Kernels in float32, and a minimum in float64."""
    problem, rule = build_first_problem(build_cloth(3, "exact")), StopRule(200, 1e-8)
    there = schwarz_cg(device="cuda").prepare(problem.system).solve(problem, rule)
    here = schwarz_cg().prepare(problem.system).solve(problem, rule)
    assert there.termination_reason == "converged"
    np.testing.assert_allclose(there.positions, here.positions, rtol=0, atol=1e-7)


@pytest.mark.parametrize(
    ("make", "preconditioner", "named"),
    [
        (lambda: build_moving_problem(cloth_with(STRAIN_LIMIT_EFFECT)), "schwarz", "StrainLimits"),
        (lambda: build_moving_problem(EFFECTS["contact"]()), "schwarz", "ContactEnergy|Contact"),
        (lambda: build_moving_problem(EFFECTS["gas"]()), "schwarz", "Gas"),
        (
            lambda: build_first_problem(build_cloth(3, "exact")),
            "cholesky",
            "supports preconditioner: schwarz, not cholesky",
        ),
        (
            lambda: build_first_problem(build_cloth(3, "exact")),
            "block-jacobi",
            "supports preconditioner: schwarz, not block-jacobi",
        ),
    ],
    ids=["strain limits", "contact", "gas", "factor", "block-jacobi"],
)
def test_unsupported_features_are_refused_by_name(
    make: Callable[[], StepProblem], preconditioner: PreconditionerName, named: str
) -> None:
    with pytest.raises(Unsupported, match=f"device: cuda: .*({named})"):
        NewtonCG(preconditioner=preconditioner, device="cuda").prepare(make().system)


def test_sums_of_blocks_are_added_by_a_tree(monkeypatch: pytest.MonkeyPatch) -> None:
    if is_simulated():
        monkeypatch.setattr(device_sums, "THREADS_PER_BLOCK", 8)
    count = 3 * device_sums.THREADS_PER_BLOCK + 1
    terms = np.random.default_rng(0).normal(size=(2, count))
    given, out = cuda.to_device(terms), cuda.to_device(np.zeros(2))
    for _ in range(2):  # whichever thread is first
        device_sums.collect_sums[1, device_sums.THREADS_PER_BLOCK](2, given, count, out)
        np.testing.assert_allclose(out.copy_to_host(), terms.sum(axis=1), rtol=1e-12)


def test_where_nothing_moves_every_kernel_has_a_block() -> None:
    made = build_cloth(3, "exact")
    pins = DirichletPins(np.arange(made.system.num_vertices), np.full(made.system.num_vertices, np.inf))
    system = replace(made.system, pins=pins)
    problem = build_first_problem(made)
    problem = replace(problem, system=system, pin_targets=problem.current_positions)
    found = schwarz_cg(device="cuda").prepare(system).solve(problem, StopRule(2))
    np.testing.assert_array_equal(found.positions, problem.pin_targets)
