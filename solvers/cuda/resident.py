"""Methods that take a step from where it is on the device, from a host or from where the last one ended there.

A host's problem is copied to the device as a `Step`; steps that follow each other there (`solvers.cuda.stepping`) are
written by a kernel. A method does not know which it has.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from solvers.cuda import device
from solvers.cuda.run import DeviceIterating, DeviceIterative, Stream
from solvers.cuda.stepping import Stepping, Unjudged
from solvers.cuda.steps import Step, Uploaded
from solvers.device import Course
from solvers.problem import Positions, StepProblem, System

AT_ONCE = 2
"""Solves that are on the device: that of the steps, and one that tells a residual elsewhere."""


class ResidentIterating(DeviceIterating):
    """A solve on a device, of one step after the other; its memory is made once. order, vertex: of each row, on the
    host and on the device (n,)."""

    def __init__(self, stream: Stream, order: NDArray[np.int64], vertex: Any) -> None:
        super().__init__(stream)
        self.order, self.vertex = order, vertex

    @abstractmethod
    def take(self, step: Step) -> None:
        """Begin to solve a step, which is on the device and stays as it is until the solve has ended."""

    @abstractmethod
    def settled(self) -> Any:
        """Where it is, in rows (n, 3) [m], on the device."""

    def speeds(self) -> Any:
        """The velocity at the step's end, in rows (n, 3) [m/s], on the device; None of a method that keeps none."""
        return None

    def fetch(self) -> Positions:
        """See DeviceIterating; a velocity of its own comes with it."""
        speeds = self.speeds()
        if speeds is not None:
            self.velocity = self._by_vertices(speeds)
        return self._by_vertices(self.settled())

    def _by_vertices(self, rows: Any) -> Positions:
        out = np.empty((len(self.order), 3))
        out[self.order] = self.stream.download(rows)
        return out


class Resident(DeviceIterative):
    """A method that is ready on a device. own: whether it integrates a step by itself, so that drag on vertices is a
    force to it, and it has a velocity of its own."""

    own: ClassVar[bool] = False

    system: System
    stream: Stream

    @abstractmethod
    def iterating(self) -> ResidentIterating:
        """Memory for solves, one after the other."""

    @abstractmethod
    def stated(self, problem: StepProblem, guess: Positions) -> Step:
        """A host's problem on the device, from a first guess (n, 3) [m]."""

    def begin(self, problem: StepProblem, guess: Positions) -> ResidentIterating:
        """See Iterative; the problem is a host's."""
        with device.guarded():
            run = self.iterating()
            run.begun()
            step = self.stated(problem, guess)
            run.uploaded()
            run.take(step)
            return run

    def stepping(self, course: Course) -> Stepping:
        """See Remote. Raises Unsupported with what has to be computed by the host before each step."""
        return Unjudged(self, course) if self.residual_of == "none" else Stepping(self, course)


class MinimisingIterating(ResidentIterating):
    """A solve in the rows of a network (`of`)."""

    def __init__(self, of: Uploaded) -> None:
        super().__init__(of.stream, of.network.order, of.places.vertex)
        self.of = of


class Minimising(Resident):
    """One whose rows are those of a network. uploaded: that; touches: whether it knows contact, and so asks for where a
    step starts."""

    uploaded: Uploaded
    touches: ClassVar[bool] = False

    @property
    def stream(self) -> Stream:  # pyright: ignore[reportIncompatibleVariableOverride] the network's
        """See Resident."""
        return self.uploaded.stream

    def stated(self, problem: StepProblem, guess: Positions) -> Step:
        """See Resident."""
        return self.uploaded.step(problem, guess, touches=self.touches)
