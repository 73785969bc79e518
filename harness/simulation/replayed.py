"""Timed steps of a solver on a device: the iterations that the step took before, and nothing that tells when to stop.

Where a residual ends a step, it is computed from positions that are copied from the device. That is done in the passes
that are not timed; a timed step does as many iterations as they found, which are the same to the last bit.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from harness.simulation.passing import Passing
from harness.simulation.step import Step, Turns
from solvers.device import Remote
from solvers.problem import Prepared, Solution, StepProblem, StopRule


def is_remote(prepared: Prepared) -> bool:
    """Whether a prepared solver computes on a device."""
    return isinstance(prepared.usual if isinstance(prepared, Turns) else prepared, Remote)


class Replayed(Passing):
    """A prepared solver on a device, and how many iterations each of its solves takes."""

    def __init__(self, prepared: Prepared) -> None:
        super().__init__(prepared)
        self._counts, self._left = list[int](), iter(list[int]())
        self._told = dict[str, float]()

    def keep(self, step: Step) -> None:
        """Take note of what a step took; steps come in their order."""
        self._counts += [solution.iterations for _, solution in step.stages]

    def again(self) -> Replayed:
        """The same from the first step on."""
        self._left: Iterator[int] = iter(list(self._counts))
        return self

    def told(self) -> dict[str, float]:
        """Columns of what was solved since this was last asked: seconds by events on the device."""
        found, self._told = self._told, {}
        return found

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        """So many iterations as before."""
        usual: Any = self._prepared.of(problem) if isinstance(self._prepared, Turns) else self._prepared
        found, seconds = usual.replay(problem, next(self._left))
        for name, value in seconds.items():
            self._told[name] = self._told.get(name, 0.0) + value
        return found
