"""What solves on a device share: one stream, events, and copies that are made only where somebody asks.

    begin: upload | launch, launch, ... | positions: download                       all in one stream, in their order

A kernel is launched and not waited for. `positions` copies when it is asked for; a residual is asked for after each
EVERY iterations where one may end a solve. Iterates depend on neither.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from solvers.core.descent import Metric
from solvers.core.driver import Iterating, Iterative
from solvers.core.fixed_objective import Objective
from solvers.core.objective import StepObjective
from solvers.cuda import device
from solvers.cuda.steps import Step, Uploaded
from solvers.cuda.target import Stream
from solvers.device import Marks
from solvers.kernels.loop import EACH, ITERATIONS, LAST, STALLED, Limits, verdict
from solvers.problem import Positions, Solution, StepProblem, StopRule

EVERY = 8
"""Iterations from one residual to the next."""


class DeviceIterating(Iterating):
    """A solve on a device, with memory of its own. order: the vertex of each row (n,); stalled: whether the last
    iteration moved nothing; gauge: tells the residual [J^(1/2)] at positions, nan of a method that does not minimise.
    """

    def __init__(self, stream: Stream, order: NDArray[np.int64]) -> None:
        self.stream, self.order, self.stalled = stream, order, False
        self.gauge: Callable[[Positions], float] = lambda p: float("nan")
        self._began = self._up = self._asked = self._down = stream.mark()
        self._copy: Positions | None = None
        self._done = 0

    def begun(self) -> None:
        """A solve begins: what it needs is copied from here on."""
        self._began = self.stream.mark()

    def uploaded(self) -> None:
        """All that the solve needs is on its way."""
        self._up = self._asked = self._down = self.stream.mark()

    @abstractmethod
    def take(self, step: Step) -> None:
        """Begin to solve a step, which is on the device and stays as it is until the solve has ended."""

    @abstractmethod
    def sweep(self, count: int) -> int:
        """Launch so many iterations; how many moved something."""

    @abstractmethod
    def settled(self) -> Any:
        """Where it is, in rows (n, 3) [m], on the device."""

    def speeds(self) -> Any:
        """The velocity at the step's end, in rows (n, 3) [m/s], on the device; None of a method that keeps none."""
        return None

    def _by_vertices(self, rows: Any) -> Positions:
        out = np.empty((len(self.order), 3))
        out[self.order] = self.stream.download(rows)
        return out

    @property
    def positions(self) -> Positions:  # pyright: ignore[reportIncompatibleVariableOverride] a copy, when asked for
        """A copy of where it is (n, 3) [m], with its velocity; the same one until the next iteration."""
        if self._copy is None:
            with device.guarded():
                self._asked = self.stream.mark()
                speeds = self.speeds()
                if speeds is not None:
                    self.velocity = self._by_vertices(speeds)
                self._copy = self._by_vertices(self.settled())
                self._down = self.stream.mark()
        return self._copy

    def advance(self) -> bool:
        """See Iterating."""
        self.launch(1)
        return not self.stalled

    def launch(self, count: int) -> int:
        """So many iterations, and forget the copy; how many moved something."""
        with device.guarded():
            moved = self.sweep(count)
        self._copy, self._done, self.stalled = None, self._done + moved, moved < count
        return moved

    def residual(self) -> float:
        """See Iterating; on the host, at a copy."""
        return self.gauge(self.positions)

    def iterate(self, limits: Limits) -> tuple[int, float, int]:
        """See Iterating; a residual after each EVERY iterations where it may end them."""
        count, found, ended = 0, float("nan"), ITERATIONS
        while count < limits.iterations and ended == ITERATIONS:
            some = limits.iterations - count
            some = min(EVERY - self._done % EVERY, some) if limits.wanted == EACH else some
            count += self.launch(some)
            if limits.wanted == EACH:
                found = self.residual()
                ended = verdict(found, limits)
            if ended == ITERATIONS and self.stalled:
                ended = STALLED
        if limits.wanted == LAST or (limits.wanted == EACH and count == 0):
            found = self.residual()
        return count, found, ended

    def marks(self) -> Marks | None:
        """Events up to the last copy of positions, which has been waited for; none of the simulator, whose events tell
        nothing."""
        return None if device.simulated() else Marks(self._began, self._up, self._asked, self._down)


class DeviceIterative(Iterative):
    """A method that is ready on a device, with `columns` for its rows."""

    columns: dict[str, Any]

    def state(self) -> dict[str, float | None]:
        """See Remote."""
        return device.state()

    @abstractmethod
    def iterating(self) -> DeviceIterating:
        """Memory for a solve."""

    @abstractmethod
    def stated(self, problem: StepProblem, guess: Positions) -> Step:
        """A step on the device, from a first guess (n, 3) [m]."""

    def begin(self, problem: StepProblem, guess: Positions) -> DeviceIterating:
        """See Iterative."""
        with device.guarded():
            run = self.iterating()
            run.begun()
            step = self.stated(problem, guess)
            run.uploaded()
            run.take(step)
            return run

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


class Minimising(DeviceIterative):
    """A method whose rows are those of a network. uploaded: that; metric, objective: on the host, of residuals;
    touches: whether it knows contact, and so asks for where a step starts."""

    uploaded: Uploaded
    metric: Metric
    objective: Objective
    touches: ClassVar[bool] = False

    def stated(self, problem: StepProblem, guess: Positions) -> Step:
        """See DeviceIterative."""
        return self.uploaded.step(problem, guess, touches=self.touches)

    def begin(self, problem: StepProblem, guess: Positions) -> DeviceIterating:
        """See Iterative."""
        run = super().begin(problem, guess)
        run.gauge = self.gauge(problem)
        return run

    def gauge(self, problem: StepProblem) -> Callable[[Positions], float]:
        """See Iterative."""
        step = StepObjective(self.objective, problem)
        return lambda p: self.metric.residual(step.gradient(step.placed(p)))

    def residual_at(self, problem: StepProblem, p: Positions) -> float:
        """See Iterative."""
        return self.gauge(problem)(p)
