"""XPBD on a device: the processor's iterates, in both precisions, wherever springs begin."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np
import pytest
from springbench.solvers.cuda.device_solver import DeviceSolver
from springbench.solvers.methods.position_based.xpbd import Xpbd, XpbdSmallSteps
from springbench.solvers.model.step_problem import StepProblem, StopRule, Unsupported

from tests.cuda.near import iterates, same_iterates
from tests.effect_scenes import BENDING_EFFECT
from tests.effect_scenes import build_effect_cloth as cloth_with
from tests.scene_builders import SCENE_BUILDERS, build_cloth, build_first_problem, build_random_problem


def one_point() -> StepProblem:
    """Springs that begin without length, and so do inertia's predictions."""
    problem = build_first_problem(SCENE_BUILDERS["chain"]("exact"))
    at = np.zeros_like(problem.inertial_target)
    return replace(
        problem,
        inertial_target=at,
        external_force=at,
        step_start=replace(problem.step_start, positions=at, velocity=at),
    )


PROBLEMS: dict[str, Callable[[], StepProblem]] = {
    "chain": lambda: build_first_problem(SCENE_BUILDERS["chain"](1e10)),
    "cloth, exact pins": lambda: build_first_problem(build_cloth(4, "exact")),
    "random": lambda: build_random_problem(0, weights=(1e4, np.inf, 1e2)),
    "random, not pinned": lambda: build_random_problem(1, weights=()),
    "one point": one_point,
}
METHODS: dict[str, Callable[..., Any]] = {"xpbd": Xpbd, "xpbd-small-steps": XpbdSmallSteps}
methods = pytest.mark.parametrize("method", METHODS.values(), ids=list(METHODS))


@methods
@pytest.mark.parametrize("make", PROBLEMS.values(), ids=list(PROBLEMS))
def test_iterates_are_those_of_the_processor(make: Callable[[], StepProblem], method: Callable[..., Any]) -> None:
    same_iterates(method, make(), 5)


@methods
def test_bits_and_velocities_do_not_depend_on_observers(method: Callable[..., Any]) -> None:
    problem, rule = build_first_problem(SCENE_BUILDERS["chain"](1e10)), StopRule(4)
    prepared = method(device="cuda").prepare(problem.system)
    assert isinstance(prepared, DeviceSolver)
    looked_at = [p.copy() for p in islice(prepared.iterates(problem), 4)][-1]
    replayed, solved = prepared.replay_iterations(problem, 4)[0], prepared.solve(problem, rule)
    np.testing.assert_array_equal(replayed.positions, looked_at)
    np.testing.assert_array_equal(solved.positions, looked_at)
    expected = method().prepare(problem.system).solve(problem, rule).velocity
    if expected is None:
        assert replayed.velocity is None
    else:
        assert replayed.velocity is not None
        # Of displacements in float32, which are wrong in the last of their digits, a hundredth of a second each.
        np.testing.assert_allclose(replayed.velocity, expected, rtol=0, atol=1e-5)
        np.testing.assert_array_equal(solved.velocity, replayed.velocity)


def test_solves_of_one_system_may_be_interleaved() -> None:
    one, other = build_random_problem(0), build_random_problem(0)
    other = replace(other, inertial_target=-other.inertial_target)
    prepared = Xpbd(device="cuda").prepare(one.system)
    alone = iterates(Xpbd(device="cuda"), one, 4)
    turns = prepared.iterates(one)
    found = [next(turns).copy() for _ in range(2)]
    prepared.solve(other, StopRule(3))
    found += [next(turns).copy() for _ in range(2)]
    np.testing.assert_array_equal(found, alone)


@methods
def test_unsupported_features_are_refused_by_name(method: Callable[..., Any]) -> None:
    with pytest.raises(Unsupported, match="supports springs only; the scene has Bending"):
        method(device="cuda").prepare(cloth_with(BENDING_EFFECT).system)
