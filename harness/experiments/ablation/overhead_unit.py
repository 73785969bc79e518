"""Units that measure the per-iteration overhead of all effects of a scene with one solver."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from springbench.harness.config.config_loader import SweepPlan
from springbench.harness.execution import folder_locks, machine_info
from springbench.harness.execution.isolated_worker import ProgressCallback
from springbench.harness.execution.progress_display import ProgressDisplay
from springbench.harness.experiments.ablation.effect_unit import EffectUnit, ResultRow
from springbench.harness.experiments.ablation.iteration_overhead import (
    EffectOverhead,
    list_measured_effects,
    measure_overheads,
    select_effects,
)
from springbench.harness.experiments.completion_status import select_missing_units
from springbench.harness.experiments.experiment_units import execute_units
from springbench.harness.experiments.provenance import build_provenance_columns, build_specification_columns
from springbench.harness.scenes.scene_builder import build_scene
from springbench.harness.simulation.auto_tolerance import build_stop_rule
from springbench.solvers.model.step_problem import Solver
from springbench.solvers.registry import SOLVER_TABLE, load_target


@dataclass(frozen=True, slots=True)
class OverheadUnit(EffectUnit):
    """Unit that measures the per-iteration overheads of a scene's effects with a run's solver."""

    @property
    def title(self) -> str:
        """Title of the unit, for messages."""
        return f"{self.run.title}: the overhead of each effect"

    @property
    def num_progress_steps(self) -> int:
        """Number of measured effects."""
        return len(list_measured_effects(self.run.scene))

    def file_suffix(self) -> str:
        """Return the suffix of the file of overheads."""
        return "-overhead"

    def measure_rows(self, tick: ProgressCallback) -> list[ResultRow]:
        """Measure the overhead of each effect and return the rows."""
        run = self.run
        solver: Solver = load_target(SOLVER_TABLE[run.solver.name])(**run.solver.parameters)
        stop, rows = build_stop_rule(run.max_iterations, run.rtol), list[ResultRow]()
        plain = build_scene(select_effects(run.scene), run.size, run.integrator)
        counts = {"vertices": len(plain.mesh.rest_positions), "springs": len(plain.all_springs.edges)}
        with machine_info.limit_threads(machine_info.choose_threads(run.threads).count):
            for found in measure_overheads(
                run.scene,
                run.size,
                solver,
                stop,
                integrator=run.integrator,
                initial_guess=run.initial_guess,
                frames=run.frames,
                max_rounds=run.rounds,
            ):
                rows.append(counts | _build_row(found))
                tick(found.effect_kind)
        return self._add_shared_columns(rows)

    def build_failure_rows(self, status: str, reason: str) -> list[ResultRow]:
        """Build the rows of a unit without a result: no effect has an overhead.

        Args:
            status: kind of failure, such as `unsupported`.
            reason: cause of the failure, as a sentence.
        """
        return self._add_shared_columns(
            [{"name": effect, "status": status, "reason": reason} for effect in list_measured_effects(self.run.scene)]
        )

    def _add_shared_columns(self, rows: list[ResultRow]) -> list[ResultRow]:
        shared = (
            build_specification_columns(self.run)
            | build_provenance_columns()
            | {"kind": "overhead", "frames": self.run.frames}
        )
        return [shared | row for row in rows]


def _build_row(overhead: EffectOverhead) -> ResultRow:
    row: ResultRow = {"name": overhead.effect_kind, "rounds": overhead.num_rounds}
    if overhead.unsupported_reason:
        return row | {"status": "unsupported", "reason": overhead.unsupported_reason}
    row["max_iterations"] = overhead.max_iterations
    middle, low, high = overhead.ratio_interval
    measured = {
        "overhead_ratio": middle,
        "overhead_ratio_low": low,
        "overhead_ratio_high": high,
        "overhead_ratio_bound": overhead.min_ratio,
    }
    return row | {"status": "ok", "seconds": overhead.seconds} | measured


def measure_all_overheads(
    sweep: SweepPlan,
    folder: Path,
    display: ProgressDisplay,
    print_message: Callable[[str], None],
    *,
    rerun: bool = False,
    rerun_stale: bool = False,
    isolated: bool = True,
) -> list[Path]:
    """Measure the missing overheads of a scene's effects for each solver of a sweep.

    Args:
        sweep: one scene with several solvers.
        folder: folder of the results.
        display: shows progress.
        print_message: prints a remark.
        rerun: whether to repeat all units.
        rerun_stale: whether to repeat units measured by other source code.
        isolated: whether to use worker processes; otherwise units run here, without limits.

    Returns:
        The files of rows.

    Raises:
        InputError: the scene has no effect to measure, or no fixed time step.
    """
    units = [OverheadUnit(run, folder) for run in sweep.list_runs()]
    scene = units[0].run.scene
    scene.require_fixed_time_step()
    list_measured_effects(scene)
    folder.mkdir(parents=True, exist_ok=True)
    with folder_locks.lock_folder_exclusive(folder):
        execute_units(
            select_missing_units(units, "units of overheads", print_message, rerun=rerun, rerun_stale=rerun_stale),
            display,
            isolated=isolated,
        )
    return [unit.rows_path for unit in units]
