"""Pair of solvers on the same steps of one scene, in one process.

Their answers can be compared, and their times measured.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from math import ceil
from pathlib import Path
from typing import Any

from springbench.harness.config.config_loader import load_config, require_fixed_steps
from springbench.harness.config.run_options import DEFAULT_SOLVER, RunOptions
from springbench.harness.config.sweep_config import RunSpec
from springbench.harness.errors import InputError
from springbench.harness.experiments.regression.abba_benchmark import MIN_CALL_SECONDS
from springbench.harness.experiments.regression.program_pair import build_timer
from springbench.harness.scenes.scene_builder import build_scene
from springbench.harness.simulation.auto_tolerance import build_stop_rule
from springbench.harness.simulation.time_loop import prepare, simulate_scene
from springbench.solvers.model.step_problem import Positions, Solver
from springbench.solvers.registry import SOLVER_TABLE, load_target

SolverInput = str | Mapping[str, Any] | Solver
"""A solver: its name, a mapping of its name and parameters, or a solver object."""


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
        options: options of a run, such as max_iterations and rtol.

    Returns:
        The steps with the candidate, and those with the baseline.

    Raises:
        InputError: for a mistake in the scene, a solver or an option.
        Unsupported: a solver does not support the scene.
        NotPositiveDefinite: a system matrix is not positive definite.
    """
    first, second = (_prepare_steps(scene, given, size, options) for given in (solver, baseline))
    for steps in (first, second):
        steps()  # warm-up
    once = min(build_timer(steps, 1, "cpu")() for steps in (first, second))
    frames = min(first.run.frames, ceil(MIN_CALL_SECONDS / max(once, 1e-6)))
    return replace(first, num_frames=frames), replace(second, num_frames=frames)


def _prepare_steps(scene: Path, solver_input: SolverInput, size: int | None, options: dict[str, Any]) -> SceneSteps:
    is_named = isinstance(solver_input, (str, Mapping))
    named: Any = dict(solver_input) if isinstance(solver_input, Mapping) else solver_input
    defaults = {name: RunOptions.model_fields[name].default for name in ("max_iterations", "rtol")}
    run_options: dict[str, Any] = {"threads": 1} | defaults | options
    runs = load_config(
        scene, solvers=[named if is_named else DEFAULT_SOLVER], sizes=[size] if size else [], **run_options
    ).list_runs()
    if len(runs) != 1:
        raise InputError(f"{scene}: got {len(runs)} runs; a gate compares one run")
    require_fixed_steps(runs)
    (run,) = runs
    solver: Solver = load_target(SOLVER_TABLE[run.solver.name])(**run.solver.parameters) if is_named else named
    bound = build_scene(run.scene, run.size, run.integrator)
    prepared, stop = prepare(bound, solver), build_stop_rule(run.max_iterations, run.rtol)

    def positions(frames: int) -> Positions:
        p = bound.mesh.rest_positions
        for step in simulate_scene(bound, prepared, stop, initial_guess=run.initial_guess, frames=frames):
            p = step.positions
        return p

    return SceneSteps(run, 1, positions)
