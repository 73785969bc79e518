"""Candidates of the round robin: a solver, the C++ baseline, and the machine itself.

Each is prepared once and then timed repeatedly.
"""

from __future__ import annotations

from collections.abc import Callable
from math import ceil
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any, NamedTuple, Protocol

import numba
from springbench.harness.config.run_options import AUTO
from springbench.harness.config.sweep_config import RunSpec
from springbench.harness.experiments.roofline import stream_probes
from springbench.harness.experiments.roofline.cpp_baseline import CppBaseline
from springbench.harness.experiments.roofline.precision_error import (
    ConvergedProblem,
    compute_precision_error,
    read_precision,
)
from springbench.harness.report.speed.operation_counts import OperationCount, count_operations
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.simulation.stopwatch import PhaseWatch, check_phases, retry_on_mismatch
from springbench.solvers.model.step_problem import Positions, PreparedSolver, StepProblem, StopRule
from springbench.solvers.registry import SOLVER_TABLE, load_target

MIN_PHASE_SECONDS = 0.02
"""Time for which a phase is repeated in each round [s].

The overhead of a clock is then negligible, and a first call with cold caches is one of many.
"""


class CandidateTiming(NamedTuple):
    """Timing of one phase: seconds per call, and other columns of its row."""

    phase: str
    call_seconds: float
    columns: dict[str, Any]


class BenchmarkCandidate(Protocol):
    """Subject of a measurement; `columns` are common to all its rows."""

    run: RunSpec
    columns: dict[str, Any]

    def prepare(self) -> float | None:
        """Prepare, or repeat the preparation; returns its seconds, None if there is nothing to repeat."""
        ...

    def time_phases(self) -> list[CandidateTiming]:
        """Time every phase in one round."""
        ...

    def close(self) -> Positions | None:
        """Release all resources.

        Returns the positions after the last step (n, 3) [m], None if there are none.
        """
        ...


class SolverCandidate:
    """Solver of the registry, which computes the same step each time.

    Candidates that differ only in their number of threads are timed on one factor, in `prepared`, because several large
    factors would not fit into memory.
    """

    def __init__(
        self,
        run: RunSpec,
        scene: Scene,
        problem: StepProblem,
        prepared: dict[str, PreparedSolver],
        converged: ConvergedProblem | None = None,
    ) -> None:
        self.run, self._shared_prepared, self._converged_problem = run, prepared, converged
        self.columns: dict[str, Any] = {}
        self._scene, self._problem = scene, problem
        self._solver = load_target(SOLVER_TABLE[run.solver.name])(**run.solver.parameters)
        self._prepared: PreparedSolver | None = None
        self._positions: Positions | None = None
        self._phase_counts: dict[str, OperationCount] = {}

    @retry_on_mismatch
    def prepare(self) -> float:
        """Prepare the solver and return the wall seconds. Raises Unsupported, NotPositiveDefinite, MemoryError."""
        watch = PhaseWatch(numba.get_num_threads())
        with watch:
            began = perf_counter()
            prepared = self._solver.prepare(self._problem.system)
            seconds = perf_counter() - began
        watch.build_columns("prepare", [seconds])
        if self._prepared is None:
            self._prepared = prepared = self._shared_prepared.setdefault(str(self._solver), prepared)
            counts = self._scene.system.num_vertices, len(self._scene.all_springs.edges)
            self._phase_counts = count_operations(prepared.stats, *counts, read_precision(self.run))
            self.columns = {name: int(value) for name, value in prepared.stats.items()}
            self.columns["solver_description"] = prepared.description
            if self._converged_problem and read_precision(self.run) != "float64":
                self.columns["precision_error"] = compute_precision_error(self._converged_problem, prepared)
        return seconds

    def time_phases(self) -> list[CandidateTiming]:
        """Time a step and the phases of an iteration."""
        prepared = self._prepared
        assert prepared is not None
        readings = [time_phase("step", self._solve_step, self._build_columns("iteration", self.run.max_iterations))]
        for phase, call in check_phases(prepared, self._problem).items():
            readings.append(time_phase(phase, call, self._build_columns(phase, 1)))
        return readings

    def close(self) -> Positions | None:
        """Release the solver; returns the positions of its last step."""
        self._prepared = None
        return self._positions

    def _solve_step(self) -> None:
        assert self._prepared is not None
        tolerance = self.run.rtol
        assert tolerance != AUTO, "the command refuses it: a step alone has no error of its own"
        self._positions = self._prepared.solve(self._problem, StopRule(self.run.max_iterations, tolerance)).positions

    def _build_columns(self, phase: str, num_repeats: int) -> dict[str, Any]:
        done = {"num_iterations": num_repeats}
        if phase not in self._phase_counts:
            return done
        counted = self._phase_counts[phase]
        return done | {
            "bytes_moved": num_repeats * counted.bytes_moved,
            "flops": num_repeats * counted.flop_count,
            "working_set_bytes": counted.working_set_bytes,
        }


