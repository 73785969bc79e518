"""What solvers report of their results of hard cases is true, by independent code.

The residual |Q^-1 grad g| comes from a Q of its own, factorised by SuperLU, and the gradient of the plain formulas.
"""

from __future__ import annotations

import numpy as np
import pytest
from springbench.harness.reference.reference_evaluator import ReferenceEvaluator
from springbench.harness.simulation.time_loop import build_initial_state, build_problem, prepare
from springbench.solvers.model.step_problem import Solution, StepProblem, StopRule, Unsupported

from tests.stability.test_hard_scenes import METHODS, cases, scene, spacing

MINIMISERS = {name: solver for name, solver in METHODS.items() if solver.is_minimiser}
TOLERANCE = 1e-6
STOP = StopRule(100, TOLERANCE)
CLAIMED_REASONS = ("converged", "roundoff")
"""What a solver calls an end; "stalled" and "max-iter" claim nothing."""
SLACK = 2.0
"""Two factorisations of one Q differ by round-off, and some methods stop by the residual one iteration earlier."""

UNIQUE = (
    "geometry-all-rest-lengths-zero",
    "numbers-nearly-no-springs",
    "numbers-step-1e-4-soft",
    "numbers-stiffness-number-1e-4",
    "numbers-stiffness-number-1e-8",
    "topology-all-pins",
    "topology-all-pins-exact",
    "topology-no-springs",
    "topology-single-pinned-vertex",
    "topology-single-vertex",
)
"""Cases whose objective is convex: inertia, or springs without length, outweigh what compressed springs take."""


def solve_first_step(case: str, stop: StopRule) -> tuple[StepProblem, dict[str, Solution]]:
    """The first step of a case, and the answers of the minimisers that take it."""
    made, found = scene(case), {}
    stated = build_problem(made, build_initial_state(made), "previous")
    for name, solver in MINIMISERS.items():
        try:
            found[name] = prepare(made, solver).solve(stated, stop)
        except Unsupported:
            continue
    return stated, found


@cases
def test_a_solution_is_as_stationary_as_reported(case: str):
    stated, found = solve_first_step(case, STOP)
    oracle = ReferenceEvaluator(stated.system)
    for name, solution in found.items():
        reading, said = (
            oracle.measure_stationarity(stated, solution.positions),
            solution.termination_reason in CLAIMED_REASONS,
        )
        assert not said or reading.above_roundoff <= SLACK * TOLERANCE, (name, solution.termination_reason, reading)
        assert solution.termination_reason != "max-iter" or solution.num_iterations == STOP.max_iterations, name


@pytest.mark.parametrize("case", UNIQUE)
def test_all_minimisers_agree_where_there_is_one_minimum(case: str):
    _, found = solve_first_step(case, StopRule(1000, 1e-9))
    assert {name for name, solution in found.items() if solution.termination_reason != "max-iter"} == set(MINIMISERS)
    # The tolerance of what the step moves, at most some metres, a hundredfold for what is softer than Q.
    atol = 1e-7 * spacing(scene(case))
    for name, solution in found.items():
        np.testing.assert_allclose(solution.positions, found["newton"].positions, rtol=0, atol=atol, err_msg=name)
