"""Vertex block descent on a device: the processor's iterates, in both precisions, wherever it begins."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import islice, pairwise
from typing import Any, Literal

import numpy as np
import pytest
from springbench.solvers.cuda.cuda_device import is_simulated
from springbench.solvers.cuda.device_solver import ITERATIONS_PER_RESIDUAL, DeviceSolver
from springbench.solvers.iteration import vertex_terms
from springbench.solvers.methods.vertex_block import device_vbd
from springbench.solvers.methods.vertex_block.device_vbd_kernels import OBJECTIVE
from springbench.solvers.methods.vertex_block.vbd import VertexBlockDescent
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.step_problem import Positions, StepProblem, StopRule, Unsupported
from springbench.solvers.objective.fixed_objective import FixedObjective
from springbench.solvers.objective.step_objective import StepObjective

from tests.effect_scenes import BENDING_EFFECT, STRAIN_LIMIT_EFFECT
from tests.effect_scenes import build_effect_cloth as cloth_with
from tests.scene_builders import SCENE_BUILDERS, build_cloth, build_first_problem, build_random_problem

PROBLEMS: dict[str, Callable[[], StepProblem]] = {
    "chain": lambda: build_first_problem(SCENE_BUILDERS["chain"](1e10)),
    "cloth, exact pins, inertial guess": lambda: build_first_problem(build_cloth(4, "exact"), "inertial"),
    "bending": lambda: build_first_problem(cloth_with(BENDING_EFFECT)),
    "random": lambda: build_random_problem(0, weights=(1e4, np.inf, 1e2)),
    "random, not pinned": lambda: build_random_problem(1, weights=()),
}
problems = pytest.mark.parametrize("make", PROBLEMS.values(), ids=list(PROBLEMS))
radii = pytest.mark.parametrize("radius", [0.0, 0.999], ids="rho = {:g}".format)

STARTS: dict[str, Callable[[Positions, np.random.Generator], Positions]] = {
    "one point": lambda p, rng: np.zeros_like(p),
    "a line": lambda p, rng: p * [1.0, 0.0, 0.0],
    "a tangle": lambda p, rng: rng.normal(size=p.shape),
    "inside out": lambda p, rng: -p,
}


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """The reference changes within few iterations."""
    monkeypatch.setattr(device_vbd, "REBASE_INTERVAL", 3)


PRECISIONS: tuple[Literal["float64", "float32"], ...] = ("float64", "float32")


def spacing(problem: StepProblem) -> float:
    """The mean length of springs at rest [m]."""
    return float(np.mean(Springs.from_parts([e for e in problem.energies if isinstance(e, Springs)]).rest_length))


def iterates(method: VertexBlockDescent, problem: StepProblem, count: int) -> list[Positions]:
    return [p.copy() for p in islice(method.prepare(problem.system).iterates(problem), count)]


def on_device(problem: StepProblem, radius: float = 0.999) -> DeviceSolver:
    prepared = VertexBlockDescent(radius, device="cuda").prepare(problem.system)
    assert isinstance(prepared, DeviceSolver)
    return prepared


@problems
@radii
def test_iterates_are_those_of_the_processor(make: Callable[[], StepProblem], radius: float) -> None:
    problem = make()
    expected = iterates(VertexBlockDescent(radius), problem, 5)
    for precision, close in zip(PRECISIONS, (1e-10, 1e-5 * spacing(problem)), strict=True):
        found = iterates(VertexBlockDescent(radius, device="cuda", precision=precision), problem, 5)
        np.testing.assert_allclose(found, expected, rtol=0, atol=close, err_msg=precision)


@pytest.mark.parametrize("name", STARTS)
def test_iterations_descend_from_any_start(name: str) -> None:
    problem = build_first_problem(SCENE_BUILDERS["chain"]("exact"))
    start = STARTS[name](vertex_terms.apply_exact_pins(problem.initial_guess, problem), np.random.default_rng(0))
    problem = replace(problem, initial_guess=vertex_terms.apply_exact_pins(start, problem))
    step = StepObjective(FixedObjective(problem.system), problem)
    expected = iterates(VertexBlockDescent(0.0), problem, 5)
    for precision, round_off in zip(PRECISIONS, (1e-13, 1e-6), strict=True):
        found = iterates(VertexBlockDescent(0.0, device="cuda", precision=precision), problem, 5)
        size = abs(step.objective_change(found[-1], problem.initial_guess)[0])
        rises = [step.objective_change(p, q)[0] for p, q in pairwise((problem.initial_guess, *found))]
        assert np.isfinite(rises).all()
        assert max(rises) <= round_off * size, precision
        # Where a spring has no length the processor takes the eight vertices of a packet apart, a device the one.
        if precision == "float64" and name != "one point":
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10)


def test_in_single_precision_it_ends_at_the_minimum_in_double() -> None:
    problem = build_random_problem(0, weights=(1e4, np.inf, 1e2))
    expected = iterates(VertexBlockDescent(0.0), problem, 60)[-1]
    found, _ = on_device(problem, 0.0).replay_iterations(problem, 60)
    np.testing.assert_allclose(found.positions, expected, rtol=0, atol=1e-10)


def test_bits_do_not_depend_on_observers() -> None:
    problem = build_first_problem(SCENE_BUILDERS["chain"](1e10))
    prepared = on_device(problem)
    looked_at = [p.copy() for p in islice(prepared.iterates(problem), 7)][-1]
    *_, copied = islice(prepared.iterates_without_copy(problem), 7)
    np.testing.assert_array_equal(copied(), looked_at)
    np.testing.assert_array_equal(prepared.replay_iterations(problem, 7)[0].positions, looked_at)
    np.testing.assert_array_equal(prepared.solve(problem, StopRule(7)).positions, looked_at)


@pytest.mark.parametrize("iterations", [1, 2])
def test_the_objective_is_summed_over_all_vertices(iterations: int) -> None:
    """By threads that wait for each other, from the reference on; elsewhere it but decides whether to extrapolate."""
    vertices = 12 if is_simulated() else 300  # so that they are several blocks
    problem = build_random_problem(1, n=vertices, m=5 * vertices // 2, weights=())
    run: Any = on_device(problem).init_state(problem, problem.initial_guess)
    run.run_unchecked(iterations)
    run._sum_objective(run._displacement, OBJECTIVE, run._sums[0])
    found, step = run.stream.download_array(run._sums[0]).sum(), StepObjective(FixedObjective(problem.system), problem)
    assert len(run._sums[0]) > 1
    assert found == pytest.approx(step.objective_change(problem.initial_guess, run.positions)[0], rel=1e-5)


def test_solves_that_reuse_memory_end_at_the_same_bits() -> None:
    one, other = build_random_problem(1, weights=()), build_random_problem(1, weights=())
    other = replace(other, initial_guess=-other.initial_guess, external_force=2.0 * other.external_force)
    alone = [on_device(p).replay_iterations(p, 5)[0].positions for p in (one, other)]
    prepared = on_device(one)
    for _ in range(2):
        for problem, expected in zip((one, other), alone, strict=True):
            np.testing.assert_array_equal(prepared.replay_iterations(problem, 5)[0].positions, expected)
            np.testing.assert_array_equal(prepared.solve(problem, StopRule(5)).positions, expected)


def test_a_residual_may_end_it_after_each_few_iterations() -> None:
    problem = build_first_problem(SCENE_BUILDERS["chain"]("exact"))
    processor, device = VertexBlockDescent(0.0).prepare(problem.system), on_device(problem, 0.0)
    tolerance = 1e-2
    exact, found = (made.solve(problem, StopRule(100, tolerance)) for made in (processor, device))
    assert found.termination_reason == "converged"
    assert exact.num_iterations <= found.num_iterations < exact.num_iterations + ITERATIONS_PER_RESIDUAL
    assert found.num_iterations % ITERATIONS_PER_RESIDUAL == 0
    assert found.residual == pytest.approx(device.residual_at(problem, found.positions))
    assert found.residual <= tolerance * processor.residual_at(problem, problem.current_positions)


def test_unsupported_features_are_named() -> None:
    with pytest.raises(Unsupported, match=r"StrainLimits.*use `device: cpu`"):
        on_device(build_first_problem(cloth_with(STRAIN_LIMIT_EFFECT)))
