"""Time stepping with a solver on a device.

The host builds each step problem; its data is copied to the device, and the solution back. A timed step repeats the
number of iterations of the same step in an untimed pass, without computing residuals. The passes are bitwise identical:
residuals terminate the untimed solves, but change nothing else.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from springbench.harness.simulation.solver_contract import DelegatingSolver
from springbench.harness.simulation.time_loop import AlternatingSolver, SimulationStep
from springbench.solvers.iteration.device_interface import PreparedDeviceSolver, SolveEvents
from springbench.solvers.model.step_problem import PreparedSolver, Solution, StepProblem, StopRule


class DevicePreparedSolver(DelegatingSolver):
    """A prepared solver on a device that records the number of iterations of each solve."""

    def __init__(self, prepared: PreparedSolver, usual: PreparedDeviceSolver) -> None:
        """Wrap a prepared solver.

        Args:
            prepared: prepared solver of the scene, possibly an `AlternatingSolver` of two systems.
            usual: the device solver in it that is prepared for the scene's own system.
        """
        super().__init__(prepared)
        self.usual = usual
        self._counts = list[int]()

    def record_counts(self, step: SimulationStep) -> None:
        """Record the iteration counts of a step; steps are added in order."""
        self._counts += step.iteration_counts

    def build_replay(self) -> ReplayingDeviceSolver:
        """Return a solver that repeats the same iteration counts from the first step on."""
        return ReplayingDeviceSolver(self._prepared, self._counts)

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        """Return the solver's solution.

        Args:
            problem: step problem on the host.
            stop: stop rule of the solve.
        """
        return self._prepared.solve(problem, stop)


class ReplayingDeviceSolver(DelegatingSolver):
    """A prepared solver on a device with a given number of iterations in each solve."""

    def __init__(self, prepared: PreparedSolver, counts: Sequence[int]) -> None:
        super().__init__(prepared)
        self._left, self._timings = iter(counts), dict[str, float]()

    def collect_timings(self) -> dict[str, float | None]:
        """Return the timing columns since the last call: times [s] by events on the device."""
        found, self._timings = self._timings, {}
        return {**found}

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        """Return the solution after the given number of iterations, without a residual.

        Args:
            problem: step problem on the host, the next one in the order of the recorded counts.
            stop: not used; the recorded count ends the solve.
        """
        one: Any = (
            self._prepared.select_solver(problem) if isinstance(self._prepared, AlternatingSolver) else self._prepared
        )
        found, marks = one.replay_iterations(problem, next(self._left))
        for name, value in compute_event_seconds(marks).items():
            self._timings[name] = self._timings.get(name, 0.0) + value
        return found


def wrap_device_solver(prepared: PreparedSolver) -> DevicePreparedSolver | None:
    """Wrap a prepared solver for replay on its device; None for one on the processor."""
    usual = prepared.usual if isinstance(prepared, AlternatingSolver) else prepared
    return DevicePreparedSolver(prepared, usual) if isinstance(usual, PreparedDeviceSolver) else None


def compute_event_seconds(marks: SolveEvents | None) -> dict[str, float]:
    """Compute the times [s] of a step's kernels and transfers by events on the stream.

    Args:
        marks: events of the step's solve, None in the simulator.

    Returns:
        The columns by name; empty without events.
    """
    if marks is None:
        return {}
    copies = marks.start_event.elapsed_time(marks.upload_event) + marks.kernel_event.elapsed_time(
        marks.download_event
    )  # in milliseconds
    return {
        "kernel_seconds": 1e-3 * marks.upload_event.elapsed_time(marks.kernel_event),
        "transfer_seconds": 1e-3 * copies,
    }


def build_device_columns(prepared: PreparedSolver) -> dict[str, Any]:
    """Build the device columns of a prepared solver; empty for one on the processor.

    The solver may be wrapped.
    """
    usual = prepared.usual if isinstance(prepared, (AlternatingSolver, DevicePreparedSolver)) else prepared
    return dict(usual.device_columns) if isinstance(usual, PreparedDeviceSolver) else {}
