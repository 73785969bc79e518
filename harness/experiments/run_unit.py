"""Run of a sweep as a unit of work, executed here or remotely."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from springbench.harness.atomic_files import find_partial_files
from springbench.harness.config.sweep_config import RunSpec
from springbench.harness.execution.isolated_worker import ProgressCallback, TaskFailure, TaskLimits
from springbench.harness.execution.progress_display import RunCost
from springbench.harness.experiments.provenance import (
    build_run_columns,
    collect_source_parts,
    compute_source_fingerprint,
)
from springbench.harness.experiments.sweep_plan import RunFiles
from springbench.harness.results import parquet_rows
from springbench.harness.results.quantities import compute_ms_per_step
from springbench.solvers.plugins.plugin_discovery import identify_plugins


@dataclass(frozen=True, slots=True)
class RunUnit:
    """Run of a sweep as a unit (`springbench.harness.experiments.experiment_units.ExperimentUnit`).

    Attributes:
        run: specification of the run.
        files: paths of its files.
        positions_path: where to store the positions of all steps; None for not at all.
        num_concurrent_runs: number of runs that may be timed concurrently.
    """

    run: RunSpec
    files: RunFiles
    positions_path: Path | None = None
    num_concurrent_runs: int = 1

    @property
    def title(self) -> str:
        """Title of the run, for messages."""
        return self.run.title

    @property
    def rows_path(self) -> Path:
        """File of the run's rows."""
        return self.files.rows_path

    @property
    def num_progress_steps(self) -> int:
        """Number of steps of all passes."""
        return self.run.frames * self.run.num_passes

    @property
    def cost_estimate(self) -> RunCost:
        """Estimated cost: vertices times steps times iterations."""
        return RunCost(
            self.run.solver.name, (self.run.size or 32) ** 2 * self.num_progress_steps * self.run.max_iterations
        )

    @property
    def task_limits(self) -> TaskLimits:
        """Limits that the sweep sets.

        The log file lies in a folder next to that of the rows.
        """
        log = self.files.rows_path.parents[1] / "logs" / f"{self.files.rows_path.stem}.txt"
        return TaskLimits(self.run.time_limit, self.run.memory_limit, log)

    @property
    def user_code(self) -> frozenset[Hashable]:
        """Identity of the user code that the run executes."""
        return identify_plugins(self.run.find_plugins())

    @property
    def affinity_group(self) -> Hashable:
        """Key of runs that are verified by one reference solution."""
        return (self.run.scene.scene_digest, self.run.size, self.run.integrator) if self.run.verify else None

    def execute_unit(self, tick: ProgressCallback) -> str:
        """Execute the run and return its outcome as text."""
        from springbench.harness.experiments.run_pipeline import (
            execute_run,  # imports everything that simulates and records
        )

        files = self.files.to_absolute()  # user code may change the working folder
        positions = self.positions_path and self.positions_path.absolute()
        return _format_outcome(
            execute_run(self.run, files, tick, positions=positions, num_concurrent_runs=self.num_concurrent_runs)
        )

    def write_lost_rows(self, task_loss: TaskFailure) -> str:
        """Write the row of a lost run, and return the outcome as text."""
        return _format_outcome(_write_lost_rows(self.run, self.files, task_loss.status, str(task_loss)))


def _write_lost_rows(run: RunSpec, files: RunFiles, status: str, reason: str) -> list[dict[str, Any]]:
    """Write and return the row of a lost run, and remove its partial files."""
    for earlier in (files.recording_path, files.picture_path):
        earlier.unlink(missing_ok=True)
        for half in find_partial_files(earlier):
            half.unlink(missing_ok=True)
    found = [
        build_run_columns(run)
        | {"source_fingerprint": compute_source_fingerprint(collect_source_parts(run))}
        | {"phase": "run", "status": status, "reason": reason}
    ]
    parquet_rows.write_rows(files.rows_path, found)
    return found


def _format_outcome(found: list[dict[str, Any]]) -> str:
    if found[0]["status"] != "ok":
        return f"{found[0]['status']}: {found[0]['reason']}"
    taken = compute_ms_per_step([row["seconds"] for row in found if row["phase"] == "step"])
    return f"{taken:.3g} ms a step"
