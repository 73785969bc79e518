"""Prices as units: those of all of a scene's effects by one solver."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from harness.base import holding, machine, rows
from harness.base.errors import InputError
from harness.base.progress import Display
from harness.base.workers import Limits, Lost, Tick
from harness.config.load import Sweep
from harness.config.sweep import RunSpec
from harness.experiments.ablation.prices import Price, only, priced, prices
from harness.experiments.ablation.rows import SCHEMA
from harness.experiments.core import do_all
from harness.experiments.failure import failure
from harness.experiments.provenance import asked, provenance
from harness.experiments.resume import Standing, standings, wanted
from harness.scenes.bind import build
from solvers.problem import Solver, StopRule
from solvers.registry import EVERY, load

Row = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Prices:
    """The prices of a scene's effects by a run's solver (`harness.experiments.core.Unit`)."""

    run: RunSpec
    folder: Path

    @property
    def path(self) -> Path:
        """The file of rows."""
        return self.folder / "ablation" / f"{self.run.label(machine.describe().id)}-prices.parquet"

    @property
    def standing(self) -> Standing:
        """Whether its rows are there."""
        return standings({self.path: lambda row: True}, (), SCHEMA)[self.path]

    @property
    def title(self) -> str:
        """See Unit."""
        return f"{self.run.title}: the price of each effect"

    @property
    def ticks(self) -> int:
        """One an effect."""
        return len(priced(self.run.scene))

    @property
    def work(self) -> float:
        """See Unit."""
        return 1.0

    @property
    def limits(self) -> Limits:
        """Those of a run."""
        return Limits(self.run.time_limit, self.run.memory_limit)

    def do(self, tick: Tick) -> str:
        """See Unit."""
        try:
            return self._written(self._measured(tick))
        except InputError:
            raise
        except Exception as error:  # a solver may fail in any way
            told = failure(error)
            return self._written([{"status": told["status"], "reason": told["reason"]}])

    def lost(self, lost: Lost) -> str:
        """See Unit."""
        return self._written([{"status": lost.status, "reason": str(lost)}])

    def _measured(self, tick: Tick) -> list[Row]:
        run = self.run
        solver: Solver = load(EVERY[run.solver.name])(**run.solver.parameters)
        stop, told = StopRule(run.iterations, run.tolerance), list[Row]()
        plain = build(only(run.scene), run.size)
        counts = {"vertices": len(plain.mesh.rest), "springs": len(plain.springs.edges)}
        with machine.pinned_threads(machine.threads(run.threads).number):
            for found in prices(run.scene, run.size, solver, stop, frames=run.frames, rounds=run.rounds):
                told.append(counts | _row(found))
                tick(found.effect)
        return told

    def _written(self, told: list[Row]) -> str:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        shared = asked(self.run) | provenance() | {"kind": "price", "frames": self.run.frames}
        effects = priced(self.run.scene)
        told = told if "name" in told[0] else [{"name": effect} | told[0] for effect in effects]
        rows.write(self.path, [shared | row for row in told], SCHEMA)
        return "ok" if any(row["status"] == "ok" for row in told) else f"{told[0]['status']}: {told[0]['reason']}"


def _row(found: Price) -> Row:
    row: Row = {"name": found.effect, "rounds": found.rounds}
    if found.refused:
        return row | {"status": "unsupported", "reason": found.refused}
    middle, low, high = found.price
    measured = {"price": middle, "price_low": low, "price_high": high, "price_bound": found.bound}
    return row | {"status": "ok", "seconds": found.seconds} | measured


def price_all(
    sweep: Sweep,
    folder: Path,
    display: Display,
    say: Callable[[str], None],
    *,
    again: bool = False,
    changed: bool = False,
    isolated: bool = True,
) -> list[Path]:
    """Price a scene's effects by each of a sweep's solvers, where that is not done; returns the files of rows.

    isolated: see `harness.experiments.core.do_all`. Raises InputError for what the user can mend.
    """
    units = [Prices(run, folder) for run in sweep.runs()]
    scene = units[0].run.scene
    scene.require_even_steps()
    priced(scene)
    folder.mkdir(parents=True, exist_ok=True)
    with holding.alone(folder):
        do_all(wanted(units, "prices", say, again=again, changed=changed), display, isolated=isolated)
    return [unit.path for unit in units]
