"""Wrapper of a prepared solver that delegates everything but its solves."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from solvers.problem import Positions, Prepared, StepProblem


class Passing:
    """Delegates the members of a prepared solver, except `solve`, which subclasses define."""

    def __init__(self, prepared: Prepared) -> None:
        self._prepared = prepared

    @property
    def choice(self) -> str:
        """The solver's description."""
        return self._prepared.choice

    @property
    def facts(self) -> dict[str, float]:
        """The solver's statistics."""
        return self._prepared.facts

    def iterates(self, problem: StepProblem) -> Iterator[Positions]:
        """Return the solver's iterates."""
        return self._prepared.iterates(problem)

    def phases(self, problem: StepProblem) -> dict[str, Callable[[], object]]:
        """Return the solver's phases of an iteration."""
        return self._prepared.phases(problem)

    def residual_at(self, problem: StepProblem, p: Positions) -> float:
        """Return the solver's residual at p."""
        return self._prepared.residual_at(problem, p)
