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

from harness.config.options import AUTO
from harness.config.sweep import RunSpec
from harness.experiments.speed import limits
from harness.experiments.speed.rest import Rest, apart, precision
from harness.experiments.speed.yardstick import Yardstick
from harness.report.speed.counts import Counted, count
from harness.scenes.bind import Scene
from harness.simulation.clock import Watch, measured_again, working
from solvers.problem import Positions, Prepared, StepProblem, StopRule
from solvers.registry import EVERY, load

LEAST = 0.02
"""Time for which a phase is repeated in each round [s].

The overhead of a clock is then negligible, and a first call with cold caches is one of many.
"""


class Reading(NamedTuple):
    """Timing of one phase: seconds per call, and other columns of its row."""

    phase: str
    seconds: float
    columns: dict[str, Any]


class Candidate(Protocol):
    """Subject of a measurement; `columns` are common to all its rows."""

    run: RunSpec
    columns: dict[str, Any]

    def prepare(self) -> float | None:
        """Prepare, or repeat the preparation; returns its seconds, None if there is nothing to repeat."""
        ...

    def turn(self) -> list[Reading]:
        """Time every phase once."""
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
        self, run: RunSpec, scene: Scene, problem: StepProblem, prepared: dict[str, Prepared], rest: Rest | None = None
    ) -> None:
        self.run, self._shared, self._rest = run, prepared, rest
        self.columns: dict[str, Any] = {}
        self._scene, self._problem = scene, problem
        self._solver = load(EVERY[run.solver.name])(**run.solver.parameters)
        self._prepared: Prepared | None = None
        self._positions: Positions | None = None
        self._work: dict[str, Counted] = {}

    @measured_again
    def prepare(self) -> float:
        """Prepare the solver and return the wall seconds. Raises Unsupported, NotPositiveDefinite, MemoryError."""
        watch = Watch(numba.get_num_threads())
        with watch:
            began = perf_counter()
            prepared = self._solver.prepare(self._scene.system)
            seconds = perf_counter() - began
        watch.columns("prepare", [seconds])
        if self._prepared is None:
            self._prepared = prepared = self._shared.setdefault(str(self._solver), prepared)
            counts = self._scene.system.vertices, len(self._scene.springs.edges)
            self._work = count(prepared.facts, *counts, precision(self.run))
            self.columns = {name: int(value) for name, value in prepared.facts.items()}
            self.columns["choice"] = prepared.choice
            if self._rest and precision(self.run) != "float64":
                self.columns["apart"] = apart(self._rest, prepared)
        return seconds

    def turn(self) -> list[Reading]:
        """Time a step and the phases of an iteration."""
        prepared = self._prepared
        assert prepared is not None
        readings = [reading("step", self._step, self._columns("iteration", self.run.iterations))]
        for phase, call in working(prepared, self._problem).items():
            readings.append(reading(phase, call, self._columns(phase, 1)))
        return readings

    def close(self) -> Positions | None:
        """Release the solver; returns the positions of its last step."""
        self._prepared = None
        return self._positions

    def _step(self) -> None:
        assert self._prepared is not None
        tolerance = self.run.tolerance
        assert tolerance != AUTO, "the command refuses it: a step alone has no error of its own"
        self._positions = self._prepared.solve(self._problem, StopRule(self.run.iterations, tolerance)).positions

    def _columns(self, phase: str, times: int) -> dict[str, Any]:
        done = {"iterations": times}
        if phase not in self._work:
            return done
        counted = self._work[phase]
        return done | {
            "bytes": times * counted.bytes,
            "flops": times * counted.flops,
            "working_set": counted.working_set,
        }


class YardstickCandidate:
    """C++ baseline program, which computes the same step."""

    def __init__(
        self, run: RunSpec, scene: Scene, problem: StepProblem, program: Callable[[], Path], tunables: str
    ) -> None:
        self.run, self.columns = run, {}
        self._scene, self._problem, self._program, self._tunables = scene, problem, program, tunables
        self._folder = TemporaryDirectory()
        self._running: Yardstick | None = None

    def prepare(self) -> float | None:
        """Start the program, once, and return the seconds of its preparation. Raises Unsupported, RunFailed."""
        if self._running:
            return None
        folder = Path(self._folder.name)
        self._running = Yardstick(self._program(), self._problem, self._scene.springs, folder, self._tunables)
        return self._running.prepare_seconds

    def turn(self) -> list[Reading]:
        """Time a step, its local steps and its global steps."""
        running, iterations = self._running, self.run.iterations
        assert running is not None
        once = running.step(iterations)
        number = _repeats(once[0])
        answers = [running.step(iterations) for _ in range(number)] if number > 1 else [once]
        step, local, global_ = (sum(column) / len(answers) for column in zip(*answers, strict=True))
        return [
            Reading("step", step, {"iterations": iterations}),
            Reading("local", local / iterations, {"iterations": 1}),
            Reading("global", global_ / iterations, {"iterations": 1}),
        ]

    def close(self) -> Positions | None:
        """End the program and remove its files; returns the positions of its last step."""
        try:
            return self._running.close() if self._running else None
        finally:
            if self._running:
                self._running.kill()
            self._folder.cleanup()


class MachineCandidate:
    """Roofline microbenchmarks of the machine for a number of threads."""

    def __init__(self, run: RunSpec) -> None:
        self.run, self.columns = run, {}

    def prepare(self) -> None:
        """Compile the kernels, which is not timed."""
        for probe in limits.probes(limits.WORKING_SETS[:1]):
            probe.call()

    def turn(self) -> list[Reading]:
        """Time every kernel once."""
        return [
            reading(
                probe.name,
                probe.call,
                {"bytes": probe.bytes, "flops": probe.flops, "working_set": probe.working_set},
                0.0,
            )
            for probe in limits.probes()
        ]

    def close(self) -> None:
        """Do nothing: no resources to release."""


class Repeated:
    """Timed repetition of a call; `interrupted` states whether any repetition was preempted."""

    def __init__(self, call: Callable[[], object]) -> None:
        self._call, self.interrupted = call, False

    @measured_again
    def __call__(self, number: int) -> float:
        """Return the wall seconds of a number of calls. Raises ClocksDisagree."""
        watch = Watch(numba.get_num_threads())
        with watch:
            began = perf_counter()
            for _ in range(number):
                self._call()
            found = perf_counter() - began
        self.interrupted |= watch.columns("calls", [found])["interrupted"]
        return found


def reading(phase: str, call: Callable[[], object], columns: dict[str, Any], least: float = LEAST) -> Reading:
    """Time a phase and return the seconds per call. Raises RunFailed where another clock disagrees.

    Args:
        phase: name of the phase.
        call: what to time.
        columns: further columns of its row.
        least: time for which to repeat the call [s].
    """
    seconds = Repeated(call)
    return Reading(phase, average(seconds, least), columns | {"interrupted": seconds.interrupted})


def average(seconds: Callable[[int], float], least: float = LEAST) -> float:
    """Return the seconds per call.

    This is one call, or the mean of enough calls to last `least` after a first one.
    """
    once = seconds(1)
    number = _repeats(once, least)
    return seconds(number) / number if number > 1 else once


def _repeats(once: float, least: float = LEAST) -> int:
    return ceil(least / max(once, 1e-9))
