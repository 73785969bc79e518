"""Wall times of a run and their rows: preparation, steps, and phases of an iteration.

The timed passes record nothing. They follow a warm-up pass, in which the phases of each frame and an iteration of its
solve are timed separately, and which runs all code that the steps use. The timed passes then repeat the whole
simulation `rounds` times. All times are checked by a second clock (`PhaseWatch`). Where times do not matter
(`prepare_untimed`), only the instrumentation pass is run.

Whether phases add up to an iteration is decided by medians over the frames: of the sum of the phases' own medians, and
of an iteration of a whole solve measured next to them. They need not add up where steps are compiled as a whole, or
where a phase of some microseconds is mostly call overhead.
"""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from itertools import pairwise
from time import perf_counter
from typing import Any

import numba
import numpy as np
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.simulation.auto_tolerance import StopCriterion
from springbench.harness.simulation.device_stepping import wrap_device_solver
from springbench.harness.simulation.solver_contract import SolverContract
from springbench.harness.simulation.stopwatch import (
    PHASE_SUM_RTOL,
    PhaseWatch,
    Stopwatch,
    check_phases,
    retry_on_mismatch,
)
from springbench.harness.simulation.time_loop import SimulationStep, build_initial_state, prepare, simulate_scene
from springbench.solvers.model.step_problem import Positions, PreparedSolver, Solver

PHASE_REPEATS = 3
"""Number of timings of each phase in each frame, after the warm-up calls of `check_phases`."""

ITERATION_PHASE = "iteration"
"""Phase that the others should add up to: the time of a whole solve divided by its iterations."""

NO_CLOCK: AbstractContextManager[None] = nullcontext()

MAX_COORDINATE = 1e150
"""Magnitude [m] from which on coordinates count as not finite: their squares, and so all energies, are infinite."""


class DivergenceError(Exception):
    """Positions are no longer finite; the message states since when."""


class StepError(Exception):
    """The step of a frame failed; the error is the cause of this one."""

    def __init__(self, frame: int) -> None:
        super().__init__(f"frame {frame} failed")
        self.frame = frame


@dataclass(frozen=True, slots=True)
class TimingSample:
    """One measured time.

    Attributes:
        phase: name of the phase.
        frame: frame, None where there is none.
        round: number of the round.
        seconds: wall time [s] per call.
        num_calls: number of calls.
        device_columns: columns of a device: times of a step by events, and its state after the round.
    """

    phase: str
    frame: int | None
    round: int
    seconds: float
    num_calls: int = 1
    device_columns: dict[str, float | None] = field(default_factory=dict[str, float | None])


@dataclass(frozen=True, slots=True, eq=False)
class SteppingSettings:
    """Settings of time stepping: stop criterion, initial guess, numbers of frames and rounds."""

    stop_criterion: StopCriterion
    initial_guess: str
    frames: int
    rounds: int


@dataclass(frozen=True, slots=True, eq=False)
class RunMeasurement:
    """Result of the timed passes.

    Attributes:
        prepared: prepared solver.
        timings: all times.
        watches: watch over the times of each phase, and over those of the steps of each round.
        final_positions: final positions (n, 3) [m], None without timed passes.
        clock: without timed passes, the stopwatch of the steps of the instrumentation pass.
    """

    prepared: PreparedSolver
    timings: list[TimingSample]
    watches: dict[tuple[str, int | None], PhaseWatch]
    final_positions: Positions | None
    clock: AbstractContextManager[None] = NO_CLOCK

    @staticmethod
    def get_round(timing: TimingSample) -> int | None:
        """Return the round of a time's watch."""
        return timing.round if timing.phase == "step" else None


