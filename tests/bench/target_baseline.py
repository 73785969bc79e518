"""Measure baselines of performance targets (`python -m tests.bench.targets`).

A baseline is a third-party integrator, or the cheapest fixed step size for the same error. For each integrator, solver
and tolerance, the step size is divided by sqrt(2) until the error at the end is at most the requested one. The best
combination is therefore the best in hindsight. If no combination reaches the error within `MAX_SIMULATION_SECONDS`, the
baseline is a lower bound of the cost.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product
from math import inf, sqrt
from time import thread_time

import numpy as np
from springbench.harness.errors import RunFailed
from springbench.harness.experiments.error_control.candidate_methods import ErrorTarget
from springbench.harness.experiments.error_control.method_trials import SearchResult
from springbench.harness.experiments.error_control.third_party_comparison import compare_third_party
from springbench.harness.simulation.auto_tolerance import StopCriterion, build_stop_rule
from springbench.harness.simulation.time_loop import prepare, simulate_scene
from springbench.solvers.model.step_problem import NotPositiveDefinite, Positions, Solver, Unsupported
from springbench.solvers.registry import SOLVER_TABLE, find_solver_info, load_target

from tests.bench.target_config import PerformanceTarget, TargetCase

MAX_SIMULATION_SECONDS = 20.0
"""CPU time limit of one simulation [s]."""
_MAX_REFINEMENTS = 40
"""Largest number of divisions of the step size by sqrt(2), by a factor of 10^6 in total; the time limit comes first."""
_TIME_FACTOR = 1.5
"""Time limit of a combination as a multiple of the cheapest time so far."""

ErrorFunction = Callable[[Positions], float]
"""Function that returns the relative error of end positions (n, 3) [m]."""


@dataclass(frozen=True, slots=True)
class TargetBaseline:
    """Baseline of a performance target.

    Attributes:
        name: name of the baseline.
        error: its relative error.
        seconds: its CPU time [s].
        is_lower_bound: whether it misses the error, so that reaching it would take longer.
        rerun_timed: repeats the simulation and returns its CPU seconds; None where that is not possible.
    """

    name: str
    error: float
    seconds: float
    is_lower_bound: bool = False
    rerun_timed: Callable[[], float] | None = None


@dataclass(frozen=True, slots=True)
class _FixedSteps:
    """Simulation with a fixed step size."""

    integrator: str
    solver: str
    stop_rule: StopCriterion
    stop_description: str
    frames: int

    def __str__(self) -> str:
        return f"{self.integrator} with {self.solver}, {self.frames} steps{self.stop_description}"


def find_baseline(
    performance_target: TargetCase,
    error_target: ErrorTarget,
    search_result: SearchResult,
    error: ErrorFunction,
    print_message: Callable[[str], None],
) -> TargetBaseline:
    """Measure the baseline of a performance target.

    Args:
        performance_target: the target.
        error_target: the scene and its end time.
        search_result: result of the method search.
        error: returns the error of end positions.
        print_message: prints a remark.

    Raises:
        RunFailed: no baseline can be measured.
    """
    return (
        _measure_third_party(performance_target, error_target, search_result)
        if performance_target.target.third_party
        else _find_fixed_steps(performance_target, error_target, error, print_message)
    )


def _measure_third_party(
    performance_target: TargetCase, error_target: ErrorTarget, search_result: SearchResult
) -> TargetBaseline:
    (other,) = compare_third_party(
        error_target, performance_target.error, search_result, [performance_target.target.third_party or ""]
    )
    if other.reason:
        raise RunFailed(f"{other.name}: {other.reason}")
    return TargetBaseline(other.name, other.error_estimated, other.cpu_seconds)


def _find_fixed_steps(
    performance_target: TargetCase,
    error_target: ErrorTarget,
    error: ErrorFunction,
    print_message: Callable[[str], None],
) -> TargetBaseline:
    """Return the cheapest fixed step size for the error, or a lower bound.

    The bound is the smallest of those on the cost.
    """
    best, again, bounds = TargetBaseline("", inf, inf), None, list[TargetBaseline]()
    for integrator, solver, tolerance in _list_combinations(performance_target.target):
        limit = min(MAX_SIMULATION_SECONDS, _TIME_FACTOR * best.seconds)
        stop = build_stop_rule(performance_target.target.max_iterations, tolerance)
        ended = (
            f", tolerance {tolerance:g}" if tolerance else f", {performance_target.target.max_iterations} iterations"
        )
        ended = "" if integrator == "substepping" else ended
        nearest = None
        for k in range(_MAX_REFINEMENTS):
            fixed = _FixedSteps(integrator, solver, stop, ended, round(error_target.num_frames * sqrt(2.0) ** k))
            try:
                found = _simulate_fixed_steps(error_target, error, fixed, limit)
            except (RunFailed, Unsupported, NotPositiveDefinite):
                break
            if found.error <= performance_target.error:
                if found.seconds < best.seconds:
                    best, again = found, fixed
                break
            if found.is_lower_bound and limit == MAX_SIMULATION_SECONDS:
                bounds.append(_build_lower_bound(fixed, found, nearest))
            if found.is_lower_bound:
                break
            nearest = found
    if again is None:
        if not bounds:
            raise RunFailed(f"no fixed step size reaches the error within {MAX_SIMULATION_SECONDS:g} s of CPU time")
        least = min(bounds, key=lambda bound: bound.seconds)
        print_message(f"  baseline: {least.name}")
        return least
    print_message(f"  baseline: {best.name}")
    return replace(best, rerun_timed=lambda: _simulate_fixed_steps(error_target, error, again, inf).seconds)


def _list_combinations(performance_target: PerformanceTarget) -> list[tuple[str, str, float | None]]:
    """Return the combinations of integrators, solvers and tolerances.

    Solvers with their own integrator come first, since they are the quickest to run; they are listed once, as
    `substepping`.
    """
    is_substepping = {
        name: find_solver_info(load_target(SOLVER_TABLE[name]), name).is_substepping
        for name in performance_target.solver
    }
    every = performance_target.integrator or ()
    substepping = [
        ("substepping", solver, None)
        for solver in performance_target.solver
        if is_substepping[solver] and "substepping" in every
    ]
    others = [name for name in every if name != "substepping"]
    rest = product(
        others, (solver for solver in performance_target.solver if not is_substepping[solver]), performance_target.rtol
    )
    return [*substepping, *rest]


def _build_lower_bound(
    fixed_steps: _FixedSteps, trial: TargetBaseline, nearest: TargetBaseline | None
) -> TargetBaseline:
    """Build the lower bound from steps that were still too long at the time limit."""
    reached = f"; error {nearest.error:.2g} with {nearest.name}" if nearest else ""
    name = f"{fixed_steps}, stopped after {trial.seconds:.3g} s{reached}"
    return TargetBaseline(name, nearest.error if nearest else inf, trial.seconds, is_lower_bound=True)


def _simulate_fixed_steps(
    error_target: ErrorTarget, error: ErrorFunction, fixed_steps: _FixedSteps, time_limit: float
) -> TargetBaseline:
    """Simulate with a fixed step size; the simulation ends early beyond a time limit [s]."""
    scene = error_target.build_scene(error_target.t_end / fixed_steps.frames, fixed_steps.integrator)
    made: Solver = load_target(SOLVER_TABLE[fixed_steps.solver])()
    guess = error_target.scene.choose_initial_guess(fixed_steps.integrator)
    warm = simulate_scene(scene, prepare(scene, made), fixed_steps.stop_rule, initial_guess=guess, frames=1)
    next(warm)  # compiles
    began, p = thread_time(), scene.mesh.rest_positions
    for step in simulate_scene(
        scene, prepare(scene, made), fixed_steps.stop_rule, initial_guess=guess, frames=fixed_steps.frames
    ):
        p = step.positions
        if not np.isfinite(p).all():
            break
        if thread_time() - began > time_limit and step.index < fixed_steps.frames:
            return TargetBaseline(str(fixed_steps), inf, thread_time() - began, is_lower_bound=True)
    found = error(p) if np.isfinite(p).all() else inf
    return TargetBaseline(str(fixed_steps), found, thread_time() - began)
