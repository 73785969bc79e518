"""The driver: a method is its formula, and gets the loop, the stop rule and its answers from `solvers.core.driver`."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import islice

import numpy as np
import pytest

from solvers.core import driver
from solvers.core.driver import Iterating, Iterative
from solvers.core.prefactored import only_springs
from solvers.kernels.loop import EACH, FLOOR, ITERATIONS, LAST, NEVER, STALLED, TOLERANCE, Limits, over
from solvers.problem import Positions, StepProblem, StopRule, System
from tests.scenes import cloth, first_problem


# A whole method, of the formula p <- p - D^-1 grad g(p), where D holds each vertex by twice its springs: it majorises.
@dataclass(frozen=True)
class DiagonalDescent:
    def prepare(self, system: System) -> PreparedDiagonal:
        springs, (_, soft, weight) = only_springs(system, "diagonal"), system.penalty
        held = system.inertia + np.bincount(soft, weight, minlength=system.vertices)
        stiffness = np.repeat(springs.stiffness, 2)
        return PreparedDiagonal(held + 2.0 * np.bincount(springs.edges.ravel(), stiffness, minlength=system.vertices))


@dataclass(frozen=True, eq=False)
class PreparedDiagonal(Iterative):
    diagonal: np.ndarray
    choice: str = ""
    facts: dict[str, float] = field(default_factory=dict)

    def begin(self, problem: StepProblem, guess: Positions) -> Iterating:
        return Diagonal(self.diagonal[:, None], problem, guess.copy())


class Diagonal(Iterating):
    def __init__(self, diagonal: np.ndarray, problem: StepProblem, p: Positions) -> None:
        self.diagonal, self.problem, self.positions = diagonal, problem, p

    def advance(self) -> bool:
        self.positions = self.positions - self.problem.gradient(self.positions) / self.diagonal
        return True

    def residual(self) -> float:  # |D^-1 g|_D over the unpinned vertices
        g = self.problem.gradient(self.positions)[self.problem.system.unpinned]
        return float(np.sqrt((g**2 / self.diagonal[self.problem.system.unpinned]).sum()))


def test_a_method_of_thirty_lines_is_a_solver():
    problem = first_problem(cloth(5))
    prepared = DiagonalDescent().prepare(problem.system)
    solution = prepared.solve(problem, StopRule(5000, 1e-3))
    assert (solution.stopped, solution.residual_of) == ("tolerance", "returned")
    assert 10 < solution.iterations < 5000
    assert solution.residual <= 1e-3 * solution.yardstick
    assert solution.residual == prepared.residual_at(problem, solution.positions)
    assert solution.yardstick == prepared.residual_at(problem, problem.current)
    before, last = (p.copy() for p in islice(prepared.iterates(problem), solution.iterations - 2, solution.iterations))
    np.testing.assert_array_equal(last, solution.positions)
    assert prepared.residual_at(problem, before) > 1e-3 * solution.yardstick
    assert problem.value(last) < problem.value(before) < problem.value(problem.current)


def test_without_a_tolerance_only_the_last_residual_is_asked_for(monkeypatch):
    problem, asked = first_problem(cloth(3)), []
    measured = Diagonal.residual
    monkeypatch.setattr(Diagonal, "residual", lambda self: asked.append(0) or measured(self))
    solution = DiagonalDescent().prepare(problem.system).solve(problem, StopRule(6))
    assert (solution.iterations, solution.stopped, len(asked)) == (6, "iterations", 1)


class Table:
    """Residuals that are given; None where the state cannot advance."""

    def __init__(self, *residuals: float | None) -> None:
        self.residuals, self.at, self.now, self.asked = residuals, 0, np.nan, 0

    def advance(self) -> bool:
        following, self.at = self.residuals[self.at], self.at + 1
        self.now = self.now if following is None else following
        return following is not None

    def residual(self) -> float:
        self.asked += 1
        return self.now


LOOPS = {
    "the limit of iterations": ((4.0, 3.0, 2.0, 1.0), Limits(3, 0.5, 0.0, EACH), (3, 2.0, ITERATIONS), 3),
    "a tolerance": ((4.0, 3.0, 2.0, 1.0), Limits(9, 2.5, 0.0, EACH), (3, 2.0, TOLERANCE), 3),
    "the floor": ((4.0, 3.0, 2.0), Limits(9, 1.0, 3.5, EACH), (2, 3.0, FLOOR), 2),
    "a tolerance above the floor": ((1.0,), Limits(9, 2.0, 2.0, EACH), (1, 1.0, TOLERANCE), 1),
    "nothing that descends": ((4.0, None), Limits(9, 0.5, 0.0, EACH), (1, 4.0, STALLED), 2),
    "nothing that descends, unwatched": ((4.0, None), Limits(9, 0.0, 0.0, LAST), (1, 4.0, STALLED), 1),
    "a residual of zero, unwatched": ((0.0, 0.0), Limits(2, 0.0, 0.0, LAST), (2, 0.0, ITERATIONS), 1),
    "no residual": ((4.0, 3.0), Limits(2, 0.0, 0.0, NEVER), (2, np.nan, ITERATIONS), 0),
    "no number": ((np.nan, np.nan), Limits(2, 1.0, 1.0, EACH), (2, np.nan, ITERATIONS), 2),
    "no iteration": ((), Limits(0, 1.0, 1.0, LAST), (0, np.nan, ITERATIONS), 1),
}


@pytest.mark.parametrize("what", LOOPS)
def test_a_loop_ends_by(what):
    residuals, limits, wanted, asked = LOOPS[what]
    state = Table(*residuals)
    np.testing.assert_equal(over(Table.advance, Table.residual)(state, limits), wanted)
    assert state.asked == asked


class Stepping(Iterating):
    """Halves its residual, and is certain of a minimum only from `certain` iterations on."""

    def __init__(self, certain: int, most: int) -> None:
        self.count, self.certain, self.most = 0, certain, most
        self.positions = np.zeros((1, 3))

    def advance(self) -> bool:
        moved = self.count < self.most
        self.count += moved
        return moved

    def residual(self) -> float:
        return 0.5**self.count

    def certifies(self) -> bool:
        return self.count >= self.certain


@dataclass(frozen=True)
class PreparedStepping(Iterative):
    certain: int
    most: int = 1000

    def begin(self, problem: StepProblem, guess: Positions) -> Iterating:
        return Stepping(self.certain, self.most)


@pytest.mark.parametrize(
    ("prepared", "stop", "wanted"),
    [
        (PreparedStepping(0), StopRule(50, 1e-6), (20, "tolerance")),
        (PreparedStepping(30), StopRule(50, 1e-6), (30, "tolerance")),
        (PreparedStepping(30), StopRule(25, 1e-6), (25, "iterations")),
        (PreparedStepping(30), StopRule(50, 1e-3), (10, "tolerance")),  # so loose a tolerance asks for no minimum
        (PreparedStepping(30, most=24), StopRule(50, 1e-6), (24, "stalled")),
    ],
)
def test_a_close_tolerance_ends_a_solve_at_a_minimum_only(prepared, stop, wanted):
    solution = prepared.solve(first_problem(cloth(3)), stop)
    assert (solution.iterations, solution.stopped) == wanted


@dataclass(frozen=True)
class PreparedNear(PreparedStepping):
    """Near to round-off by its residual from the fortieth iteration on."""

    def scale(self, problem: StepProblem) -> float:
        return 1e12 * 0.5**40


@pytest.mark.parametrize(
    ("rests", "most", "wanted", "looks"),
    [
        (0, 90, (40, "floor"), [40]),
        (41, 90, (41, "floor"), [40, 41]),
        (45, 90, (47, "floor"), [40, 41, 42, 44, 47]),  # not after every one: a look costs as much as some of them
        (99, 43, (43, "iterations"), [40, 41, 42, 43]),
    ],
)
def test_a_small_residual_is_the_floor_where_the_gradient_is_round_off(monkeypatch, rests, most, wanted, looks):
    run, looked = Stepping(0, 1000), []
    monkeypatch.setattr(PreparedNear, "begin", lambda *_: run)
    monkeypatch.setattr(driver, "at_rest", lambda *_: looked.append(run.count) or run.count >= rests)
    monkeypatch.setattr(PreparedNear, "residual_at", lambda *_: 1.0)
    solution = PreparedNear(0).solve(first_problem(cloth(3)), StopRule(most, 1e-300))
    assert ((solution.iterations, solution.stopped), looked) == (wanted, looks)
