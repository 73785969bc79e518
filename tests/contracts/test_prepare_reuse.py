"""What `prepare` made serves every step of its system, bit for bit as if it had been made for that step alone.

All that a solver factorises, colours or compiles follows from the `System`: masses, time step, energies, and which
vertices are pinned and how. Positions, forces, the pins' targets and the first guess are a step's own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from springbench.solvers.methods.local_global.compiled_local_global import CompiledLocalGlobal
from springbench.solvers.model.step_problem import StepProblem, StopRule
from springbench.solvers.registry import SOLVERS, load_target

from tests.scene_builders import build_cloth, build_first_problem, build_random_problem, make_read_only

SOLVER_VARIANTS = {
    f"numba, {solver.linear_solver} in {solver.precision}": solver
    for solver in (
        CompiledLocalGlobal("supernodal", "float16"),
        CompiledLocalGlobal("inverse", "float32"),
        CompiledLocalGlobal("cg", "float64"),
    )
}
CHOICES = {name: load_target(target)() for name, target in SOLVERS.items()} | SOLVER_VARIANTS
LARGE = "cloth large enough for threads, exact pins"
PROBLEMS = {
    "cloth": lambda: build_first_problem(build_cloth(9)),
    LARGE: lambda: build_first_problem(build_cloth(30, "exact"), "inertial"),
    "random": lambda: build_random_problem(4, weights=(1e4, np.inf, 1e2)),
}
CASES = [(name, choice) for name in PROBLEMS for choice in CHOICES if name != LARGE or choice.startswith("numba")]
STOPS = {"count": StopRule(4), "tolerance": StopRule(30, 1e-2)}


def noise(problem: StepProblem, seed: int) -> np.ndarray:
    """A displacement (n, 3) [m] of a tenth of the scene's size."""
    size = float(np.ptp(problem.current_positions, axis=0).max())
    return 0.1 * size * np.random.default_rng(seed).normal(size=problem.current_positions.shape)


def elsewhere(problem: StepProblem) -> StepProblem:
    current = problem.current_positions + noise(problem, 1)
    current[problem.system.pins.vertices] = problem.pin_targets
    start = replace(problem.step_start, positions=current, velocity=noise(problem, 2), velocity_origin=current)
    return replace(
        problem,
        current_positions=current,
        initial_guess=current,
        inertial_target=current + noise(problem, 3),
        step_start=start,
    )


def change_force(problem: StepProblem) -> StepProblem:
    return replace(problem, external_force=-2.0 * problem.external_force + noise(problem, 4))


def change_targets(problem: StepProblem) -> StepProblem:
    targets = problem.pin_targets + noise(problem, 5)[: len(problem.pin_targets)]
    current = problem.current_positions.copy()
    current[problem.system.pins.vertices] = targets
    return replace(problem, pin_targets=targets, current_positions=current)


def change_guess(problem: StepProblem) -> StepProblem:
    return replace(problem, initial_guess=problem.initial_guess + noise(problem, 6))


STEPS: tuple[Callable[[StepProblem], StepProblem], ...] = (
    elsewhere,
    change_force,
    change_targets,
    change_guess,
    lambda problem: change_guess(change_targets(change_force(elsewhere(problem)))),
)


@pytest.mark.parametrize(("name", "choice"), CASES)
def test_one_preparation_serves_all_steps_of_a_system(name, choice):
    solver, first = CHOICES[choice], make_read_only(PROBLEMS[name]())
    reused = solver.prepare(first.system)
    before = [reused.solve(first, stop).positions for stop in STOPS.values()]
    for step in STEPS:
        problem, fresh = make_read_only(step(first)), solver.prepare(first.system)
        for k, stop in enumerate(STOPS.values()):
            found, expected = reused.solve(problem, stop), fresh.solve(problem, stop)
            np.testing.assert_array_equal(found.positions, expected.positions)
            assert (found.num_iterations, found.termination_reason) == (
                expected.num_iterations,
                expected.termination_reason,
            )
            # A residual that was not requested is no number, and equals itself here.
            np.testing.assert_array_equal(
                [found.residual, found.initial_residual], [expected.residual, expected.initial_residual]
            )
            # The last step is another one in every respect: what was prepared, or solved before, does not answer it.
            assert step is not STEPS[-1] or not np.array_equal(found.positions, before[k])
