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

from springbench.harness.config.config_loader import load_config, require_fixed_steps
from springbench.harness.config.run_options import DEFAULT_SOLVER, RunOptions
from springbench.harness.config.sweep_config import RunSpec
from springbench.harness.errors import InputError
from springbench.harness.experiments.regression.abba_benchmark import MIN_CALL_SECONDS, ClockName, TimedCall
from springbench.harness.scenes.scene_builder import build_scene
from springbench.harness.simulation.auto_tolerance import build_stop_rule
from springbench.harness.simulation.time_loop import prepare, simulate_scene
from springbench.solvers.model.step_problem import Positions, Solver
from springbench.solvers.registry import SOLVERS, load_target

CLOCK_FUNCTIONS: dict[ClockName, Callable[[], float]] = {"cpu": time.process_time, "wall": time.perf_counter}

SolverInput = str | Mapping[str, Any] | Solver
"""A solver: its name, a mapping of its name and parameters, or a solver object."""

WorkFunction = Callable[[], Any]
"""Function that performs some work once and returns its answer."""


@dataclass(frozen=True, slots=True)
class SceneSteps:
    """The first steps of a scene with a prepared solver.

    A call simulates them and returns the last positions [m].
    """

    run: RunSpec
    num_frames: int
    simulate_frames: Callable[[int], Positions]

    def __call__(self) -> Positions:
        return self.simulate_frames(self.num_frames)


def prepare_solver_pair(
    scene: Path, solver: SolverInput, baseline: SolverInput, *, size: int | None = None, **options: Any
) -> tuple[SceneSteps, SceneSteps]:
    """Prepare the same steps for two solvers, and run both once.

    The number of steps is chosen so that a call is long enough for a clock, at most the scene's.

    Args:
        scene: file of the scene.
        solver: the candidate.
        baseline: solver to compare with.
        size: mesh size; the scene's default if omitted.
        options: options of a run, such as iterations and tolerance.
    Raises: InputError, Unsupported, NotPositiveDefinite.
    """
    both = [_prepare_steps(scene, given, size, options) for given in (solver, baseline)]
    once = min(measure_call_seconds(steps) for steps in both)
    frames = min(both[0].run.frames, ceil(MIN_CALL_SECONDS / max(once, 1e-6)))
    candidate, yardstick = (SceneSteps(s.run, frames, s.simulate_frames) for s in both)
    return candidate, yardstick


def _prepare_steps(scene: Path, solver_input: SolverInput, size: int | None, options: dict[str, Any]) -> SceneSteps:
    asked: list[Any] = [
        dict(solver_input)
        if isinstance(solver_input, Mapping)
        else solver_input
        if isinstance(solver_input, str)
        else DEFAULT_SOLVER
    ]
    stated = {name: RunOptions.model_fields[name].default for name in ("iterations", "tolerance")}
    more: dict[str, Any] = {"threads": 1} | stated | options
    runs = load_config(scene, solvers=asked, sizes=[size] if size else [], **more).list_runs()
    if len(runs) != 1:
        raise InputError(f"{scene}: a gate is on one run; came {len(runs)}")
    require_fixed_steps(runs)
    (run,) = runs
    named = isinstance(solver_input, (str, Mapping))
    solver: Solver = load_target(SOLVERS[run.solver.name])(**run.solver.parameters) if named else solver_input
    bound = build_scene(run.scene, run.size, run.integrator)
    prepared, stop = prepare(bound, solver), build_stop_rule(run.iterations, run.tolerance)

    def positions(frames: int) -> Positions:
        p = bound.mesh.rest_positions
        for step in simulate_scene(bound, prepared, stop, initial_guess=run.first_guess, frames=frames):
            p = step.positions
        return p

    return SceneSteps(run, 1, positions)


def build_timer(work: WorkFunction, num_calls: int, clock: ClockName) -> TimedCall:
    """Build a function that returns the time [s] of a number of calls together.

    Args:
        work: function to time.
        num_calls: number of calls.
        clock: "cpu" or "wall".
    """
    now = CLOCK_FUNCTIONS[clock]

    def seconds() -> float:
        began = now()
        for _ in range(num_calls):
            work()
        return now() - began

    return seconds


def measure_call_seconds(work: WorkFunction) -> float:
    """Measure the CPU seconds of one call, after a warm-up call."""
    work()
    return build_timer(work, 1, "cpu")()


def choose_num_calls(candidate: WorkFunction, baseline: WorkFunction) -> int:
    """Choose the number of calls that are timed together.

    Both programs are warm. The calls together are long enough for a clock.
    """
    once = min(build_timer(work, 1, "wall")() for work in (candidate, baseline))
    return max(1, ceil(MIN_CALL_SECONDS / max(once, 1e-7)))
