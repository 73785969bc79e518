"""Measure the error of the method that `springbench recommend --budget` selects, over the least error in hindsight.

    ratio = error(recommended) / min_m error(m)      m: settings whose time is within the budget

    python -m tests.bench.budget [--only NAME ...] [--rounds 5] [--search-time 60]

The questions are ten small scenes with a budget each. A setting is a solver with its options, an integrator and a step
size, from a grid that is finer and wider than that of the search (`build_grid`, `REFINEMENTS`). One pass measures all
settings, from large step sizes to small ones, until a method takes twice the budget. The settings that may be the best
are then measured interleaved with the recommended one, for several rounds.

A setting is within the budget if the median of its rounds is. If that of the recommended setting is above the budget,
for example on a busy machine, it replaces the budget. Settings above 95 % of this limit are uncertain: the column
`ratio` excludes them, and the last column includes them. When other programs interrupt a round, processor time replaces
wall time, as in the search. Errors below the error of the reference, 0.1 %, are set to that. The exit code is 1 if a
ratio without uncertain settings exceeds 1.3.
"""

from __future__ import annotations

import argparse
import logging
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby
from math import inf
from pathlib import Path
from statistics import median
from time import monotonic
from typing import Any, NamedTuple

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from springbench.harness.config.accuracy_config import WorkSpec
from springbench.harness.config.config_loader import load_scene
from springbench.harness.errors import RunFailed
from springbench.harness.experiments.accuracy.accuracy_units import load_reference_trajectory, open_reference_store
from springbench.harness.experiments.accuracy.candidate_grids import StudyCandidates
from springbench.harness.experiments.accuracy.method_recommendation import (
    RecommendationOptions,
    build_study,
    recommend_method,
)
from springbench.harness.experiments.accuracy.recommendation_goal import BUDGET_REFERENCE_ERROR, RecommendationGoal
from springbench.harness.experiments.accuracy.setting_grid import compute_setting_cost, is_measured
from springbench.harness.experiments.accuracy.work_precision import build_work_rows
from springbench.solvers.registry import SOLVERS, find_solver_info, load_target

from tests.progress_displays import SilentDisplay

SCENES = Path(__file__).parents[2] / "configs" / "scenes"
LIMIT, CERTAIN_FRACTION = 1.3, 0.95
"""Largest accepted ratio of errors, and fraction of the budget below which a median is certainly within it."""
MAX_TIME_RATIO, MAX_CANDIDATE_TIME_RATIO, MAX_ERROR_RATIO = 2.0, 1.3, 1.2
"""Largest ratio of time to the budget in the first pass, of a candidate after it, and of the error to the least for
an interleaved setting."""
NUM_INTERLEAVED = 8
"""Number of settings that are measured interleaved with the recommended one."""
REFINEMENTS = (1, 2, 3, 4, 6, 8, 12, 16)
"""Numbers of steps relative to the time step of the scene."""
IMPLICIT_INTEGRATORS = ["implicit-euler", "bdf2", "midpoint", "sdirk-2", "sdirk-4", "esdirk-4"]


class Question(NamedTuple):
    """A scene, its mesh size, the simulated time [s], and the budget of a frame [s]."""

    scene: str
    size: int
    t_end: float
    budget: float


QUESTIONS = (
    Question("hanging-cloth", 8, 0.4, 5e-4),
    Question("chain", 11, 0.4, 1e-3),
    Question("net", 5, 0.4, 1e-3),
    Question("curtain", 7, 0.4, 2e-3),
    Question("balloon", 5, 0.4, 1e-3),
    Question("flag-in-wind", 9, 0.3, 1e-3),
    Question("rope-bridge", 11, 0.3, 1e-3),
    Question("bending-strip", 11, 0.4, 2e-3),
    Question("pulled-curtain", 9, 0.4, 2e-3),
    Question("heavy-bob", 0, 0.3, 5e-4),
)


class MeasuredSetting(NamedTuple):
    """A setting with its error and its time for a frame [s]."""

    spec: WorkSpec
    error: float
    seconds: float

    def __str__(self) -> str:
        options, case = self.spec.options, self.spec.case
        stop = options["rtol"] or options["max_iterations"]
        return f"{self.spec.solver.name} {case.integrator} {1e3 * case.scene.time_step:.3g} ms, {stop:g}"


def build_grid() -> list[dict[str, Any]]:
    """Build the grid of settings: adaptive solvers, solvers with iteration counts, and solvers with tolerances."""
    infos = {name: find_solver_info(load_target(target), name) for name, target in SOLVERS.items()}
    adaptive = [name for name, info in infos.items() if info.is_substepping and info.supports_error_control]
    return [
        {"solver": adaptive, "max_iterations": 1, "integrator": ["substepping"]},
        {"solver": ["numba", "xpbd", "baraff-witkin", "vbd"], "max_iterations": [1, 2, 5, 10, 20]},
        {
            "solver": ["newton", "lbfgs"],
            "rtol": [1e-1, 1e-2],
            "max_iterations": 100,
            "integrator": IMPLICIT_INTEGRATORS,
        },
    ]


def measure_setting(spec: WorkSpec, trajectory: Any, frame: float) -> MeasuredSetting:
    """Measure a setting once; error and time are infinite if the simulation has no result."""
    row = build_work_rows(spec, trajectory, lambda: None)[0]
    if not is_measured(row):
        return MeasuredSetting(spec, inf, inf)
    error = row["error"] if row["status"] == "ok" else BUDGET_REFERENCE_ERROR
    return MeasuredSetting(spec, max(error, BUDGET_REFERENCE_ERROR), frame * compute_setting_cost(spec, row))


