"""The driver: a method is its formula, and gets the loop, the stop rule and its answers from
`springbench.solvers.iteration.iterative_solver`."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import islice

import numpy as np
import pytest
from springbench.solvers.iteration import iterative_solver
from springbench.solvers.iteration.iterative_solver import IterativeSolver, SolverState
from springbench.solvers.kernels.iteration_loop import (
    REASON_FLOOR,
    REASON_ITERATIONS,
    REASON_STALLED,
    REASON_TOLERANCE,
    RESIDUAL_EACH,
    RESIDUAL_LAST,
    RESIDUAL_NEVER,
    LoopLimits,
)
from springbench.solvers.methods.local_global.prefactored import require_only_springs
from springbench.solvers.model.step_problem import Positions, StepProblem, StopRule, System

from tests.scene_builders import build_cloth, build_first_problem


# A whole method, of the formula p <- p - D^-1 grad g(p), where D is twice the springs of each vertex: it majorises.
@dataclass(frozen=True)
class DiagonalDescent:
    def prepare(self, system: System) -> PreparedDiagonal:
        springs, (_, soft, weight) = require_only_springs(system, "diagonal"), system.penalty_pins
        diagonal = system.inertia_diagonal + np.bincount(soft, weight, minlength=system.num_vertices)
        stiffness = np.repeat(springs.stiffness, 2)
        return PreparedDiagonal(
            diagonal + 2.0 * np.bincount(springs.edges.ravel(), stiffness, minlength=system.num_vertices)
        )


@dataclass(frozen=True, eq=False)
class PreparedDiagonal(IterativeSolver):
    diagonal: np.ndarray
    description: str = ""
    stats: dict[str, float] = field(default_factory=dict)

    def init_state(self, problem: StepProblem, initial_guess: Positions) -> SolverState:
        return Diagonal(self.diagonal[:, None], problem, initial_guess.copy())


class Diagonal(SolverState):
    def __init__(self, diagonal: np.ndarray, problem: StepProblem, p: Positions) -> None:
        self.diagonal, self.problem, self.positions = diagonal, problem, p

    def step_state(self) -> bool:
        self.positions = self.positions - self.problem.gradient(self.positions) / self.diagonal
        return True

    def residual(self) -> float:  # |D^-1 g|_D over the unpinned vertices
        g = self.problem.gradient(self.positions)[self.problem.system.unpinned_mask]
        return float(np.sqrt((g**2 / self.diagonal[self.problem.system.unpinned_mask]).sum()))


def test_a_method_of_thirty_lines_is_a_solver():
    problem = build_first_problem(build_cloth(5))
    prepared = DiagonalDescent().prepare(problem.system)
    solution = prepared.solve(problem, StopRule(5000, 1e-3))
    assert (solution.termination_reason, solution.residual_iterate) == ("converged", "returned")
    assert 10 < solution.num_iterations < 5000
    assert solution.residual <= 1e-3 * solution.initial_residual
    assert solution.residual == prepared.residual_at(problem, solution.positions)
    assert solution.initial_residual == prepared.residual_at(problem, problem.current_positions)
    before, last = (
        p.copy() for p in islice(prepared.iterates(problem), solution.num_iterations - 2, solution.num_iterations)
    )
    np.testing.assert_array_equal(last, solution.positions)
    assert prepared.residual_at(problem, before) > 1e-3 * solution.initial_residual
    assert problem.value(last) < problem.value(before) < problem.value(problem.current_positions)


def test_without_a_tolerance_only_the_last_residual_is_requested(monkeypatch):
    problem, arguments = build_first_problem(build_cloth(3)), []
    measured = Diagonal.residual
    monkeypatch.setattr(Diagonal, "residual", lambda self: arguments.append(0) or measured(self))
    solution = DiagonalDescent().prepare(problem.system).solve(problem, StopRule(6))
    assert (solution.num_iterations, solution.termination_reason, len(arguments)) == (6, "max-iter", 1)


class Table(SolverState):
    """Residuals that are given; None where the state cannot advance."""

    def __init__(self, *residuals: float | None) -> None:
        self.residuals, self.at, self.now, self.asked = residuals, 0, np.nan, 0

    def step_state(self) -> bool:
        following, self.at = self.residuals[self.at], self.at + 1
        self.now = self.now if following is None else following
        return following is not None

    def residual(self) -> float:
        self.asked += 1
        return self.now


LOOPS = {
    "the limit of iterations": (
        (4.0, 3.0, 2.0, 1.0),
        LoopLimits(3, 0.5, 0.0, RESIDUAL_EACH),
        (3, 2.0, REASON_ITERATIONS),
        3,
    ),
    "a tolerance": ((4.0, 3.0, 2.0, 1.0), LoopLimits(9, 2.5, 0.0, RESIDUAL_EACH), (3, 2.0, REASON_TOLERANCE), 3),
    "the floor": ((4.0, 3.0, 2.0), LoopLimits(9, 1.0, 3.5, RESIDUAL_EACH), (2, 3.0, REASON_FLOOR), 2),
    "a tolerance above the floor": ((1.0,), LoopLimits(9, 2.0, 2.0, RESIDUAL_EACH), (1, 1.0, REASON_TOLERANCE), 1),
    "nothing that descends": ((4.0, None), LoopLimits(9, 0.5, 0.0, RESIDUAL_EACH), (1, 4.0, REASON_STALLED), 2),
    "nothing that descends, unwatched": (
        (4.0, None),
        LoopLimits(9, 0.0, 0.0, RESIDUAL_LAST),
        (1, 4.0, REASON_STALLED),
        1,
    ),
    "a residual of zero, unwatched": (
        (0.0, 0.0),
        LoopLimits(2, 0.0, 0.0, RESIDUAL_LAST),
        (2, 0.0, REASON_ITERATIONS),
        1,
    ),
    "no residual": ((4.0, 3.0), LoopLimits(2, 0.0, 0.0, RESIDUAL_NEVER), (2, np.nan, REASON_ITERATIONS), 0),
    "no number": ((np.nan, np.nan), LoopLimits(2, 1.0, 1.0, RESIDUAL_EACH), (2, np.nan, REASON_ITERATIONS), 2),
    "no iteration": ((), LoopLimits(0, 1.0, 1.0, RESIDUAL_LAST), (0, np.nan, REASON_ITERATIONS), 1),
}


@pytest.mark.parametrize("what", LOOPS)
def test_a_loop_ends_by(what):
    residuals, limits, expected, requested = LOOPS[what]
    state = Table(*residuals)
    np.testing.assert_equal(state.run_iterations(limits), expected)
    assert state.asked == requested


class BatchedState(SolverState):
    """Does several iterations in one call, all but those after the first `able`."""

    def __init__(self, able: int) -> None:
        self.able, self.batches = able, list[int]()

    def step_state(self) -> bool:
        return self.run_unchecked(1) == 1

    def run_unchecked(self, num_iterations: int) -> int:
        self.batches.append(num_iterations)
        return min(num_iterations, self.able - sum(self.batches[:-1]))

    def iterations_until_residual(self) -> int:
        return 4

    def residual(self) -> float:
        return 1.0


def test_iterations_between_residuals_are_one_call():
    for able, mode, batches, expected in (
        (99, RESIDUAL_EACH, [4, 4, 2], (10, 1.0, REASON_ITERATIONS)),
        (99, RESIDUAL_LAST, [10], (10, 1.0, REASON_ITERATIONS)),
        (6, RESIDUAL_EACH, [4, 4], (6, 1.0, REASON_STALLED)),
        (6, RESIDUAL_NEVER, [10], (6, np.nan, REASON_STALLED)),
    ):
        state = BatchedState(able)
        np.testing.assert_equal(state.run_iterations(LoopLimits(10, 0.5, 0.0, mode)), expected)
        assert state.batches == batches


class Stepping(SolverState):
    """Halves its residual, and is certain of a minimum only from `certain` iterations on."""

    def __init__(self, certain: int, most: int) -> None:
        self.count, self.certain, self.most = 0, certain, most
        self.positions = np.zeros((1, 3))

    def step_state(self) -> bool:
        moved = self.count < self.most
        self.count += moved
        return moved

    def residual(self) -> float:
        return 0.5**self.count

    def can_terminate(self) -> bool:
        return self.count >= self.certain


@dataclass(frozen=True)
class PreparedStepping(IterativeSolver):
    certain: int
    most: int = 1000

    @property
    def can_identify_saddles(self) -> bool:
        return True

    def init_state(self, problem: StepProblem, initial_guess: Positions) -> SolverState:
        return Stepping(self.certain, self.most)


@pytest.mark.parametrize(
    ("prepared", "stop", "expected"),
    [
        (PreparedStepping(0), StopRule(50, 1e-6), (20, "converged")),
        (PreparedStepping(30), StopRule(50, 1e-6), (30, "converged")),
        (PreparedStepping(30), StopRule(25, 1e-6), (25, "max-iter")),
        (PreparedStepping(30), StopRule(50, 1e-3), (10, "converged")),  # so loose a tolerance requires no minimum
        (PreparedStepping(30, most=24), StopRule(50, 1e-6), (24, "stalled")),
    ],
)
def test_a_close_tolerance_ends_a_solve_at_a_minimum_only(prepared, stop, expected):
    solution = prepared.solve(build_first_problem(build_cloth(3)), stop)
    assert (solution.num_iterations, solution.termination_reason) == expected


@dataclass(frozen=True)
class PreparedNear(PreparedStepping):
    """Near to round-off by its residual from the fortieth iteration on."""

    def residual_scale(self, problem: StepProblem) -> float:
        return 1e12 * 0.5**40


@pytest.mark.parametrize(
    ("rests", "most", "expected", "looks"),
    [
        (0, 90, (40, "roundoff"), [40]),
        (41, 90, (41, "roundoff"), [40, 41]),
        (
            45,
            90,
            (47, "roundoff"),
            [40, 41, 42, 44, 47],
        ),  # not after every one: a look costs as much as some of them
        (99, 43, (43, "max-iter"), [40, 41, 42, 43]),
    ],
)
def test_a_small_residual_is_the_floor_where_the_gradient_is_round_off(monkeypatch, rests, most, expected, looks):
    run, looked = Stepping(0, 1000), []
    monkeypatch.setattr(PreparedNear, "init_state", lambda *_: run)
    monkeypatch.setattr(
        iterative_solver, "is_gradient_roundoff", lambda *_: looked.append(run.count) or run.count >= rests
    )
    monkeypatch.setattr(PreparedNear, "residual_at", lambda *_: 1.0)
    solution = PreparedNear(0).solve(build_first_problem(build_cloth(3)), StopRule(most, 1e-300))
    assert ((solution.num_iterations, solution.termination_reason), looked) == (expected, looks)
