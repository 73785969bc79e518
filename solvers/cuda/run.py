"""What solves on a device share: one stream, events, and copies that are made only where somebody asks.

    begin: upload | launch, launch, ... | positions: download                       all in one stream, in their order

A kernel is launched and not waited for. `positions` copies when it is asked for; a residual is asked for after each
EVERY iterations where one may end a solve. Iterates depend on neither.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from solvers.core.driver import Iterating, Iterative
from solvers.cuda import device, triad
from solvers.cuda.target import cuda
from solvers.device import Course, Event, Marks, Steps
from solvers.kernels.loop import EACH, ITERATIONS, LAST, Limits, verdict
from solvers.problem import Positions, Solution, StepProblem, StopRule, Unsupported

EVERY = 8
"""Iterations from one residual to the next."""

_TRIAD = 2**26
"""Float64 in each array of a triad: many times what caches hold."""

THREADS = 8 if device.simulated() else 128
"""In a block; the simulator's take a thread of the processor each."""


def blocks(threads: int) -> int:
    """How many blocks so many threads take; one at least."""
    return max(1, -(-threads // THREADS))


class Stream:
    """A stream with the arrays that are brought to it, and a clock on it. Device arrays live as long as this does."""

    def __init__(self) -> None:
        self.queue: Any = cuda.stream()

    @property
    def pointer(self) -> int:
        """What other libraries know the stream by; the simulator has none."""
        return 0 if device.simulated() else int(self.queue)

    def upload(self, array: NDArray[Any], dtype: Any = None) -> Any:
        """A copy of a host's array on the device."""
        return cuda.to_device(np.ascontiguousarray(array, dtype), stream=self.queue)

    def put(self, array: NDArray[Any], there: Any) -> None:
        """Copy a host's array to one of the device of the same shape and type."""
        there.copy_to_device(np.ascontiguousarray(array, there.dtype), stream=self.queue)

    def copy(self, array: Any, there: Any) -> None:
        """Copy an array of the device to another of the same shape and type."""
        there.copy_to_device(array, stream=self.queue)

    def empty(self, shape: int | tuple[int, ...], dtype: Any) -> Any:
        """Memory of the device, with whatever is there."""
        return cuda.device_array(shape, dtype, stream=self.queue)

    def zeros(self, shape: int | tuple[int, ...], dtype: Any) -> Any:
        """Zeros on the device."""
        return self.upload(np.zeros(shape, dtype))

    def download(self, there: Any) -> NDArray[Any]:
        """A copy of a device's array; waits for all that was launched."""
        out = there.copy_to_host(stream=self.queue)
        self.wait()
        return out

    def wait(self) -> None:
        """Until all that was launched is done."""
        self.queue.synchronize()

    def mark(self) -> Any:
        """An event here and now on the stream."""
        event = cuda.event()
        event.record(self.queue)
        return event


class DeviceIterating(Iterating):
    """A solve on a device. A method uploads in its `__init__`, between `super().__init__` and `self.uploaded()`."""

    def __init__(self, stream: Stream) -> None:
        self.stream = stream
        self._began = self._up = self._asked = self._down = stream.mark()
        self._copy: Positions | None = None
        self._done = 0

    def begun(self) -> None:
        """A solve begins: what it needs is copied from here on."""
        self._began = self._up = self._asked = self._down = self.stream.mark()
        self._copy, self._done = None, 0

    def uploaded(self) -> None:
        """All that the solve needs is on its way."""
        self._up = self.stream.mark()

    @abstractmethod
    def sweep(self, count: int) -> None:
        """Launch so many iterations, and wait for nothing."""

    @abstractmethod
    def fetch(self) -> Positions:
        """A copy of where it is, (n, 3) [m]."""

    def gauge(self, p: Positions) -> float:
        """The residual [J^(1/2)] at positions, which are where it is; nan of a method that does not minimise."""
        return float("nan")

    @property
    def positions(self) -> Positions:  # pyright: ignore[reportIncompatibleVariableOverride] a copy, when asked for
        """A copy of where it is (n, 3) [m]; the same one until the next iteration."""
        if self._copy is None:
            with device.guarded():
                self._asked = self.stream.mark()
                self._copy = self.fetch()
                self._down = self.stream.mark()
        return self._copy

    def advance(self) -> bool:
        """See Iterating."""
        self.launch(1)
        return True

    def launch(self, count: int) -> None:
        """So many iterations, and forget the copy."""
        with device.guarded():
            self.sweep(count)
        self._copy, self._done = None, self._done + count

    def residual(self) -> float:
        """See Iterating."""
        return self.gauge(self.positions)

    def iterate(self, limits: Limits) -> tuple[int, float, int]:
        """See Iterating; a residual after each EVERY iterations where it may end them."""
        count, found, ended = 0, float("nan"), ITERATIONS
        while count < limits.iterations and ended == ITERATIONS:
            some = limits.iterations - count
            some = min(EVERY - self._done % EVERY, some) if limits.wanted == EACH else some
            self.launch(some)
            count += some
            if limits.wanted == EACH:
                found = self.residual()
                ended = verdict(found, limits)
        if limits.wanted == LAST or (limits.wanted == EACH and count == 0):
            found = self.residual()
        return count, found, ended

    def marks(self) -> Marks | None:
        """Events up to the last copy of positions, which has been waited for; none of the simulator, whose events tell
        nothing."""
        return None if device.simulated() else Marks(self._began, self._up, self._asked, self._down)

    def marks_until(self, done: Any) -> Marks | None:
        """The same where nothing was copied, up to an event that has been waited for."""
        return None if device.simulated() else Marks(self._began, self._up, done, done)


class DeviceIterative(Iterative):
    """A method that is ready on a device, with `columns` for its rows."""

    columns: dict[str, Any]

    def state(self) -> dict[str, float | None]:
        """See Remote."""
        return device.state()

    def triad(self) -> tuple[float, Event, Event] | None:
        """See Remote."""
        with device.guarded():
            return None if device.simulated() else triad.once(_TRIAD)

    def stepping(self, course: Course) -> Steps:
        """See Remote."""
        raise Unsupported("the method takes each step from the host")

    @abstractmethod
    def begin(self, problem: StepProblem, guess: Positions) -> DeviceIterating:
        """See Iterative."""

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        """See Iterative."""
        with device.guarded():
            return super().solve(problem, stop)

    def uncopied(self, problem: StepProblem) -> Iterator[Callable[[], Positions]]:
        """The iterates of `iterates`, each done when it is yielded and copied only where it is called."""
        with device.guarded():
            run = self.begin(problem, problem.first_guess)
            while True:
                run.launch(1)
                run.stream.wait()
                yield lambda: run.positions

    def replay(self, problem: StepProblem, iterations: int) -> tuple[Solution, Marks | None]:
        """See Remote."""
        with device.guarded():
            run = self.begin(problem, problem.first_guess)
            run.launch(iterations)
            p, nan = run.positions, float("nan")
            found = Solution(p, iterations, nan, nan, "iterations", run.velocity, self.residual_of)
            return found, run.marks()
