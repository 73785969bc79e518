"""Wall times of a run: preparing, whole steps, and the local and the global step apart.

The timed passes record nothing. They come after a pass in which the phases are timed apart, which warms up
all that the steps use, and they repeat the whole simulation `rounds` times.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from harness.scenes.bind import Scene
from harness.simulation.contract import Contract
from harness.simulation.step import Step, prepare, simulate, start
from solvers.problem import Positions, Prepared, Solver, StopRule

PHASE_REPEATS = 3
"""How often the local and the global step are timed in each frame, after one call to warm up."""


LARGEST = 1e150
"""Coordinates [m] from this one on count as not finite: their squares, and so all energies, are infinite."""


class Diverged(Exception):
    """Positions are not finite any more; the message says since when."""


class StepFailed(Exception):
    """A step, of this frame, ended with an error, the cause of this one."""

    def __init__(self, frame: int) -> None:
        super().__init__(f"frame {frame} failed")
        self.frame = frame


@dataclass(frozen=True, slots=True)
class Timing:
    """One measured time: phase, frame (None where it has none), round, wall seconds."""

    phase: str
    frame: int | None
    round: int
    seconds: float


@dataclass(frozen=True, slots=True, eq=False)
class Settings:
    """How a scene is stepped and how often: the stop rule, first guess, frames and rounds of a run."""

    stop: StopRule
    first_guess: str
    frames: int
    rounds: int


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """What the timed passes found: the prepared solver, all times, and the digest of the final positions."""

    prepared: Prepared
    timings: list[Timing]
    digest: str


def measure(scene: Scene, solver: Solver, settings: Settings, tick: Callable[[str], None]) -> Measured:
    """Prepare cold and warm, then time phases and steps; `tick` is told each pass's name after each step.

    Raises Unsupported, NotPositiveDefinite, StepFailed, RunFailed where the solver breaks its contract.
    """
    timings: list[Timing] = []
    contract = Contract(scene.system, solver)
    prepared = None
    for round in range(settings.rounds + 1):
        began = perf_counter()
        prepared = prepare(scene, solver)
        timings.append(Timing("prepare", None, round, perf_counter() - began))
    assert prepared is not None

    for step in steps(scene, contract.checked(prepared), settings):
        for phase, call in prepared.phases(step.problem).items():
            call()
            for round in range(PHASE_REPEATS):
                began = perf_counter()
                call()
                timings.append(Timing(phase, step.index, round, perf_counter() - began))
        tick("warm up and phases")

    final = start(scene).now.positions
    for round in range(settings.rounds):
        for step in steps(scene, prepared, settings):
            timings.append(Timing("step", step.index, round, step.seconds))
            final = step.positions
            tick("timed pass")
    return Measured(prepared, timings, digest(final))


def steps(scene: Scene, prepared: Prepared, settings: Settings) -> Iterator[Step]:
    """The run's steps; raises StepFailed, from Diverged where a position is not finite."""
    run = simulate(scene, prepared, settings.stop, first_guess=settings.first_guess, frames=settings.frames)
    for frame in range(1, settings.frames + 1):
        try:
            step = next(run)
            if not np.abs(step.positions).max(initial=0.0) < LARGEST:  # so that NaN counts too
                raise Diverged(f"positions are not finite from frame {frame} on")
        except Exception as error:
            raise StepFailed(frame) from error
        yield step


def digest(p: Positions) -> str:
    """SHA-256 of positions (n, 3), so that two passes can be compared to the last bit."""
    return hashlib.sha256(np.ascontiguousarray(p).tobytes()).hexdigest()