def measure_run(
    scene: Scene, solver: Solver, settings: SteppingSettings, tick: Callable[[str], None]
) -> RunMeasurement:
    """Prepare the solver cold and warm, then time phases and steps.

    Args:
        scene: scene that is stepped.
        solver: solver of the steps.
        settings: settings of the time stepping.
        tick: called with the name of the pass after each step.

    Raises:
        Unsupported: the solver does not support the scene.
        NotPositiveDefinite: a matrix is not positive definite.
        StepError: a step failed.
        RunFailed: the solver violates its contract.
    """
    timings: list[TimingSample] = []
    watches: dict[tuple[str, int | None], PhaseWatch] = {}
    contract = SolverContract(scene.system, solver)

    def watch(phase: str, round: int | None = None) -> PhaseWatch:
        return watches.setdefault((phase, round), PhaseWatch(numba.get_num_threads()))

    prepared = None
    for round in range(settings.rounds + 1):
        prepared = None  # releases its memory before the next one is allocated
        with watch("prepare"):
            began = perf_counter()
            prepared = prepare(scene, solver)
            seconds = perf_counter() - began
        timings.append(TimingSample("prepare", None, round, seconds))
    assert prepared is not None

    remote = wrap_device_solver(prepared)
    prepared = remote or prepared
    for step in iterate_steps(scene, contract.wrap_prepared(prepared), settings):
        if remote:
            remote.record_counts(step)
        phases = check_phases(prepared, step.problem)
        for phase, call in phases.items():
            with watch(phase):
                stamps = [perf_counter()]
                for _ in range(PHASE_REPEATS):
                    call()
                    stamps.append(perf_counter())
            timings += [TimingSample(phase, step.index, round, b - a) for round, (a, b) in enumerate(pairwise(stamps))]
        if phases:
            with watch(ITERATION_PHASE):
                began = perf_counter()
                done = max(1, prepared.solve(step.problem, step.stop_rule).num_iterations)
                seconds = perf_counter() - began
            timings.append(TimingSample(ITERATION_PHASE, step.index, 0, seconds / done, done))
        tick("warm up and phases")

    final = build_initial_state(scene).motion.positions
    for round in range(settings.rounds):
        clock, found = Stopwatch(watch("step", round)), list[TimingSample]()
        replayed = remote.build_replay() if remote else None
        for step in iterate_steps(scene, replayed or prepared, settings, clock):
            device_timings = replayed.collect_timings() if replayed else {}
            found.append(TimingSample("step", step.index, round, clock.seconds, device_columns=device_timings))
            final = step.positions
            tick("timed pass")
        state = remote.usual.device_state() if remote else {}
        timings += [replace(timing, device_columns=timing.device_columns | state) for timing in found]
    return RunMeasurement(prepared, timings, watches, final)


class _StepStopwatch(Stopwatch):
    """Stopwatch that records the times of successive steps."""

    def __init__(self, watch: PhaseWatch, timings: list[TimingSample]) -> None:
        super().__init__(watch)
        self._timings = timings

    def __exit__(self, *raised: object) -> None:
        super().__exit__(*raised)
        self._timings.append(TimingSample("step", self.watch.num_entries, 0, self.seconds))


def prepare_untimed(scene: Scene, solver: Solver) -> RunMeasurement:
    """Prepare once, for an instrumentation pass without timed passes.

    The clock of that pass is `RunMeasurement.clock`. Writes of the solver to its inputs are not checked.

    Args:
        scene: scene that is stepped.
        solver: solver of the steps.

    Raises:
        Unsupported: the solver does not support the scene.
        NotPositiveDefinite: a matrix is not positive definite.
    """
    preparing, stepping = (PhaseWatch(numba.get_num_threads()) for _ in range(2))
    clock = Stopwatch(preparing)
    with clock:
        prepared = prepare(scene, solver)
    timings = [TimingSample("prepare", None, 0, clock.seconds)]
    watches: dict[tuple[str, int | None], PhaseWatch] = {("prepare", None): preparing, ("step", 0): stepping}
    return RunMeasurement(prepared, timings, watches, None, _StepStopwatch(stepping, timings))