class CppCandidate:
    """C++ baseline program, which computes the same step."""

    def __init__(
        self, run: RunSpec, scene: Scene, problem: StepProblem, program: Callable[[], Path], tunables: str
    ) -> None:
        self.run, self.columns = run, {}
        self._scene, self._problem, self._build_program, self._tunables = scene, problem, program, tunables
        self._folder = TemporaryDirectory()
        self._process: CppBaseline | None = None

    def prepare(self) -> float | None:
        """Start the program, once, and return the seconds of its preparation. Raises Unsupported, RunFailed."""
        if self._process:
            return None
        folder = Path(self._folder.name)
        self._process = CppBaseline(
            self._build_program(), self._problem, self._scene.all_springs, folder, self._tunables
        )
        return self._process.prepare_seconds

    def time_phases(self) -> list[CandidateTiming]:
        """Time a step, its local steps and its global steps."""
        running, iterations = self._process, self.run.max_iterations
        assert running is not None
        once = running.time_step_phases(iterations)
        number = _choose_num_repeats(once[0])
        answers = [running.time_step_phases(iterations) for _ in range(number)] if number > 1 else [once]
        step, local, global_ = (sum(column) / len(answers) for column in zip(*answers, strict=True))
        return [
            CandidateTiming("step", step, {"num_iterations": iterations}),
            CandidateTiming("local", local / iterations, {"num_iterations": 1}),
            CandidateTiming("global", global_ / iterations, {"num_iterations": 1}),
        ]

    def close(self) -> Positions | None:
        """End the program and remove its files; returns the positions of its last step."""
        try:
            return self._process.close() if self._process else None
        finally:
            if self._process:
                self._process.kill_process()
            self._folder.cleanup()


class MachineCandidate:
    """Roofline microbenchmarks of the machine for a number of threads."""

    def __init__(self, run: RunSpec) -> None:
        self.run, self.columns = run, {}

    def prepare(self) -> None:
        """Compile the kernels, which is not timed."""
        for probe in stream_probes.build_probes(stream_probes.WORKING_SETS[:1]):
            probe.call()

    def time_phases(self) -> list[CandidateTiming]:
        """Time every kernel once."""
        return [
            time_phase(
                probe.name,
                probe.call,
                {"bytes_moved": probe.bytes_moved, "flops": probe.flops, "working_set_bytes": probe.working_set_bytes},
                0.0,
            )
            for probe in stream_probes.build_probes()
        ]

    def close(self) -> None:
        """Do nothing: no resources to release."""


class RepeatedCall:
    """Timed repetition of a call; `preempted` states whether any repetition was preempted."""

    def __init__(self, call: Callable[[], object]) -> None:
        self._call, self.preempted = call, False

    @retry_on_mismatch
    def __call__(self, num_calls: int) -> float:
        """Return the wall seconds of a number of calls. Raises ClockMismatch."""
        watch = PhaseWatch(numba.get_num_threads())
        with watch:
            began = perf_counter()
            for _ in range(num_calls):
                self._call()
            found = perf_counter() - began
        self.preempted |= watch.build_columns("calls", [found])["preempted"]
        return found


def time_phase(
    phase: str, call: Callable[[], object], columns: dict[str, Any], min_seconds: float = MIN_PHASE_SECONDS
) -> CandidateTiming:
    """Time a phase and return the seconds per call. Raises RunFailed where another clock disagrees.

    Args:
        phase: name of the phase.
        call: what to time.
        columns: further columns of its row.
        min_seconds: time for which to repeat the call [s].
    """
    seconds = RepeatedCall(call)
    return CandidateTiming(
        phase, compute_call_seconds(seconds, min_seconds), columns | {"preempted": seconds.preempted}
    )


def compute_call_seconds(seconds: Callable[[int], float], min_seconds: float = MIN_PHASE_SECONDS) -> float:
    """Return the seconds per call.

    This is one call, or the mean of enough calls to last `min_seconds` after a first one.

    Args:
        seconds: makes a number of calls, and returns their total time [s].
        min_seconds: time for which to repeat the call [s].
    """
    once = seconds(1)
    number = _choose_num_repeats(once, min_seconds)
    return seconds(number) / number if number > 1 else once


def _choose_num_repeats(once: float, min_seconds: float = MIN_PHASE_SECONDS) -> int:
    return ceil(min_seconds / max(once, 1e-9))
