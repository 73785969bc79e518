"""Pair of solvers on the same steps of one scene, in one process.

Their answers can be compared, and their times measured.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import ceil
from pathlib import Path
from typing import Any

from harness.base.errors import InputError
from harness.config.load import load_any, require_stated
from harness.config.options import DEFAULT_SOLVER, Chosen
from harness.config.sweep import RunSpec
from harness.experiments.gates.abba import CALL, Clock, Timed
from harness.scenes.bind import build
from harness.simulation.algebraic import stop_rule
from harness.simulation.step import prepare, simulate
from solvers.problem import Positions, Solver
from solvers.registry import SOLVERS, load

CLOCKS: dict[Clock, Callable[[], float]] = {"cpu": time.process_time, "wall": time.perf_counter}

Given = str | Mapping[str, Any] | Solver
"""A solver: its name, a mapping of its name and parameters, or a solver object."""

Work = Callable[[], Any]
"""Function that performs some work once and returns its answer."""


@dataclass(frozen=True, slots=True)
class Steps:
    """The first steps of a scene with a prepared solver.

    A call simulates them and returns the last positions [m].
    """

    run: RunSpec
    frames: int
    positions: Callable[[int], Positions]

    def __call__(self) -> Positions:
        return self.positions(self.frames)


def pair(scene: Path, solver: Given, against: Given, *, size: int | None = None, **options: Any) -> tuple[Steps, Steps]:
    """Prepare the same steps for two solvers, and run both once.

    The number of steps is chosen so that a call is long enough for a clock, at most the scene's.

    Args:
        scene: file of the scene.
        solver: the candidate.
        against: solver to compare with.
        size: mesh size; the scene's default if omitted.
        options: options of a run, such as iterations and tolerance.
    Raises: InputError, Unsupported, NotPositiveDefinite.
    """
    both = [_steps(scene, given, size, options) for given in (solver, against)]
    once = min(seconds_of(steps) for steps in both)
    frames = min(both[0].run.frames, ceil(CALL / max(once, 1e-6)))
    candidate, yardstick = (Steps(s.run, frames, s.positions) for s in both)
    return candidate, yardstick


def _steps(scene: Path, given: Given, size: int | None, options: dict[str, Any]) -> Steps:
    asked: list[Any] = [
        dict(given) if isinstance(given, Mapping) else given if isinstance(given, str) else DEFAULT_SOLVER
    ]
    stated = {name: Chosen.model_fields[name].default for name in ("iterations", "tolerance")}
    more: dict[str, Any] = {"threads": 1} | stated | options
    runs = load_any(scene, solvers=asked, sizes=[size] if size else [], **more).runs()
    if len(runs) != 1:
        raise InputError(f"{scene}: a gate is on one run; came {len(runs)}")
    require_stated(runs)
    (run,) = runs
    named = isinstance(given, (str, Mapping))
    solver: Solver = load(SOLVERS[run.solver.name])(**run.solver.parameters) if named else given
    bound = build(run.scene, run.size, run.integrator)
    prepared, stop = prepare(bound, solver), stop_rule(run.iterations, run.tolerance)

    def positions(frames: int) -> Positions:
        p = bound.mesh.rest
        for step in simulate(bound, prepared, stop, first_guess=run.first_guess, frames=frames):
            p = step.positions
        return p

    return Steps(run, 1, positions)


def timed(work: Work, calls: int, clock: Clock) -> Timed:
    """Build a function that returns the time [s] of a number of calls together.

    Args:
        work: function to time.
        calls: number of calls.
        clock: "cpu" or "wall".
    """
    now = CLOCKS[clock]

    def seconds() -> float:
        began = now()
        for _ in range(calls):
            work()
        return now() - began

    return seconds


def seconds_of(work: Work) -> float:
    """Measure the CPU seconds of one call, after a warm-up call."""
    work()
    return timed(work, 1, "cpu")()


def calls_of(candidate: Work, yardstick: Work) -> int:
    """Choose the number of calls that are timed together.

    Both programs are warm. The calls together are long enough for a clock.
    """
    once = min(timed(work, 1, "wall")() for work in (candidate, yardstick))
    return max(1, ceil(CALL / max(once, 1e-7)))
