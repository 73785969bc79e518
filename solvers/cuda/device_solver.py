"""Base classes of device solvers: one stream, events, and copies to the host on demand.

    start: upload | launch, launch, ... | positions: download                       all in one stream, in this order

Kernels are launched asynchronously. `positions` copies on access. The residual is evaluated after each
ITERATIONS_PER_RESIDUAL iterations if it can end a solve. The iterates depend on neither.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.cuda import cuda_device
from springbench.solvers.cuda.cuda_target import DeviceStream, ReusedUploads
from springbench.solvers.cuda.device_step import DeviceStep, UploadedNetwork
from springbench.solvers.iteration.descent_method import ResidualMetric
from springbench.solvers.iteration.device_interface import SolveEvents
from springbench.solvers.iteration.iterative_solver import IterativeSolver, SolverState
from springbench.solvers.model.step_problem import Positions, Solution, StepProblem, StopRule
from springbench.solvers.objective.fixed_objective import FixedObjective
from springbench.solvers.objective.step_objective import StepObjective

ITERATIONS_PER_RESIDUAL = 8
"""Iterations between evaluations of the residual."""


class DeviceSolverState(SolverState):
    """State of a solve on a device, with its own memory, which later solves reuse.

    Attributes:
        uploads: the arrays of its step.
        stream: stream of the copies and kernels.
        order: (n,), the vertex of each row.
        stalled: whether the last iteration moved nothing.
        residual_of_positions: returns the residual [J^(1/2)] at positions; nan for a method that does not minimise.
    """

    def __init__(self, stream: DeviceStream, order: NDArray[np.int64]) -> None:
        self.stream, self.order, self.stalled, self.uploads = stream, order, False, ReusedUploads(stream)
        self.residual_of_positions: Callable[[Positions], float] = lambda p: float("nan")
        self._start_event = self._upload_event = self._kernel_event = self._download_event = stream.record_event()
        self._positions_copy: Positions | None = None
        self._num_iterations = 0

    def mark_start(self) -> None:
        """Mark the start of a solve, to which the following copies belong."""
        self._positions_copy, self._num_iterations, self.stalled, self.velocity = None, 0, False, None
        self.uploads.start_step()
        self._start_event = self.stream.record_event()

    def mark_uploaded(self) -> None:
        """Mark the end of the uploads of a solve."""
        self._upload_event = self._kernel_event = self._download_event = self.stream.record_event()

    @abstractmethod
    def load_step(self, step: DeviceStep) -> None:
        """Start to solve a step that is on the device.

        Its arrays must not change until the solve has ended.
        """

    @abstractmethod
    def launch_iterations(self, num_iterations: int) -> int:
        """Launch iterations; return how many of them moved something."""

    @abstractmethod
    def position_rows(self) -> Any:
        """Return the current positions in rows (n, 3) [m], on the device."""

    def velocity_rows(self) -> Any:
        """Return the final velocity in rows (n, 3) [m/s], on the device.

        None for a method without its own velocity.
        """
        return None

    def _download_by_vertices(self, rows: Any) -> Positions:
        out = np.empty((len(self.order), 3))
        out[self.order] = self.stream.download_array(rows)
        return out

    @property
    def positions(self) -> Positions:  # pyright: ignore[reportIncompatibleVariableOverride] copied on access
        """A copy of the current positions (n, 3) [m], with the velocity; reused until the next iteration."""
        if self._positions_copy is None:
            with cuda_device.guard_device_errors():
                self._kernel_event = self.stream.record_event()
                speeds = self.velocity_rows()
                if speeds is not None:
                    self.velocity = self._download_by_vertices(speeds)
                self._positions_copy = self._download_by_vertices(self.position_rows())
                self._download_event = self.stream.record_event()
        return self._positions_copy

    def step_state(self) -> bool:
        """Do one iteration; return False if round-off prevents any further change."""
        self.run_unchecked(1)
        return not self.stalled

    def run_unchecked(self, num_iterations: int) -> int:
        """Run iterations and invalidate the copy; return how many of them moved something."""
        with cuda_device.guard_device_errors():
            moved = self.launch_iterations(num_iterations)
        self._positions_copy, self._num_iterations, self.stalled = (
            None,
            self._num_iterations + moved,
            moved < num_iterations,
        )
        return moved

    def residual(self) -> float:
        """Return the residual; computed on the host from a copy of the positions."""
        return self.residual_of_positions(self.positions)

    def iterations_until_residual(self) -> int:
        """Return the number of iterations up to the next multiple of ITERATIONS_PER_RESIDUAL."""
        return ITERATIONS_PER_RESIDUAL - self._num_iterations % ITERATIONS_PER_RESIDUAL

    def solve_events(self) -> SolveEvents | None:
        """Events up to the last copy of positions, already synchronised.

        None in the simulator, which has no times.
        """
        return (
            None
            if cuda_device.is_simulated()
            else SolveEvents(self._start_event, self._upload_event, self._kernel_event, self._download_event)
        )


class DeviceSolver(IterativeSolver):
    """A method that is prepared on a device; `device_columns` describe the device in rows."""

    can_leave_saddles: ClassVar[bool] = False  # a timed solve repeats only the number of iterations

    device_columns: dict[str, Any]

    def device_state(self) -> dict[str, float | None]:
        """Return the device's clocks, power and temperature now; None for unavailable values."""
        return cuda_device.read_device_state()

    @abstractmethod
    def allocate_state(self) -> DeviceSolverState:
        """Allocate the memory of a solve."""

    @abstractmethod
    def upload_problem(self, problem: StepProblem, initial_guess: Positions, uploads: ReusedUploads) -> DeviceStep:
        """Upload a step to the device.

        Args:
            problem: the step on the host.
            initial_guess: positions (n, 3) [m] from which the solve starts.
            uploads: device arrays of the last step, which are overwritten.
        """

    @cached_property
    def _finished_states(self) -> list[DeviceSolverState]:
        """States of solves that have ended, with memory and graphs for the next ones."""
        return []

    def init_state(self, problem: StepProblem, initial_guess: Positions) -> DeviceSolverState:
        """Start a solve, in the memory of one that has ended if there is any.

        Args:
            problem: the step, which is uploaded.
            initial_guess: positions (n, 3) [m].

        Raises:
            DeviceFailure: the device has no memory left, or has failed.
        """
        with cuda_device.guard_device_errors():
            run = self._finished_states.pop() if self._finished_states else self.allocate_state()
            run.mark_start()
            step = self.upload_problem(problem, initial_guess, run.uploads)
            run.mark_uploaded()
            run.load_step(step)
            return run

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        """Iterate until the stop rule is met, or until no iteration descends.

        Args:
            problem: the step on the host.
            stop: the criteria that terminate the solve.

        Raises:
            DeviceFailure: the device has no memory left, or has failed.
            Unsupported: the system has length constraints, which the method does not support.
        """
        with cuda_device.guard_device_errors():
            return super().solve(problem, stop)

    def release_state(self, run: SolverState) -> None:
        """Store the state of a solve that has ended for the next one."""
        assert isinstance(run, DeviceSolverState)
        self._finished_states.append(run)

    def iterates_without_copy(self, problem: StepProblem) -> Iterator[Callable[[], Positions]]:
        """Yield a function per iterate that copies it.

        Each iterate is complete when its function is yielded.
        """
        with cuda_device.guard_device_errors():
            run = self.init_state(problem, problem.initial_guess)
            while True:
                run.run_unchecked(1)
                run.stream.synchronise_stream()
                yield lambda: run.positions

    def replay_iterations(self, problem: StepProblem, iterations: int) -> tuple[Solution, SolveEvents | None]:
        """Repeat a solve by its number of iterations, without residuals.

        Args:
            problem: the step on the host; the iterations start at its initial guess.
            iterations: number of iterations.

        Returns:
            The solution, whose residuals are nan, and the events; None in the simulator, which has no times.

        Raises:
            DeviceFailure: the device has no memory left, or has failed.
        """
        with cuda_device.guard_device_errors():
            run = self.init_state(problem, problem.initial_guess)
            run.run_unchecked(iterations)
            p, nan = run.positions, float("nan")
            found = Solution(p, iterations, nan, nan, "max-iter", run.velocity, self.residual_iterate)
            events = run.solve_events()
            self.release_state(run)
            return found, events


