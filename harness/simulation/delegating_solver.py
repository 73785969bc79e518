"""Wrapper of a prepared solver that delegates everything but its solves."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from springbench.solvers.model.step_problem import Positions, PreparedSolver, StepProblem


class DelegatingSolver:
    """Delegates the members of a prepared solver, except `solve`, which subclasses define."""

    def __init__(self, prepared: PreparedSolver) -> None:
        self._prepared = prepared

    @property
    def description(self) -> str:
        """The solver's description."""
        return self._prepared.description

    @property
    def stats(self) -> dict[str, float]:
        """The solver's statistics."""
        return self._prepared.stats

    @property
    def has_inner_solves(self) -> bool:
        """Whether the solver iterates within the frames that it integrates itself."""
        return getattr(self._prepared, "has_inner_solves", False)

    def iterates(self, problem: StepProblem) -> Iterator[Positions]:
        """Return the solver's iterates."""
        return self._prepared.iterates(problem)

    def iteration_phases(self, problem: StepProblem) -> dict[str, Callable[[], object]]:
        """Return the solver's phases of an iteration."""
        return self._prepared.iteration_phases(problem)

    def residual_at(self, problem: StepProblem, p: Positions) -> float:
        """Return the solver's residual at p."""
        return self._prepared.residual_at(problem, p)
