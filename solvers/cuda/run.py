"""Base classes of device solvers: one stream, events, and copies to the host only on demand.

    start: upload | launch, launch, ... | positions: download                       all in one stream, in their order

Kernels are launched asynchronously. `positions` copies on access. The residual is evaluated after each
EVERY iterations if it can end a solve. The iterates depend on neither.
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
"""Iterations between evaluations of the residual."""


class DeviceIterating(Iterating):
    """State of a solve on a device, with its own memory.

    Attributes:
        row_vertices: (n,), the vertex of each row.
        stalled: whether the last iteration moved nothing.
        gauge: returns the residual [J^(1/2)] at positions; nan for a method that does not minimise.
    """

    def __init__(self, stream: Stream, order: NDArray[np.int64]) -> None:
        self.stream, self.order, self.stalled = stream, order, False
        self.gauge: Callable[[Positions], float] = lambda p: float("nan")
        self._began = self._up = self._asked = self._down = stream.mark()
        self._copy: Positions | None = None
        self._done = 0

    def begun(self) -> None:
        """Mark the start of a solve: the following copies belong to it."""
        self._began = self.stream.mark()

    def uploaded(self) -> None:
        """Mark the end of the uploads of a solve."""
        self._up = self._asked = self._down = self.stream.mark()

    @abstractmethod
    def take(self, step: Step) -> None:
        """Start to solve a step that is on the device.

        Its arrays must not change until the solve has ended.
        """

    @abstractmethod
    def sweep(self, count: int) -> int:
        """Launch iterations; return how many of them moved something."""

    @abstractmethod
    def settled(self) -> Any:
        """Return the current positions in rows (n, 3) [m], on the device."""

    def speeds(self) -> Any:
        """Return the final velocity in rows (n, 3) [m/s], on the device.

        None for a method without its own velocity.
        """
        return None

    def _by_vertices(self, rows: Any) -> Positions:
        out = np.empty((len(self.order), 3))
        out[self.order] = self.stream.download(rows)
        return out

    @property
    def positions(self) -> Positions:  # pyright: ignore[reportIncompatibleVariableOverride] a copy, when asked for
        """A copy of the current positions (n, 3) [m], with the velocity; reused until the next iteration."""
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
        """Do one iteration; return False if round-off prevents any further change."""
        self.launch(1)
        return not self.stalled

    def launch(self, count: int) -> int:
        """Run iterations and invalidate the copy; return how many of them moved something."""
        with device.guarded():
            moved = self.sweep(count)
        self._copy, self._done, self.stalled = None, self._done + moved, moved < count
        return moved

    def residual(self) -> float:
        """Return the residual; computed on the host from a copy of the positions."""
        return self.gauge(self.positions)

    def iterate(self, limits: Limits) -> tuple[int, float, int]:
        """Run iterations within the limits; evaluate the residual at intervals if it can end the solve."""
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
        """Events up to the last copy of positions, already synchronised.

        None in the simulator, which has no times.
        """
        return None if device.simulated() else Marks(self._began, self._up, self._asked, self._down)


class DeviceIterative(Iterative):
    """A method that is prepared on a device, with the device `columns` of its rows."""

    columns: dict[str, Any]

    def state(self) -> dict[str, float | None]:
        """Return the device's clocks, power and temperature now; None for unavailable values."""
        return device.state()

    @abstractmethod
    def iterating(self) -> DeviceIterating:
        """Allocate the memory of a solve."""

    @abstractmethod
    def stated(self, problem: StepProblem, guess: Positions) -> Step:
        """Upload a step to the device, with an initial guess (n, 3) [m]."""

    def begin(self, problem: StepProblem, guess: Positions) -> DeviceIterating:
        """Start a solve from an initial guess (n, 3) [m]."""
        with device.guarded():
            run = self.iterating()
            run.begun()
            step = self.stated(problem, guess)
            run.uploaded()
            run.take(step)
            return run

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        """Iterate until the stop rule is met, or until no iteration descends."""
        with device.guarded():
            return super().solve(problem, stop)

    def uncopied(self, problem: StepProblem) -> Iterator[Callable[[], Positions]]:
        """Yield a function per iterate that copies it; each iterate is complete when it is yielded."""
        with device.guarded():
            run = self.begin(problem, problem.first_guess)
            while True:
                run.launch(1)
                run.stream.wait()
                yield lambda: run.positions

    def replay(self, problem: StepProblem, iterations: int) -> tuple[Solution, Marks | None]:
        """Repeat iterations without residuals; return the solution, and the events or None without a clock."""
        with device.guarded():
            run = self.begin(problem, problem.first_guess)
            run.launch(iterations)
            p, nan = run.positions, float("nan")
            found = Solution(p, iterations, nan, nan, "iterations", run.velocity, self.residual_of)
            return found, run.marks()


class Minimising(DeviceIterative):
    """A device method that minimises the objective of a network.

    Attributes:
        uploaded: the network on the device.
        metric, objective: for residuals, on the host.
        touches: whether the method supports contact and requires the start of a step.
    """

    uploaded: Uploaded
    metric: Metric
    objective: Objective
    touches: ClassVar[bool] = False

    def stated(self, problem: StepProblem, guess: Positions) -> Step:
        """Upload a step to the device, with an initial guess (n, 3) [m]."""
        return self.uploaded.step(problem, guess, touches=self.touches)

    def begin(self, problem: StepProblem, guess: Positions) -> DeviceIterating:
        """Start a solve from an initial guess (n, 3) [m]."""
        run = super().begin(problem, guess)
        run.gauge = self.gauge(problem)
        return run

    def gauge(self, problem: StepProblem) -> Callable[[Positions], float]:
        """Return the residual as a function of positions, for many evaluations in one step."""
        step = StepObjective(self.objective, problem)
        return lambda p: self.metric.residual(step.gradient(step.placed(p)))

    def residual_at(self, problem: StepProblem, p: Positions) -> float:
        """Return the residual [J^(1/2)] at positions p (n, 3) [m]."""
        return self.gauge(problem)(p)
