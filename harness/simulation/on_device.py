"""Time stepping with a solver on a device.

The host builds each step problem; its data is copied to the device, and the solution back. A timed step repeats the
number of iterations of the same step in an untimed pass, without computing residuals. The passes are bitwise identical:
residuals terminate the untimed solves, but change nothing else.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from harness.simulation.passing import Passing
from harness.simulation.step import Step, Turns
from solvers.device import Marks, Remote
from solvers.problem import Prepared, Solution, StepProblem, StopRule


class OnDevice(Passing):
    """A prepared solver on a device that records the number of iterations of each solve."""

    def __init__(self, prepared: Prepared, usual: Remote) -> None:
        """Wrap a prepared solver; `usual` is the one of the scene's own system, of two."""
        super().__init__(prepared)
        self.usual = usual
        self._counts = list[int]()

    def keep(self, step: Step) -> None:
        """Record the iteration counts of a step; steps are added in order."""
        self._counts += step.counts

    def again(self) -> Replayed:
        """Return a solver that repeats the same iteration counts from the first step on."""
        return Replayed(self._prepared, self._counts)

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        """Return the solver's solution."""
        return self._prepared.solve(problem, stop)


class Replayed(Passing):
    """A prepared solver on a device with a given number of iterations in each solve."""

    def __init__(self, prepared: Prepared, counts: Sequence[int]) -> None:
        super().__init__(prepared)
        self._left, self._told = iter(counts), dict[str, float]()

    def told(self) -> dict[str, float | None]:
        """Return the timing columns since the last call: times [s] by events on the device."""
        found, self._told = self._told, {}
        return {**found}

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        """Return the solution after the given number of iterations, without a residual."""
        one: Any = self._prepared.of(problem) if isinstance(self._prepared, Turns) else self._prepared
        found, marks = one.replay(problem, next(self._left))
        for name, value in seconds(marks).items():
            self._told[name] = self._told.get(name, 0.0) + value
        return found


def on_device(prepared: Prepared) -> OnDevice | None:
    """Wrap a prepared solver for replay on its device; None on the processor."""
    usual = prepared.usual if isinstance(prepared, Turns) else prepared
    return OnDevice(prepared, usual) if isinstance(usual, Remote) else None


def seconds(marks: Marks | None) -> dict[str, float]:
    """Compute the times [s] of a step's kernels and transfers by events on the stream.

    Returns: columns; empty without events.
    """
    if marks is None:
        return {}
    copies = marks.began.elapsed_time(marks.up) + marks.done.elapsed_time(marks.down)  # in milliseconds
    return {"kernel_seconds": 1e-3 * marks.up.elapsed_time(marks.done), "transfer_seconds": 1e-3 * copies}


def columns(prepared: Prepared) -> dict[str, Any]:
    """Build the device columns of a prepared solver; empty for one on the processor."""
    return dict(prepared.usual.columns) if isinstance(prepared, OnDevice) else {}
