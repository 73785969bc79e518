"""Does the units of work of an accuracy config that are missing, and only those.

A unit is a Parquet file under `<folder>/accuracy`, written when all of it is measured: what a kill leaves undone is
told from the files. A unit that the config asks for in another way by now, or of another frozen step, is done again.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

from harness.base import machine, rows, shelf
from harness.base.errors import InputError
from harness.base.progress import Display
from harness.base.stated import stated
from harness.config.accuracy import CurveUnit, Unit, WorkUnit
from harness.config.accuracy_load import Accuracy
from harness.experiments.accuracy.failures import lost
from harness.experiments.accuracy.rows import SCHEMA
from harness.experiments.accuracy.solves import Graded, curve_rows
from harness.experiments.accuracy.work import work_rows
from harness.experiments.columns import provenance
from harness.reference.store import Store
from harness.reference.trajectory import Trajectory

Row = dict[str, Any]


def run_accuracy(
    accuracy: Accuracy,
    folder: Path,
    display: Display,
    say: Callable[[str], None],
    *,
    again: bool = False,
) -> list[Path]:
    """Do what is missing (all of it with `again`) and return the files of all units and their frozen steps.

    What an earlier state of the config asked for is left where it is, and not among these.

    folder: of the config's results, beside which the truth is kept for all configs; say: prints a remark.
    Raises InputError.
    """
    units: Sequence[Unit] = (*accuracy.curves, *accuracy.work)
    for threads in {unit.how.threads for unit in units}:
        with machine.pinned_threads(threads):  # refuses what this machine cannot do before anything starts
            pass
    (folder / "accuracy").mkdir(parents=True, exist_ok=True)
    with rows.alone(folder):
        run = _Run(accuracy.name, folder, references(folder.parent), display, again)
        todo = sum(not run.done(unit) for unit in units)
        if todo < len(units):
            say(f"{len(units) - todo} of {len(units)} units are there already")
        if older := rows.of_other_code((run.path(unit) for unit in units if run.done(unit)), machine.code_hash()):
            say(older)
        display.begin(todo, todo)
        try:
            for _, curves in groupby(accuracy.curves, key=lambda unit: (unit.case.identity(), unit.moment)):
                run.curves(list(curves))
            for _, work in groupby(
                accuracy.work, key=lambda unit: (unit.case.scene_name, unit.case.size, unit.horizon)
            ):
                run.work(list(work))
        finally:
            display.end()
    paths = [*map(run.path, units), *map(run.problem_path, accuracy.curves)]
    return [path for path in dict.fromkeys(paths) if shelf.there(path)]


def references(results: Path) -> Store:
    """The truth of all configs whose results are in one folder."""
    return Store(results / ".references")


def failures(files: Sequence[Path]) -> list[str]:
    """Scene, size, moment, solver and reason of what failed; other statuses are results."""
    found = [rows.read([path], SCHEMA).to_pylist()[0] for path in files]
    return [
        f"{r['scene']} {r['size']} {r['moment'] or r['integrator']} {r['solver']}: {r['reason']}"
        for r in found
        if r["status"] == "failed"
    ]


class _Run:
    """Tells what is done, and does the rest."""

    def __init__(self, name: str, folder: Path, store: Store, display: Display, again: bool) -> None:
        self._name, self._folder, self._store, self._display, self._again = name, folder, store, display, again
        self._machine = machine.describe().id
        self._moments: dict[str, str] = {}

    def path(self, unit: Unit) -> Path:
        """The file of a unit."""
        return self._folder / "accuracy" / f"{unit.label()}.parquet"

    def problem_path(self, unit: CurveUnit) -> Path:
        """The file of a unit's frozen step."""
        return self._folder / "accuracy" / f"{unit.problem_label()}.parquet"

    def done(self, unit: Unit, problem: str | None = None) -> bool:
        """Whether the rows are there as the config asks for them now, and are of this problem if one is given."""
        path = self.path(unit)
        if self._again or not shelf.there(path):
            return False
        there = rows.first(path, SCHEMA)
        if isinstance(there, str):
            return False
        return there["unit"] == unit.unit_id(self._machine) and problem in (None, there["problem"])

    def curves(self, group: Sequence[CurveUnit]) -> None:
        """The curves on one frozen step; then the step's own rows, since the curves may have found more minima."""
        first = group[0]
        try:
            graded = Graded.find(first.case, first.moment, self._store)
        except InputError:
            raise
        except Exception as error:  # no solver can be graded here; the other steps go on
            why = [lost(error) | {"kind": "curve"}]
            for unit in group:
                if not self.done(unit):
                    self._do(unit, str(first.moment), 1, lambda tick: why)
            return
        digest = graded.frozen.digest
        if self._moments.setdefault(digest, graded.moment) != graded.moment:
            return  # two moments of a scene may be one: its curves are there
        for unit in group:
            if not self.done(unit, digest):
                measured = partial(curve_rows, unit, graded, self._folder)
                self._do(unit, graded.moment, len(unit.first_guesses), measured)
        rows.write(
            self.problem_path(first), [{"sweep": self._name, "unit": digest} | row for row in graded.rows()], SCHEMA
        )

    def work(self, group: Sequence[WorkUnit]) -> None:
        """The simulations of one scene up to one horizon."""
        if all(self.done(unit) for unit in group):
            return
        trajectory = trajectory_of(group[0], self._store)
        for unit in group:
            if not self.done(unit):
                step = f"{unit.case.integrator} dt {unit.case.scene.time_step:.3g}"
                self._do(unit, step, unit.how.rounds, partial(work_rows, unit, trajectory))

    def _do(self, unit: Unit, what: str, ticks: int, measured: Callable[[Callable[[], None]], list[Row]]) -> None:
        """Measure a unit, which calls a function so many times on the way, and write its rows."""
        case = unit.case
        self._display.run(f"{case.title} {what} {unit.solver.name}", ticks, 1)
        found = measured(lambda: self._display.tick(what))
        shared = {
            "unit": unit.unit_id(self._machine),
            "sweep": self._name,
            "scene": case.scene_name,
            "size": case.size,
            "integrator": case.integrator,
            "time_step": case.scene.time_step,
            "solver": unit.solver.name,
            "parameters": json.dumps(dict(unit.solver.parameters), sort_keys=True),
            **stated(unit.solver.name),
            "threads": unit.how.threads,
            **provenance(),
        }
        rows.write(self.path(unit), [shared | row for row in found], SCHEMA)
        bad = next((row for row in found if row["status"] != "ok"), None)
        self._display.finished(f"{bad['status']}: {bad['reason']}" if bad else "ok")


def trajectory_of(unit: WorkUnit, store: Store) -> Trajectory | Exception:
    """The reference up to the unit's horizon, or why there is none; which errors it can tell, each row asks.

    Raises InputError.
    """
    try:
        return store.trajectory(unit.case.scene, unit.case.size, [unit.horizon], error=1.0)
    except InputError:
        raise
    except Exception as error:
        return error
