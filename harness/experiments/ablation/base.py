"""Common base of ablation and overhead units.

One run of a scene yields a file of rows under `<folder>/ablation`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from harness.base import machine, rows
from harness.base.errors import InputError
from harness.base.progress import ANY_EFFORT, Effort
from harness.base.workers import Limits, Lost, Tick
from harness.config.sweep import RunSpec
from harness.experiments.ablation.ablation_rows import SCHEMA
from harness.experiments.failure import failure
from harness.experiments.resume import Standing, standings

Row = dict[str, Any]


@dataclass(frozen=True, slots=True)
class OfEffects(ABC):
    """Unit that measures a scene's effects in a run (`harness.experiments.core.Unit`)."""

    run: RunSpec
    folder: Path

    @property
    def path(self) -> Path:
        """File of the unit's rows."""
        return self.folder / "ablation" / f"{self.run.label(machine.describe().id)}{self.suffix()}.parquet"

    @property
    def standing(self) -> Standing:
        """Completion status: completed if the rows exist."""
        return standings({self.path: lambda row: True}, (), SCHEMA)[self.path]

    @property
    def effort(self) -> Effort:
        """Estimated cost, which is unknown."""
        return ANY_EFFORT

    @property
    def limits(self) -> Limits:
        """Limits of the run."""
        return Limits(self.run.time_limit, self.run.memory_limit)

    def do(self, tick: Tick) -> str:
        """Measure, write the rows and return the outcome as text."""
        try:
            found = self.measured(tick)
        except InputError:
            raise
        except Exception as error:  # a solver may fail in any way
            told = failure(error)
            found = self.unanswered(told["status"], told["reason"])
        return self._written(found)

    def lost(self, lost: Lost) -> str:
        """Write the rows of a lost unit, and return the outcome as text."""
        return self._written(self.unanswered(lost.status, str(lost)))

    @abstractmethod
    def suffix(self) -> str:
        """Return the suffix that distinguishes its file from others of the same run."""

    @abstractmethod
    def measured(self, tick: Tick) -> list[Row]:
        """Measure and return the rows. Errors of the solver are raised unchanged."""

    @abstractmethod
    def unanswered(self, status: str, reason: str) -> list[Row]:
        """Build the rows for a unit without a result."""

    def _written(self, found: list[Row]) -> str:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        rows.write(self.path, found, SCHEMA)
        first = found[0]
        return "ok" if any(row["status"] == "ok" for row in found) else f"{first['status']}: {first['reason']}"