def iterate_steps(
    scene: Scene, prepared: PreparedSolver, settings: SteppingSettings, clock: AbstractContextManager[None] = NO_CLOCK
) -> Iterator[SimulationStep]:
    """Iterate over the run's steps, each computed within the clock.

    Args:
        scene: scene that is stepped.
        prepared: prepared solver.
        settings: settings of the time stepping.
        clock: context within which each step is computed.

    Raises:
        StepError: a step failed, or, caused by DivergenceError, a position is not finite.
    """
    run = simulate_scene(
        scene, prepared, settings.stop_criterion, initial_guess=settings.initial_guess, frames=settings.frames
    )
    for frame in range(1, settings.frames + 1):
        try:
            with clock:
                step = next(run)
            if not np.abs(step.positions).max(initial=0.0) < MAX_COORDINATE:  # so that NaN counts too
                raise DivergenceError(f"positions are not finite from frame {frame} on")
        except Exception as error:
            raise StepError(frame) from error
        yield step


def hash_positions(p: Positions) -> str:
    """Return the SHA-256 of positions (n, 3), to compare two passes bitwise."""
    return hashlib.sha256(np.ascontiguousarray(p).tobytes()).hexdigest()


@retry_on_mismatch
def measure_rows(
    scene: Scene, solver: Solver, settings: SteppingSettings, tick: Callable[[str], None]
) -> tuple[RunMeasurement, list[dict[str, Any]]]:
    """Measure a run as `measure_run` does, and build its timing rows.

    The measurement is repeated once if two clocks do not agree.

    Args:
        scene: scene that is stepped.
        solver: solver of the steps.
        settings: settings of the time stepping.
        tick: called with the name of the pass after each step.

    Returns:
        The measurement, and the columns of one row for each time.

    Raises:
        ClockMismatch: the clocks do not agree the second time either; also as `measure_run` raises.
    """
    measured = measure_run(scene, solver, settings, tick)
    return measured, build_timing_rows(measured)


def build_timing_rows(measured: RunMeasurement) -> list[dict[str, Any]]:
    """Build the timing columns, one row for each time; raises ClockMismatch."""
    groups: dict[tuple[str, int | None], list[TimingSample]] = defaultdict(list)
    for timing in measured.timings:
        groups[timing.phase, measured.get_round(timing)].append(timing)
    adds_up, found = _check_phase_sums(measured.timings), list[dict[str, Any]]()
    for (phase, _), timings in groups.items():
        rows: list[dict[str, Any]] = [
            {
                "phase": phase,
                "frame": t.frame,
                "round": t.round,
                "seconds": t.seconds,
                "phases_consistent": adds_up.get(phase),
            }
            | t.device_columns
            for t in timings
        ]
        watch = measured.watches[phase, measured.get_round(timings[0])]
        seen = watch.build_columns(phase, (row["seconds"] * t.num_calls for row, t in zip(rows, timings, strict=True)))
        found += [row | seen for row in rows]
    return found


def _check_phase_sums(timings: list[TimingSample]) -> dict[str, bool]:
    """Check whether all phases together take as long as an iteration; empty without phases."""
    by_frame: dict[str, dict[int, list[float]]] = defaultdict(lambda: defaultdict(list))
    for t in timings:
        if t.frame is not None and t.phase != "step":
            by_frame[t.phase][t.frame].append(t.seconds)
    medians = {
        phase: np.array([np.median(times) for _, times in sorted(frames.items())]) for phase, frames in by_frame.items()
    }
    if ITERATION_PHASE not in medians:
        return {}
    iteration = medians.pop(ITERATION_PHASE)
    ratio = float(np.median(sum(medians.values()) / iteration))
    return dict.fromkeys([*medians, ITERATION_PHASE], bool(abs(ratio - 1.0) <= PHASE_SUM_RTOL))


def compute_milliseconds(measured: RunMeasurement, frames: int) -> dict[str, list[float]]:
    """Compute the median time of each phase in each frame.

    Args:
        measured: times of all rounds.
        frames: number of frames.

    Returns:
        Name of the phase -> times (frames,) [ms], medians over the rounds.
    """
    by_phase: dict[str, list[list[float]]] = {}
    for t in measured.timings:
        if t.frame is not None:
            by_phase.setdefault(t.phase, [[] for _ in range(frames)])[t.frame - 1].append(1e3 * t.seconds)
    return {phase: [float(np.median(times)) for times in series] for phase, series in by_phase.items()}
