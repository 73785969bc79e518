"""Wall times of a run: preparation, whole steps, and the local and global step separately.

The timed passes record nothing. They follow an untimed pass in which the phases of each frame are timed separately,
next to an iteration of its solve. This pass warms up all code that the steps use. The timed passes then repeat the
whole simulation `rounds` times. All times are checked by a second clock (`Watch`). Where times do not matter
(`roughly`), only the instrumentation pass is run.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from itertools import pairwise
from time import perf_counter

import numba
import numpy as np

from harness.scenes.bind import Scene
from harness.simulation.algebraic import Stop
from harness.simulation.clock import Clock, Watch, working
from harness.simulation.contract import Contract
from harness.simulation.on_device import on_device
from harness.simulation.step import Step, prepare, simulate, start
from solvers.problem import Positions, Prepared, Solver

PHASE_REPEATS = 3
"""Number of timings of the local and the global step in each frame, after warm-up calls."""

ITERATION = "iteration"
"""Phase that the others should add up to: the time of a whole solve divided by its iterations, measured next to
theirs."""

NO_CLOCK: AbstractContextManager[None] = nullcontext()

LARGEST = 1e150
"""Magnitude [m] from which on coordinates count as not finite: their squares, and so all energies, are infinite."""


class Diverged(Exception):
    """Positions are no longer finite; the message states since when."""


class StepFailed(Exception):
    """The step of a frame failed; the error is the cause of this one."""

    def __init__(self, frame: int) -> None:
        super().__init__(f"frame {frame} failed")
        self.frame = frame


@dataclass(frozen=True, slots=True)
class Timing:
    """One measured time.

    Attributes:
      phase: name of the phase.
      frame: frame, None where there is none.
      round: number of the round.
      seconds: wall time [s] per call.
      calls: number of calls.
      device: columns of a device: times of a step by events, and its state after the round.
    """

    phase: str
    frame: int | None
    round: int
    seconds: float
    calls: int = 1
    device: dict[str, float | None] = field(default_factory=dict[str, float | None])


@dataclass(frozen=True, slots=True, eq=False)
class Settings:
    """Settings of time stepping: stop criterion, initial guess, numbers of frames and rounds."""

    stop: Stop
    first_guess: str
    frames: int
    rounds: int


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """Result of the timed passes.

    Attributes:
      prepared: prepared solver.
      timings: all times.
      watches: watch over the times of each phase, and over those of the steps of each round.
      final: final positions (n, 3) [m], None without timed passes.
      clock: without timed passes, the stopwatch of the steps of the instrumentation pass.
    """

    prepared: Prepared
    timings: list[Timing]
    watches: dict[tuple[str, int | None], Watch]
    final: Positions | None
    clock: AbstractContextManager[None] = NO_CLOCK

    @staticmethod
    def pass_of(timing: Timing) -> int | None:
        """Return the round of a time's watch."""
        return timing.round if timing.phase == "step" else None


def measure(scene: Scene, solver: Solver, settings: Settings, tick: Callable[[str], None]) -> Measured:
    """Prepare the solver cold and warm, then time phases and steps.

    Args:
      scene: scene that is stepped.
      solver: solver of the steps.
      settings: settings of the time stepping.
      tick: called with the name of the pass after each step.

    Raises:
      Unsupported: the solver does not support the scene.
      NotPositiveDefinite: a matrix is not positive definite.
      StepFailed: a step failed.
      RunFailed: the solver violates its contract.
    """
    timings: list[Timing] = []
    watches: dict[tuple[str, int | None], Watch] = {}
    contract = Contract(scene.system, solver)

    def watch(phase: str, round: int | None = None) -> Watch:
        return watches.setdefault((phase, round), Watch(numba.get_num_threads()))

    prepared = None
    for round in range(settings.rounds + 1):
        prepared = None  # what it holds is free again before the next one takes as much
        with watch("prepare"):
            began = perf_counter()
            prepared = prepare(scene, solver)
            seconds = perf_counter() - began
        timings.append(Timing("prepare", None, round, seconds))
    assert prepared is not None

    remote = on_device(prepared)
    prepared = remote or prepared
    for step in steps(scene, contract.checked(prepared), settings):
        if remote:
            remote.keep(step)
        phases = working(prepared, step.problem)
        for phase, call in phases.items():
            with watch(phase):
                stamps = [perf_counter()]
                for _ in range(PHASE_REPEATS):
                    call()
                    stamps.append(perf_counter())
            timings += [Timing(phase, step.index, round, b - a) for round, (a, b) in enumerate(pairwise(stamps))]
        if phases:
            with watch(ITERATION):
                began = perf_counter()
                done = max(1, prepared.solve(step.problem, step.stop).iterations)
                seconds = perf_counter() - began
            timings.append(Timing(ITERATION, step.index, 0, seconds / done, done))
        tick("warm up and phases")

    final = start(scene).now.positions
    for round in range(settings.rounds):
        clock, found = Clock(watch("step", round)), list[Timing]()
        replayed = remote.again() if remote else None
        for step in steps(scene, replayed or prepared, settings, clock):
            told = replayed.told() if replayed else {}
            found.append(Timing("step", step.index, round, clock.seconds, device=told))
            final = step.positions
            tick("timed pass")
        state = remote.usual.state() if remote else {}
        timings += [replace(timing, device=timing.device | state) for timing in found]
    return Measured(prepared, timings, watches, final)


class _Steps(Clock):
    """Stopwatch that records the times of successive steps."""

    def __init__(self, watch: Watch, timings: list[Timing]) -> None:
        super().__init__(watch)
        self._timings = timings

    def __exit__(self, *raised: object) -> None:
        super().__exit__(*raised)
        self._timings.append(Timing("step", self.watch.entered, 0, self.seconds))


def roughly(scene: Scene, solver: Solver) -> Measured:
    """Prepare once, for an instrumentation pass without timed passes.

    The clock of that pass is `Measured.clock`. Writes of the solver to its inputs are not checked. Raises
    Unsupported, NotPositiveDefinite.
    """
    preparing, stepping = (Watch(numba.get_num_threads()) for _ in range(2))
    clock = Clock(preparing)
    with clock:
        prepared = prepare(scene, solver)
    timings = [Timing("prepare", None, 0, clock.seconds)]
    watches: dict[tuple[str, int | None], Watch] = {("prepare", None): preparing, ("step", 0): stepping}
    return Measured(prepared, timings, watches, None, _Steps(stepping, timings))


def steps(
    scene: Scene, prepared: Prepared, settings: Settings, clock: AbstractContextManager[None] = NO_CLOCK
) -> Iterator[Step]:
    """Iterate over the run's steps, each computed within the clock.

    Args:
      scene: scene that is stepped.
      prepared: prepared solver.
      settings: settings of the time stepping.
      clock: context within which each step is computed.

    Raises:
      StepFailed: a step failed, or, caused by Diverged, a position is not finite.
    """
    run = simulate(scene, prepared, settings.stop, first_guess=settings.first_guess, frames=settings.frames)
    for frame in range(1, settings.frames + 1):
        try:
            with clock:
                step = next(run)
            if not np.abs(step.positions).max(initial=0.0) < LARGEST:  # so that NaN counts too
                raise Diverged(f"positions are not finite from frame {frame} on")
        except Exception as error:
            raise StepFailed(frame) from error
        yield step


def digest(p: Positions) -> str:
    """Return the SHA-256 of positions (n, 3), to compare two passes bitwise."""
    return hashlib.sha256(np.ascontiguousarray(p).tobytes()).hexdigest()
