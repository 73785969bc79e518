"""Run of a sweep as a unit of work, executed here or remotely."""

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
    """Run of a sweep as a unit (`harness.experiments.core.Unit`).

    Attributes:
        run: specification of the run.
        files: paths of its files.
        positions: where to store the positions of all steps; None for not at all.
        at_once: number of runs that may be timed concurrently.
    """

    run: RunSpec
    files: Files
    positions: Path | None = None
    at_once: int = 1

    @property
    def title(self) -> str:
        """Title of the run, for messages."""
        return self.run.title

    @property
    def place(self) -> Path:
        """File of the run's rows."""
        return self.files.rows

    @property
    def ticks(self) -> int:
        """Number of steps of all passes."""
        return self.run.frames * self.run.passes

    @property
    def effort(self) -> Effort:
        """Estimated cost: vertices times steps times iterations."""
        return Effort(self.run.solver.name, (self.run.size or 32) ** 2 * self.ticks * self.run.iterations)

    @property
    def limits(self) -> Limits:
        """Limits that the sweep sets.

        The log file lies in a folder next to that of the rows.
        """
        log = self.files.rows.parents[1] / "logs" / f"{self.files.rows.stem}.txt"
        return Limits(self.run.time_limit, self.run.memory_limit, log)

    @property
    def own(self) -> frozenset[Hashable]:
        """Identity of the user code that the run executes."""
        return frozenset(tuple(plugin.identity()) for plugin in self.run.own())

    @property
    def group(self) -> Hashable:
        """Key of runs that are verified by one reference solution."""
        return (self.run.scene.digest, self.run.size, self.run.integrator) if self.run.judge else None

    def do(self, tick: Tick) -> str:
        """Execute the run and return its outcome as text."""
        from harness.experiments.run import execute  # brings along all that simulates and records

        files = self.files.absolute()  # code of others may change the folder
        positions = self.positions and self.positions.absolute()
        return _outcome(execute(self.run, files, tick, positions=positions, at_once=self.at_once))

    def lost(self, lost: Lost) -> str:
        """Write the row of a lost run, and return the outcome as text."""
        return _outcome(_abandoned(self.run, self.files, lost.status, str(lost)))


def _abandoned(run: RunSpec, files: Files, status: str, reason: str) -> list[dict[str, Any]]:
    """Write and return the row of a lost run, and remove its partial files."""
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
