"""Common base of ablation and overhead units.

One run of a scene yields a file of rows under `<folder>/ablation`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Hashable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from springbench.harness.config.sweep_config import RunSpec
from springbench.harness.errors import InputError
from springbench.harness.execution import machine_info
from springbench.harness.execution.isolated_worker import ProgressCallback, TaskFailure, TaskLimits
from springbench.harness.execution.progress_display import UNIT_COST, RunCost
from springbench.harness.experiments.ablation.ablation_schema import ABLATION_SCHEMA
from springbench.harness.experiments.completion_status import CompletionStatus, read_completion_statuses
from springbench.harness.experiments.failure_columns import build_failure_columns
from springbench.harness.results import parquet_rows
from springbench.solvers.plugins.plugin_discovery import identify_plugins

ResultRow = dict[str, Any]


@dataclass(frozen=True, slots=True)
class EffectUnit(ABC):
    """Unit that measures the effects of a run's scene.

    It implements `springbench.harness.experiments.experiment_units.ExperimentUnit`.
    """

    run: RunSpec
    folder: Path

    @property
    def rows_path(self) -> Path:
        """File of the unit's rows."""
        return (
            self.folder
            / "ablation"
            / f"{self.run.build_file_stem(machine_info.describe_machine().machine_id)}{self.file_suffix()}.parquet"
        )

    @property
    def completion_status(self) -> CompletionStatus:
        """Completion status: completed if the rows exist."""
        return read_completion_statuses({self.rows_path: lambda row: True}, (), ABLATION_SCHEMA)[self.rows_path]

    @property
    def cost_estimate(self) -> RunCost:
        """Estimated cost, which is unknown."""
        return UNIT_COST

    @property
    def task_limits(self) -> TaskLimits:
        """Limits of the run."""
        return TaskLimits(self.run.time_limit, self.run.memory_limit)

    @property
    def user_code(self) -> frozenset[Hashable]:
        """Identity of the user code that the unit executes."""
        return identify_plugins(self.run.find_plugins())

    def execute_unit(self, tick: ProgressCallback) -> str:
        """Measure, write the rows and return the outcome as text."""
        try:
            found = self.measure_rows(tick)
        except InputError:
            raise
        except Exception as error:  # a solver may fail with any exception
            columns = build_failure_columns(error)
            found = self.build_failure_rows(columns["status"], columns["reason"])
        return self._write_rows(found)

    def write_lost_rows(self, task_loss: TaskFailure) -> str:
        """Write the rows of a lost unit, and return the outcome as text."""
        return self._write_rows(self.build_failure_rows(task_loss.status, str(task_loss)))

    @abstractmethod
    def file_suffix(self) -> str:
        """Return the suffix that distinguishes the unit's file from others of the same run."""

    @abstractmethod
    def measure_rows(self, tick: ProgressCallback) -> list[ResultRow]:
        """Measure and return the rows. Errors of the solver are raised unchanged."""

    @abstractmethod
    def build_failure_rows(self, status: str, reason: str) -> list[ResultRow]:
        """Build the rows for a unit without a result.

        Args:
            status: kind of failure, such as `unsupported`.
            reason: cause of the failure, as a sentence.
        """

    def _write_rows(self, result_rows: list[ResultRow]) -> str:
        self.rows_path.parent.mkdir(parents=True, exist_ok=True)
        parquet_rows.write_rows(self.rows_path, result_rows, ABLATION_SCHEMA)
        first = result_rows[0]
        return "ok" if any(row["status"] == "ok" for row in result_rows) else f"{first['status']}: {first['reason']}"
