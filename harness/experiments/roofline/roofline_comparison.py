"""Speed report: a sweep's runs, the C++ baseline and the roofline, by size.

An ordinary sweep specifies the runs. All runs of a size are one unit here. They are timed interleaved in one process,
each from the same first step of its scene, so they have one time step, integrator and initial guess.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import pyarrow as pa
from springbench.harness.config.config_loader import SweepPlan
from springbench.harness.config.sweep_config import RunSpec, SolverSpec
from springbench.harness.errors import InputError
from springbench.harness.execution import folder_locks, machine_info
from springbench.harness.execution.isolated_worker import ProgressCallback, TaskFailure, TaskLimits
from springbench.harness.execution.progress_display import ProgressDisplay, RunCost
from springbench.harness.experiments.completion_status import (
    NOT_STARTED,
    CompletionStatus,
    read_completion_statuses,
    select_missing_units,
)
from springbench.harness.experiments.experiment_units import execute_units, require_threads
from springbench.harness.experiments.provenance import build_run_columns
from springbench.harness.experiments.roofline import cpp_baseline
from springbench.harness.experiments.roofline.benchmark_candidates import (
    BenchmarkCandidate,
    CppCandidate,
    MachineCandidate,
    SolverCandidate,
)
from springbench.harness.experiments.roofline.precision_error import find_converged_problem, read_precision
from springbench.harness.experiments.roofline.round_robin import (
    NUM_PREPARATIONS,
    PastTiming,
    format_candidate_name,
    measure_round_robin,
)
from springbench.harness.experiments.sweep_plan import RunFiles
from springbench.harness.report.speed.speed_figures import CPP_BASELINE, MACHINE_SOLVER
from springbench.harness.results import parquet_rows
from springbench.harness.results.run_schema import RUN_SCHEMA
from springbench.harness.scenes.scene_builder import build_scene
from springbench.harness.simulation.time_loop import build_initial_state, build_problem
from springbench.solvers.model.step_problem import PreparedSolver
from springbench.solvers.plugins.plugin_discovery import identify_plugins

MALLOC_SETTINGS = {"default": "", "cheap": cpp_baseline.MALLOC_TUNABLES}
"""Memory settings of the C++ baseline: the defaults, or those that make temporaries cheapest."""


EXTRA_WALL_SECONDS = 3600.0
"""Wall time of a size, in addition to four times the budgets, for compiling, preparing and checking [s]."""


@dataclass(frozen=True, slots=True)
class RooflineUnit:
    """Unit that times the runs of one scene and size, and their baselines.

    It implements `springbench.harness.experiments.experiment_units.ExperimentUnit`.

    Attributes:
        candidate_runs: the runs, and those of the baselines.
        folder: folder of the results.
        smaller_rows: name and file of rows of each candidate at the smaller sizes, smallest first.
        budget: time limit of a candidate, as predicted from its smaller sizes [s].
    """

    candidate_runs: tuple[RunSpec, ...]
    folder: Path
    smaller_rows: tuple[tuple[str, Path], ...]
    budget: float

    @property
    def rows_paths(self) -> list[Path]:
        """Files of the rows of each candidate."""
        return [RunFiles.for_run(run, self.folder).rows_path for run in self.candidate_runs]

    @property
    def title(self) -> str:
        """Title of the unit, for messages."""
        first = self.candidate_runs[0]
        return f"{first.scene_name} {first.size}: {len(self.candidate_runs)} candidates interleaved"

    @property
    def num_progress_steps(self) -> int:
        """Number of rounds of preparation and of timing."""
        return NUM_PREPARATIONS + max(run.rounds for run in self.candidate_runs)

    @property
    def cost_estimate(self) -> RunCost:
        """Estimated cost, proportional to the number of vertices."""
        return RunCost(amount=float(self.candidate_runs[0].size or 32) ** 2)

    @property
    def task_limits(self) -> TaskLimits:
        """Wall-time limit, from the budget of all candidates."""
        return TaskLimits(EXTRA_WALL_SECONDS + 4.0 * self.budget * len(self.candidate_runs))

    @property
    def completion_status(self) -> CompletionStatus:
        """Completion status: completed if the rows of all candidates exist."""
        found = list(
            read_completion_statuses(dict.fromkeys(self.rows_paths, lambda row: True), (), RUN_SCHEMA).values()
        )
        missing = next((one for one in found if one.status == NOT_STARTED), None)
        return missing or found[0]._replace(is_stale=any(one.is_stale for one in found))

    @property
    def user_code(self) -> frozenset[Hashable]:
        """Identity of the user code that the unit executes."""
        return identify_plugins(plugin for run in self.candidate_runs for plugin in run.find_plugins())

    def execute_unit(self, tick: ProgressCallback) -> str:
        """Time all candidates, write their rows and return the outcome as text."""
        past: dict[str, list[PastTiming]] = {}
        for candidate, path in self.smaller_rows:
            past.setdefault(candidate, []).extend(_read_past_timings(parquet_rows.read_rows([path]).to_pylist()))
        return self._write_rows(_measure_rows(self.candidate_runs, self.folder, past, self.budget, tick))

    def write_lost_rows(self, task_loss: TaskFailure) -> str:
        """Write a row for each candidate of a lost unit, and return a message."""
        why = {"phase": "run", "status": task_loss.status, "reason": str(task_loss)}
        return self._write_rows([[build_run_columns(run) | why] for run in self.candidate_runs])

    def _write_rows(self, measured: Sequence[list[dict[str, Any]]]) -> str:
        for path, found in zip(self.rows_paths, measured, strict=True):
            parquet_rows.write_rows(path, found)
        bad = [found[0]["solver"] for found in measured if found[0]["status"] not in ("ok", "skipped", "unsupported")]
        return f"{', '.join(dict.fromkeys(bad))} failed" if bad else "ok"


def run_roofline(
    sweep: SweepPlan,
    folder: Path,
    display: ProgressDisplay,
    print_message: Callable[[str], None],
    *,
    rerun: bool = False,
    rerun_stale: bool = False,
    budget: float = 210.0,
    isolated: bool = True,
) -> pa.Table:
    """Execute the missing sizes of a sweep and return all rows.

    Args:
        sweep: the sweep.
        folder: folder of the results.
        display: shows progress.
        print_message: prints a remark.
        rerun: whether to repeat all sizes.
        rerun_stale: whether to repeat sizes measured by other source code.
        budget: time limit of a candidate at a size, as predicted from its smaller sizes [s].
        isolated: whether to use worker processes; otherwise units run here, without limits.

    Raises:
        InputError: an option is invalid, or runs of one scene and size take different steps.
    """
    runs = [run.replace_options(threads=machine_info.choose_threads(run.threads).count) for run in sweep.list_runs()]
    require_threads({machine_info.choose_threads(run.threads).count for run in runs})
    (folder / "rows").mkdir(parents=True, exist_ok=True)
    with folder_locks.lock_folder_exclusive(folder):
        planned: list[RooflineUnit] = []
        smaller: list[tuple[str, Path]] = []
        for group in _group_runs(runs):
            planned.append(RooflineUnit((*group, *_build_baseline_runs(group)), folder, tuple(smaller), budget))
            smaller += zip(map(format_candidate_name, planned[-1].candidate_runs), planned[-1].rows_paths, strict=True)
        execute_units(
            select_missing_units(planned, "sizes", print_message, rerun=rerun, rerun_stale=rerun_stale),
            display,
            isolated=isolated,
        )
        return parquet_rows.read_rows(path for size in planned for path in size.rows_paths)


def _group_runs(runs: Sequence[RunSpec]) -> list[list[RunSpec]]:
    """Group the runs by scene and size, smaller sizes first.

    Raises InputError if runs of a group take different steps: their times and positions could not be compared.
    """
    groups: dict[tuple[str, int], list[RunSpec]] = {}
    for run in sorted(runs, key=lambda run: run.size):
        groups.setdefault((run.scene_name, run.size), []).append(run)
    for (scene, size), group in groups.items():
        for option in ("time_step", "integrator", "initial_guess"):
            values = dict.fromkeys(str(getattr(run, option)) for run in group)
            if len(values) > 1:
                raise InputError(
                    f"{option}: got {', '.join(values)} for {scene} {size}; expected one value, because all candidates "
                    "of a size compute the same step: use a config for each"
                )
    return list(groups.values())


def _build_baseline_runs(group: Sequence[RunSpec]) -> list[RunSpec]:
    """Build the baseline runs of a size.

    These are the C++ baseline on one thread, and the machine on as many threads as the runs use.
    """
    first = group[0]
    eigen = [
        first.replace_options(threads=1, solver=SolverSpec(CPP_BASELINE, {"temporaries": setting}))
        for setting in MALLOC_SETTINGS
    ]
    threads = sorted({run.threads for run in group})
    return eigen + [first.replace_options(threads=t, solver=SolverSpec(MACHINE_SOLVER, {})) for t in threads]


def _measure_rows(
    runs: Sequence[RunSpec],
    folder: Path,
    past_timings: dict[str, list[PastTiming]],
    budget: float,
    tick: ProgressCallback,
) -> list[list[dict[str, Any]]]:
    """Measure all runs of one scene and size, and return the rows of each."""
    first = runs[0]  # all take the same step, as `_group_runs` requires
    scene = build_scene(first.scene, first.size, first.integrator)
    stated = build_problem(scene, build_initial_state(scene), first.initial_guess)
    program = partial(cpp_baseline.compile_baseline, folder / "build")
    prepared: dict[str, PreparedSolver] = {}
    rest = find_converged_problem(stated) if any(read_precision(run) != "float64" for run in runs) else None

    def candidate(run: RunSpec) -> BenchmarkCandidate:
        if run.solver.name == MACHINE_SOLVER:
            return MachineCandidate(run)
        if run.solver.name == CPP_BASELINE:
            return CppCandidate(run, scene, stated, program, MALLOC_SETTINGS[run.solver.parameters["temporaries"]])
        return SolverCandidate(run, scene, stated, prepared, rest)

    counts = {"vertices": len(scene.mesh.rest_positions), "springs": len(scene.all_springs.edges)}
    return measure_round_robin([candidate(run) for run in runs], counts, past_timings, budget, tick)


def _read_past_timings(found: Sequence[dict[str, Any]]) -> list[PastTiming]:
    """Return the timing that predicts larger sizes from a run's rows.

    The result is empty if it failed or has no steps.
    """
    prepare = [row["seconds"] for row in found if row["phase"] == "prepare"]
    iteration = [row["seconds"] / row["num_iterations"] for row in found if row["phase"] == "step"]
    if not (prepare and iteration):
        return []
    return [PastTiming(found[0]["vertices"], median(prepare), median(iteration))]
