"""What stands around a prepared solver and passes on all but its solves."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from solvers.problem import Positions, Prepared, StepProblem


class Passing:
    """A prepared solver's members, but for `solve`, which whoever inherits this has a word to say on."""

    def __init__(self, prepared: Prepared) -> None:
        self._prepared = prepared

    @property
    def choice(self) -> str:
        """The solver's."""
        return self._prepared.choice

    @property
    def facts(self) -> dict[str, float]:
        """The solver's."""
        return self._prepared.facts

    def iterates(self, problem: StepProblem) -> Iterator[Positions]:
        """The solver's."""
        return self._prepared.iterates(problem)

    def phases(self, problem: StepProblem) -> dict[str, Callable[[], object]]:
        """The solver's."""
        return self._prepared.phases(problem)

    def residual_at(self, problem: StepProblem, p: Positions) -> float:
        """The solver's."""
        return self._prepared.residual_at(problem, p)
