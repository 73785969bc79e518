"""Steps of a solver on a device: a host states each, and what it brings and leaves is copied.

A timed step does the iterations that the same step took in an untimed pass, and asks for no residual. The passes are
the same to the last bit: residuals, by which the untimed ones end, change nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from harness.simulation.passing import Passing
from harness.simulation.step import Step, Turns
from solvers.device import Marks, Remote
from solvers.problem import Prepared, Solution, StepProblem, StopRule


class OnDevice(Passing):
    """A prepared solver on a device, and how many iterations each of its solves took."""

    def __init__(self, prepared: Prepared, usual: Remote) -> None:
        """usual: the solver of the scene's own system, of two."""
        super().__init__(prepared)
        self.usual = usual
        self._counts = list[int]()

    def keep(self, step: Step) -> None:
        """Take note of what a step took; steps come in their order."""
        self._counts += step.counts

    def again(self) -> Replayed:
        """The same iterations, from the first step on."""
        return Replayed(self._prepared, self._counts)

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        """The solver's answer."""
        return self._prepared.solve(problem, stop)


class Replayed(Passing):
    """A prepared solver on a device, which does as many iterations in each solve as it is given."""

    def __init__(self, prepared: Prepared, counts: Sequence[int]) -> None:
        super().__init__(prepared)
        self._left, self._told = iter(counts), dict[str, float]()

    def told(self) -> dict[str, float | None]:
        """Columns of what was solved since the last call: seconds by events on the device."""
        found, self._told = self._told, {}
        return {**found}

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        """The solution after the given iterations, without a residual."""
        one: Any = self._prepared.of(problem) if isinstance(self._prepared, Turns) else self._prepared
        found, marks = one.replay(problem, next(self._left))
        for name, value in seconds(marks).items():
            self._told[name] = self._told.get(name, 0.0) + value
        return found


def on_device(prepared: Prepared) -> OnDevice | None:
    """A prepared solver whose timed steps are replayed on its device; None of one that computes on the processor."""
    usual = prepared.usual if isinstance(prepared, Turns) else prepared
    return OnDevice(prepared, usual) if isinstance(usual, Remote) else None


def seconds(marks: Marks | None) -> dict[str, float]:
    """Columns of a step by events on the stream: of kernels, and of transfers; none of a device without a clock."""
    if marks is None:
        return {}
    copies = marks.began.elapsed_time(marks.up) + marks.done.elapsed_time(marks.down)  # in milliseconds
    return {"kernel_seconds": 1e-3 * marks.up.elapsed_time(marks.done), "transfer_seconds": 1e-3 * copies}


def columns(prepared: Prepared) -> dict[str, Any]:
    """What rows tell of a prepared solver's device; nothing of one on the processor."""
    return dict(prepared.usual.columns) if isinstance(prepared, OnDevice) else {}
