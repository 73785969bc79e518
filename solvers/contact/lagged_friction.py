"""Lagged friction: a fixed-point iteration over the solves of a step that updates normal forces.

    x_0 = argmin E(x; N at the step's start),     x_{k+1} = argmin E(x; N(x_k)),     k + 1 < friction_iterations

Normal forces N, contact points and directions are constant in a solve, so that friction has a potential (Li et al.
2020, "Incremental potential contact", section 5). With f(x; N) the gradient of friction, f(x_k; N(x_k)) - f(x_k;
N(x_{k-1})) is the residual of x_k with its own normal forces. The iteration ends once its largest component is at most
FRICTION_RTOL times that of f, or after `friction_iterations` of the energies.

The iteration need not converge. Friction itself may press contacts together, as in a wedge. Or mu N may be so large
that a vertex leaves the activation distance in one iteration and, without normal force there, slides back in the next.
A cycle of iterates also ends the iteration, at its iterate with the largest friction: the others slide as if there were
little or none. The remaining change is reported, and is then not small.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import NamedTuple, Protocol, TypeGuard, runtime_checkable

import numpy as np
from springbench.solvers.model.step_problem import (
    Energy,
    Positions,
    PreparedSolver,
    Solution,
    StepProblem,
    StopRule,
    System,
)

MAX_FRICTION_ITERATIONS = 20
"""Default maximum number of solves of a step."""

FRICTION_RTOL = 1e-4
"""Change relative to the largest friction force below which the iteration has converged."""

MAX_CYCLE_PERIOD, CYCLE_RTOL = 4, 1e-2
"""Longest detected cycle, and the distance from an earlier iterate that counts as a return, relative to the distance
from the previous one. Iterates that converge by less than 1 % per iteration would not converge within the maximum
number of iterations either."""


@runtime_checkable
class FrictionEnergy(Energy, Protocol):
    """An energy whose friction depends on `StepStart.normal_force_positions`."""

    friction: float
    friction_iterations: int

    def friction_gradient(self, p: Positions) -> Positions | None:
        """Return the gradient of friction alone [N] at p (n, 3); None where it is zero."""
        ...


class FrictionSolver(PreparedSolver, Protocol):
    """A prepared solver that may evaluate friction itself, with the normal forces of each iterate."""

    @property
    def has_own_friction(self) -> bool:
        """Whether it does so, for its system; a step is then solved once."""
        ...


class FrictionConvergence(NamedTuple):
    """Iterations of a step, and the last change of friction relative to its largest component."""

    num_iterations: int
    relative_change: float


class FrictionSolve(NamedTuple):
    """A solved step.

    Attributes:
        problem: the problem of the last iteration, with the initial guess of the first one.
        solution: its solution.
        iteration_counts: solver iterations of each solve.
        convergence: convergence of friction; None where the scene has none.
    """

    problem: StepProblem
    solution: Solution
    iteration_counts: tuple[int, ...]
    convergence: FrictionConvergence | None


def solve_with_friction(prepared: PreparedSolver, problem: StepProblem, stop: StopRule) -> FrictionSolve:
    """Solve a step until friction has the normal forces of the solution.

    It is solved once without friction, or by a method that evaluates friction itself.

    Args:
        prepared: the prepared solver.
        problem: the step.
        stop: stop rule of each solve.
    """
    solution = prepared.solve(problem, stop)
    rounds = _max_friction_iterations(problem.system)
    if not rounds or evaluates_friction(prepared):
        return FrictionSolve(problem, solution, (solution.num_iterations,), None)
    if _has_no_normal_forces(problem, solution.positions):
        return FrictionSolve(problem, solution, (solution.num_iterations,), FrictionConvergence(1, 0.0))
    counts, guess = [solution.num_iterations], problem.initial_guess
    earlier = deque[_Round](maxlen=MAX_CYCLE_PERIOD)
    while True:
        x = solution.positions
        # Later solves move little, so that all reuse the sparsity pattern at the first solution, and its analysis.
        first = x if len(counts) == 1 else problem.step_start.pattern_positions
        start = replace(problem.step_start, pattern_positions=first, normal_force_positions=x)
        following = replace(problem, initial_guess=x, step_start=start)
        change, acting = _relative_friction_change(problem, following, x)
        ended = len(counts) >= rounds or _is_cycle_at_largest(earlier, x, acting)
        if not change > FRICTION_RTOL or ended:  # `change` is NaN if the solve diverged
            problem = problem if len(counts) == 1 else replace(problem, initial_guess=guess)
            return FrictionSolve(problem, solution, tuple(counts), FrictionConvergence(len(counts), change))
        earlier.append(_Round(x, acting))
        problem, solution = following, prepared.solve(following, stop)
        counts.append(solution.num_iterations)


def evaluates_friction(prepared: PreparedSolver) -> bool:
    """Return whether a prepared solver evaluates friction itself."""
    return _is_friction_solver(prepared) and prepared.has_own_friction


def _is_friction_solver(prepared: PreparedSolver) -> TypeGuard[FrictionSolver]:
    return hasattr(prepared, "has_own_friction")


def has_friction(energy: Energy) -> TypeGuard[FrictionEnergy]:
    """Return whether an energy has friction with lagged normal forces."""
    return getattr(energy, "friction", 0.0) > 0.0 and hasattr(energy, "friction_iterations")


def _max_friction_iterations(system: System) -> int:
    """Return the maximum number of friction iterations of all energies, 0 without friction."""
    most = 0
    for energy in system.energies:
        if has_friction(energy):
            most = max(most, energy.friction_iterations)
    return most


class _Round(NamedTuple):
    """Final positions (n, 3) [m] of an iteration, and its largest friction component [N]."""

    positions: Positions
    acting: float


def _is_cycle_at_largest(earlier: deque[_Round], x: Positions, acting: float) -> bool:
    """Return whether x closes a cycle in which no iterate had more friction."""
    if len(earlier) < 2:
        return False
    moved = _largest_component(x - earlier[-1].positions)
    for period in range(2, len(earlier) + 1):
        if _largest_component(x - earlier[-period].positions) <= CYCLE_RTOL * moved:
            return acting >= (1.0 - CYCLE_RTOL) * max(one.acting for one in list(earlier)[-period:])
    return False


def _has_no_normal_forces(problem: StepProblem, x: Positions) -> bool:
    """Return whether friction vanishes for the normal forces of the step and at x.

    Energies of contact are not negative, so their forces vanish where they are zero.
    """
    return all(e.friction_gradient(x) is None and e.value(x) == 0.0 for e in problem.energies if has_friction(e))


def _relative_friction_change(problem: StepProblem, following: StepProblem, x: Positions) -> tuple[float, float]:
    """Return the relative change of friction at x (n, 3) between two problems.

    The second result is the largest component [N] before.
    """
    before, after = (
        [energy.friction_gradient(x) for energy in each.energies if has_friction(energy)]
        for each in (problem, following)
    )
    size = max(map(_largest_component, (*before, *after)))
    change = max(
        _largest_component(a if b is None else b) if a is None or b is None else _largest_component(b - a)
        for a, b in zip(before, after, strict=True)
    )
    return change / size if size else 0.0, max(map(_largest_component, before))


def _largest_component(force: Positions | None) -> float:
    """Return the largest component, 0 without a force."""
    return 0.0 if force is None else float(np.abs(force).max(initial=0.0))