def screen_settings(
    specs: Sequence[WorkSpec], trajectory: Any, question: Question, frame: float
) -> list[MeasuredSetting]:
    """Measure all settings once, and return those that may be within the budget."""

    def describe_method(spec: WorkSpec) -> str:
        return repr((spec.solver, spec.case.integrator, spec.options))

    found, limit = list[MeasuredSetting](), MAX_TIME_RATIO * question.budget
    time_limit = max(0.1, limit * question.t_end / frame)
    ordered = sorted(specs, key=lambda spec: (describe_method(spec), -spec.case.scene.time_step))
    for _, several in groupby(ordered, describe_method):
        for spec in several:
            limited = replace(spec, measurement=replace(spec.measurement, time_limit=time_limit))
            one = measure_setting(limited, trajectory, frame)
            if one.seconds > limit:
                break
            found.append(one)
            if one.error == BUDGET_REFERENCE_ERROR:
                break
    return [one for one in found if one.seconds <= MAX_CANDIDATE_TIME_RATIO * question.budget]


def measure_interleaved(
    settings: Sequence[MeasuredSetting], trajectory: Any, frame: float, rounds: int
) -> list[MeasuredSetting]:
    """Measure all settings in each round, and return them with their median times."""
    times = [[] for _ in settings]
    for _ in range(rounds):
        for one, seconds in zip(settings, times, strict=True):
            seconds.append(measure_setting(one.spec, trajectory, frame).seconds)
    return [one._replace(seconds=median(seconds)) for one, seconds in zip(settings, times, strict=True)]


class BudgetResult(NamedTuple):
    """The recommended setting, and the best ones in hindsight: without and with uncertain settings."""

    recommended: MeasuredSetting
    best: MeasuredSetting
    best_by_median: MeasuredSetting
    num_settings: int


def evaluate_question(question: Question, rounds: int, search_time: float, results: Path) -> BudgetResult:
    """Recommend a method for a question, and measure the settings of the grid."""
    path, budget, t_end = SCENES / f"{question.scene}.yaml", question.budget, question.t_end
    scene, store = load_scene(path), open_reference_store(results)
    options = RecommendationOptions(question.size or None, t_end, time_limit=5.0, search_time=search_time)
    goal = RecommendationGoal(frame_seconds=budget)
    found = recommend_method(path, goal, options, results, SilentDisplay(), lambda line: None)
    grid = build_grid()
    names = dict.fromkeys(name for entry in grid for name in entry["solver"])
    candidates = StudyCandidates([{"name": name} for name in names], grid, REFINEMENTS)
    specs = build_study(path, scene, found.best_method.work_spec.case.size, candidates, t_end, 5.0).work
    trajectory = load_reference_trajectory(specs[0], store)
    screened = screen_settings(specs, trajectory, question, scene.time_step)
    selected = measure_setting(found.best_method.work_spec, trajectory, scene.time_step)
    hindsight = _select_promising([selected, *screened], budget)
    recommended, *others = measure_interleaved([selected, *hindsight], trajectory, scene.time_step, rounds)
    limit = max(budget, recommended.seconds)
    certain, within = (
        min((recommended, *(one for one in others if one.seconds <= part * limit)), key=_get_error)
        for part in (CERTAIN_FRACTION, 1.0)
    )
    return BudgetResult(recommended, certain, within, len(specs))


def _select_promising(settings: Sequence[MeasuredSetting], budget: float) -> list[MeasuredSetting]:
    """Return the settings that may be the best, without the first one, which is the recommended one.

    Errors select them, since a single measured time is not accurate enough.
    """
    least = min(one.error for one in settings if one.seconds <= CERTAIN_FRACTION * budget or one is settings[0])
    promising = (one for one in settings[1:] if one.error <= MAX_ERROR_RATIO * least)
    return sorted(promising, key=_get_error)[:NUM_INTERLEAVED]


def _get_error(setting: MeasuredSetting) -> float:
    return setting.error


def main() -> None:
    """Print a line for each question, then a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", metavar="NAME", help="scenes (default: all ten)")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--search-time", type=float, default=60.0, help="time of each search [s]")
    logging.getLogger("springbench").setLevel(logging.ERROR)  # each simulation warns of unusual values of its scene
    options, console, is_missed = parser.parse_args(), Console(width=160), False
    table = Table("scene", "ms a frame", "recommended", "its ms", "error", "best", "its ms", "error", "ratio", "to")
    table.box = SIMPLE_HEAD
    with tempfile.TemporaryDirectory() as folder:
        for one in QUESTIONS:
            if options.only and one.scene not in options.only:
                continue
            began = monotonic()
            try:
                found = evaluate_question(one, options.rounds, options.search_time, Path(folder))
            except RunFailed as error:
                console.print(f"{one.scene}: {error}")
                is_missed = True
                continue
            recommended, best = found.recommended, found.best
            ratios = [recommended.error / other.error for other in (best, found.best_by_median)]
            is_missed |= ratios[0] > LIMIT
            cells = [
                f"{one.scene} {one.size or ''}",
                f"{1e3 * one.budget:g}",
                str(recommended),
                f"{1e3 * recommended.seconds:.3g}",
                f"{recommended.error:.2e}",
                str(best),
                f"{1e3 * best.seconds:.3g}",
                f"{best.error:.2e}",
                *(f"{ratio:.2f}" for ratio in ratios),
            ]
            table.add_row(*cells)
            console.print(" | ".join(cells), f"({found.num_settings} settings, {monotonic() - began:.0f} s)")
    console.print(table)
    sys.exit(int(is_missed))


if __name__ == "__main__":
    main()
