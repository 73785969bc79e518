"""A run of a sweep as a unit of work, done here or on another machine's worker."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from harness.base import rows
from harness.base.files import half_written
from harness.base.progress import Effort
from harness.base.quantities import ms_per_step
from harness.base.workers import Limits, Lost, Tick
from harness.config.sweep import RunSpec
from harness.experiments.code import code, parts
from harness.experiments.plan import Files
from harness.experiments.provenance import common


@dataclass(frozen=True, slots=True)
class RunUnit:
    """A run as a unit of a sweep (`harness.experiments.core.Unit`). positions: where to store those of its steps;
    at_once: so many may be timed at once."""

    run: RunSpec
    files: Files
    positions: Path | None = None
    at_once: int = 1

    @property
    def title(self) -> str:
        """The run in words."""
        return self.run.title

    @property
    def place(self) -> Path:
        """See Filed."""
        return self.files.rows

    @property
    def ticks(self) -> int:
        """The steps of all passes."""
        return self.run.frames * self.run.passes

    @property
    def effort(self) -> Effort:
        """See Unit."""
        return Effort(self.run.solver.name, (self.run.size or 32) ** 2 * self.ticks * self.run.iterations)

    @property
    def limits(self) -> Limits:
        """What the sweep says; what the run writes is beside its rows."""
        log = self.files.rows.parents[1] / "logs" / f"{self.files.rows.stem}.txt"
        return Limits(self.run.time_limit, self.run.memory_limit, log)

    @property
    def own(self) -> frozenset[Hashable]:
        """The code of others that it runs."""
        return frozenset(tuple(plugin.identity()) for plugin in self.run.own())

    @property
    def group(self) -> Hashable:
        """Runs that are judged by one reference."""
        return (self.run.scene.digest, self.run.size, self.run.integrator) if self.run.judge else None

    def do(self, tick: Tick) -> str:
        """See Unit."""
        from harness.experiments.run import execute  # brings along all that simulates and records

        files = self.files.absolute()  # code of others may change the folder
        positions = self.positions and self.positions.absolute()
        return _outcome(execute(self.run, files, tick, positions=positions, at_once=self.at_once))

    def lost(self, lost: Lost) -> str:
        """See Unit."""
        return _outcome(_abandoned(self.run, self.files, lost.status, str(lost)))


def _abandoned(run: RunSpec, files: Files, status: str, reason: str) -> list[dict[str, Any]]:
    """The rows of a run whose process gave no answer, written; what it left half written is removed."""
    for earlier in (files.recording, files.picture):
        earlier.unlink(missing_ok=True)
        for half in half_written(earlier):
            half.unlink(missing_ok=True)
    found = [common(run) | {"code": code(parts(run))} | {"phase": "run", "status": status, "reason": reason}]
    rows.write(files.rows, found)
    return found


def _outcome(found: list[dict[str, Any]]) -> str:
    if found[0]["status"] != "ok":
        return f"{found[0]['status']}: {found[0]['reason']}"
    taken = ms_per_step([row["seconds"] for row in found if row["phase"] == "step"])
    return f"{taken:.3g} ms a step"
