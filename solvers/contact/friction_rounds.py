"""Friction with the normal forces of the step itself, by a fixed-point iteration around its solves.

    x_0 = argmin E(x; N at the step's start),     x_{k+1} = argmin E(x; N(x_k)),     k + 1 < rounds

Normal forces N, contact points and directions are fixed in a solve, so that friction has a potential (Li et al. 2020,
"Incremental potential contact", section 5). With f(x; N) the gradient of friction, f(x_k; N(x_k)) - f(x_k; N(x_{k-1}))
is what x_k lacks to solve the step with its own normal forces; the rounds end once its largest component is at most
TOLERANCE times that of f, or after `friction_rounds` of the energies. The iteration need not converge: where friction
itself presses contacts together, as a wedge does, or where mu N is so large that a vertex sticks out of the range of
contact in one round and, not pressed there, slides back in the next. Iterates that return to an earlier one repeat
without end, so the rounds end as well, at the iterate of the cycle on which the largest friction acts: the others slide
as if there were little or none. The change that was left is reported, and is then not small.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import NamedTuple, Protocol, TypeGuard, runtime_checkable

import numpy as np

from solvers.problem import Energy, Positions, Prepared, Solution, StepProblem, StopRule, System

ROUNDS = 20
"""Solves of a step at most, where an effect does not say."""

TOLERANCE = 1e-4
"""Of the largest force of friction: a smaller change ends the rounds."""

PERIOD, RETURN = 4, 1e-2
"""Rounds of the longest cycle that is noticed, and how near to an earlier iterate the last one has to be, relative to
its distance from the one before. Iterates that converge by less than 1 % a round would not do so in ROUNDS either."""


@runtime_checkable
class FrictionEnergy(Energy, Protocol):
    """An energy whose friction depends on `Start.pressed`."""

    friction: float
    friction_rounds: int

    def friction_gradient(self, p: Positions) -> Positions | None:
        """The gradient of friction alone [N] at p (n, 3), in a step that has begun; None where it is zero."""
        ...


class FrictionRounds(NamedTuple):
    """How many rounds a step took, and the change of friction that was left, relative to its largest component."""

    rounds: int
    change: float


class FrictionSolve(NamedTuple):
    """A solved step: the problem of the last round with the first guess of the first one, its solution, and the
    iterations of each; None for friction where the scene has none."""

    problem: StepProblem
    solution: Solution
    counts: tuple[int, ...]
    friction: FrictionRounds | None


def solve_with_friction(prepared: Prepared, problem: StepProblem, stop: StopRule) -> FrictionSolve:
    """Solve a step until its friction has the normal forces of the solution; one solve where there is no friction."""
    solution = prepared.solve(problem, stop)
    rounds = _most_rounds(problem.system)
    if not rounds:
        return FrictionSolve(problem, solution, (solution.iterations,), None)
    counts, guess = [solution.iterations], problem.first_guess
    earlier = deque[_Round](maxlen=PERIOD)
    while True:
        x = solution.positions
        following = replace(problem, first_guess=x, start=replace(problem.start, pressed=x))
        change, acting = _friction_change(problem, following, x)
        ended = len(counts) >= rounds or _is_cycle_at_largest(earlier, x, acting)
        if not change > TOLERANCE or ended:  # not a number where the solve diverged
            problem = problem if len(counts) == 1 else replace(problem, first_guess=guess)
            return FrictionSolve(problem, solution, tuple(counts), FrictionRounds(len(counts), change))
        earlier.append(_Round(x, acting))
        problem, solution = following, prepared.solve(following, stop)
        counts.append(solution.iterations)


def has_friction(energy: Energy) -> TypeGuard[FrictionEnergy]:
    """Whether an energy has friction whose normal forces are found in rounds."""
    return getattr(energy, "friction", 0.0) > 0.0 and hasattr(energy, "friction_rounds")


def _most_rounds(system: System) -> int:
    """The largest number of rounds, 0 without friction."""
    return max((energy.friction_rounds for energy in system.energies if has_friction(energy)), default=0)


class _Round(NamedTuple):
    """Where a round ended, (n, 3) [m], and the largest component of the friction that acted there [N]."""

    positions: Positions
    acting: float


def _is_cycle_at_largest(earlier: deque[_Round], x: Positions, acting: float) -> bool:
    """Whether x (n, 3) [m] returns to an earlier iterate than the last, and no iterate since then had more friction."""
    if len(earlier) < 2:
        return False
    moved = _largest(x - earlier[-1].positions)
    for period in range(2, len(earlier) + 1):
        if _largest(x - earlier[-period].positions) <= RETURN * moved:
            return acting >= (1.0 - RETURN) * max(one.acting for one in list(earlier)[-period:])
    return False


def _friction_change(problem: StepProblem, following: StepProblem, x: Positions) -> tuple[float, float]:
    """The change of friction at x (n, 3) [m] from one problem to the next, relative to its largest component there,
    and the largest component [N] in the first one."""
    before, after = (
        [energy.friction_gradient(x) for energy in each.energies if has_friction(energy)]
        for each in (problem, following)
    )
    size = max(map(_largest, (*before, *after)))
    change = max(
        _largest(a if b is None else b) if a is None or b is None else _largest(b - a)
        for a, b in zip(before, after, strict=True)
    )
    return change / size if size else 0.0, max(map(_largest, before))


def _largest(force: Positions | None) -> float:
    """The largest component, 0 without a force."""
    return 0.0 if force is None else float(np.abs(force).max(initial=0.0))
