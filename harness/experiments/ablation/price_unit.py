"""Units that measure the per-iteration overhead of all effects of a scene with one solver."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from harness.base import holding, machine
from harness.base.progress import Display
from harness.base.workers import Tick
from harness.config.load import Sweep
from harness.experiments.ablation.base import OfEffects, Row
from harness.experiments.ablation.prices import Price, only, priced, prices
from harness.experiments.core import do_all
from harness.experiments.provenance import asked, provenance
from harness.experiments.resume import wanted
from harness.scenes.bind import build
from harness.simulation.algebraic import stop_rule
from solvers.problem import Solver
from solvers.registry import EVERY, load


@dataclass(frozen=True, slots=True)
class Prices(OfEffects):
    """Unit that measures the per-iteration overheads of a scene's effects with a run's solver."""

    @property
    def title(self) -> str:
        """Title of the unit, for messages."""
        return f"{self.run.title}: the price of each effect"

    @property
    def ticks(self) -> int:
        """Number of measured effects."""
        return len(priced(self.run.scene))

    def suffix(self) -> str:
        """Return the suffix of the file of overheads."""
        return "-prices"

    def measured(self, tick: Tick) -> list[Row]:
        """Measure the overhead of each effect and return the rows."""
        run = self.run
        solver: Solver = load(EVERY[run.solver.name])(**run.solver.parameters)
        stop, told = stop_rule(run.iterations, run.tolerance), list[Row]()
        plain = build(only(run.scene), run.size)
        counts = {"vertices": len(plain.mesh.rest), "springs": len(plain.springs.edges)}
        with machine.pinned_threads(machine.threads(run.threads).number):
            for found in prices(run.scene, run.size, solver, stop, frames=run.frames, rounds=run.rounds):
                told.append(counts | _row(found))
                tick(found.effect)
        return self._shared(told)

    def unanswered(self, status: str, reason: str) -> list[Row]:
        """Build the rows of a unit without a result: no effect has an overhead."""
        return self._shared([{"name": effect, "status": status, "reason": reason} for effect in priced(self.run.scene)])

    def _shared(self, told: list[Row]) -> list[Row]:
        shared = asked(self.run) | provenance() | {"kind": "price", "frames": self.run.frames}
        return [shared | row for row in told]


def _row(found: Price) -> Row:
    row: Row = {"name": found.effect, "rounds": found.rounds}
    if found.refused:
        return row | {"status": "unsupported", "reason": found.refused}
    row["max_iterations"] = found.iterations
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
    """Measure the missing overheads of a scene's effects for each solver of a sweep.

    Args:
        sweep: one scene with several solvers.
        folder: folder of the results.
        display: shows progress.
        say: prints a remark.
        again: whether to repeat all units.
        changed: whether to repeat units measured by other source code.
        isolated: see `harness.experiments.core.do_all`.

    Returns: the files of rows.

    Raises:
        InputError: the scene has no effect to measure, or no fixed time step.
    """
    units = [Prices(run, folder) for run in sweep.runs()]
    scene = units[0].run.scene
    scene.require_even_steps()
    priced(scene)
    folder.mkdir(parents=True, exist_ok=True)
    with holding.alone(folder):
        do_all(wanted(units, "prices", say, again=again, changed=changed), display, isolated=isolated)
    return [unit.path for unit in units]