class MinimisingSolver(DeviceSolver):
    """A device method that minimises the objective of a network.

    Attributes:
        uploaded_network: the network on the device.
        metric, objective: for residuals, on the host.
        supports_contact: whether the method supports contact and requires the start of a step.
    """

    uploaded_network: UploadedNetwork
    metric: ResidualMetric
    objective: FixedObjective
    supports_contact: ClassVar[bool] = False

    def upload_problem(self, problem: StepProblem, initial_guess: Positions, uploads: ReusedUploads) -> DeviceStep:
        """Upload a step to the device, with its start if the method supports contact.

        Args:
            problem: the step on the host.
            initial_guess: positions (n, 3) [m] from which the solve starts.
            uploads: device arrays of the last step, which are overwritten.
        """
        return self.uploaded_network.upload_step(
            problem, initial_guess, uploads, supports_contact=self.supports_contact
        )

    def init_state(self, problem: StepProblem, initial_guess: Positions) -> DeviceSolverState:
        """Start a solve whose state evaluates residuals of the step.

        Args:
            problem: the step, which is uploaded.
            initial_guess: positions (n, 3) [m].

        Raises:
            DeviceFailure: the device has no memory left, or has failed.
        """
        run = super().init_state(problem, initial_guess)
        run.residual_of_positions = self.residual_of_positions(problem)
        return run

    def residual_of_positions(self, problem: StepProblem) -> Callable[[Positions], float]:
        """Return the residual as a function of positions, for many evaluations in one step."""
        step = StepObjective(self.objective, problem)
        return lambda p: self.metric.residual(step.gradient(step.apply_exact_pins(p)))

    def residual_at(self, problem: StepProblem, p: Positions) -> float:
        """Return the residual [J^(1/2)], computed on the host.

        Args:
            problem: the step.
            p: positions (n, 3) [m], whose exactly pinned vertices count as on their targets.
        """
        return self.residual_of_positions(problem)(p)
