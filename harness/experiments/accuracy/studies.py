"""Execute the missing units of an accuracy config.

Step snapshots come first, then curves on them, and simulations.

A unit is executed again if the config now requests it with other settings, or of another step snapshot.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from harness.base import holding, machine, rows
from harness.base.progress import Display, Effort
from harness.base.workers import Lost, Workers
from harness.config.accuracy import CurveSpec, WorkSpec
from harness.config.accuracy_load import Accuracy
from harness.experiments.accuracy.accuracy_rows import SCHEMA
from harness.experiments.accuracy.units import CurveUnit, Home, Row, StepsUnit, WorkUnit
from harness.experiments.core import TABLES, do_all, ready, require_threads, watched
from harness.experiments.resume import Standing, standings, wanted
from harness.reference.frozen import bind
from harness.reference.self_converged import told_once, touches


@dataclass(frozen=True, slots=True)
class _Planned:
    """Unit and its completion status (`harness.experiments.resume.Planned`)."""

    unit: CurveUnit | WorkUnit
    standing: Standing

    @property
    def title(self) -> str:
        return self.unit.title


def run_accuracy(
    accuracy: Accuracy,
    folder: Path,
    display: Display,
    say: Callable[[str], None],
    *,
    again: bool = False,
    changed: bool = False,
    isolated: bool = True,
) -> list[Path]:
    """Execute the missing units and return the files of all units and their step snapshots.

    Files of units that only an earlier version of the config requested stay in place, and are not returned.

    Args:
        accuracy: the accuracy config.
        folder: folder of its results; the reference solutions for all configs are stored next to it.
        display: shows progress.
        say: prints a remark.
        again: whether to repeat all units.
        changed: whether to repeat units measured by other source code.
        isolated: see `harness.experiments.core.do_all`.

    Raises:
        InputError: the input is invalid.
        CannotWrite: the rows cannot be written.
    """
    home = Home(accuracy.name, folder)
    for name, case in {spec.case.scene_name: spec.case for spec in reversed(accuracy.work)}.items():
        if touches(bind(case.scene, case.size).system):
            say(told_once(name))
    require_threads({spec.how.threads for spec in (*accuracy.curves, *accuracy.work)})
    (folder / "accuracy").mkdir(parents=True, exist_ok=True)
    with holding.alone(folder):
        do_all(_steps(accuracy.curves, home), display, isolated=isolated)  # quick where they were found before
        planned = _planned([*_curves(accuracy.curves, home), *_work(accuracy.work, home)], home)
        todo = wanted(planned, "units", say, again=again, changed=changed)
        do_all([p.unit for p in todo], display, isolated=isolated)
    paths = [home.rows(label) for p in planned for label in _labels(p.unit.spec)]
    return list(dict.fromkeys(paths))


@contextmanager
def measuring(work: Sequence[WorkSpec], folder: Path, display: Display) -> Generator[Callable[[WorkSpec], Row]]:
    """Yield a function that measures one simulation in a worker and returns its row.

    Args:
        work: the simulations that may be measured.
        folder: folder of the results, as in `run_accuracy`.
        display: shows progress.

    Raises:
        InputError: the input is invalid.
        CannotWrite: the rows cannot be written.
    """
    home = Home(folder.name, folder)
    require_threads({spec.how.threads for spec in work})
    (folder / "accuracy").mkdir(parents=True, exist_ok=True)
    workers = Workers(partial(ready, [dict(table) for table in TABLES]))

    def measure(spec: WorkSpec) -> Row:
        unit = WorkUnit(spec, home)
        run = display.run(unit.title, unit.ticks, unit.effort)
        try:
            outcome = workers.do(partial(watched, unit), run.tick, unit.limits)
        except Lost as lost:
            outcome = unit.lost(lost)
        run.finished(outcome)
        return rows.read([home.rows(spec.label())], SCHEMA).to_pylist()[0]

    with holding.alone(folder):
        # No run ends with this kind, so no remaining time is estimated: most of these are omitted in the end.
        display.begin([Effort("omitted")] * len(work))
        try:
            yield measure
        finally:
            workers.end()
            display.end()


def failures(files: Sequence[Path]) -> list[str]:
    """Return a line for each failed unit: scene, size, snapshot, solver and reason.

    Other statuses are results.
    """
    found = [rows.read([path], SCHEMA).to_pylist()[0] for path in files]
    return [
        f"{r['scene']} {r['size']} {r['moment'] or r['integrator']} {r['solver']}: {r['reason']}"
        for r in found
        if r["kind"] != "problem" and r["status"] in ("failed", "killed")
    ]


def _labels(spec: CurveSpec | WorkSpec) -> list[str]:
    return [spec.label(), spec.problem_label()] if isinstance(spec, CurveSpec) else [spec.label()]


def _steps(curves: Sequence[CurveSpec], home: Home) -> list[StepsUnit]:
    """Return one unit for each case."""
    moments: dict[str, CurveSpec] = {}
    for spec in curves:
        moments.setdefault(spec.problem_label(), spec)
    cases: dict[str, list[CurveSpec]] = {}
    for spec in moments.values():
        cases.setdefault(_case(spec), []).append(spec)
    return [StepsUnit(tuple(specs), home) for specs in cases.values()]


def _case(spec: CurveSpec) -> str:
    return f"{spec.case.scene_name} {spec.case.identity()}"


def _curves(curves: Sequence[CurveSpec], home: Home) -> Iterator[CurveUnit]:
    """Yield the units for the curves of each step.

    A step is used once where two snapshots of a case are one step.
    """
    paths = dict.fromkeys(home.rows(spec.problem_label()) for spec in curves)
    steps = rows.heads(paths, ("problem", "moment", "frame", "status", "reason"), SCHEMA)
    moments: dict[tuple[str, str], str] = {}
    for spec in curves:
        label = spec.problem_label()
        step = steps.get(home.rows(label))
        if isinstance(step, dict) and moments.setdefault((_case(spec), step["problem"] or label), label) == label:
            yield CurveUnit(spec, home, step)


def _work(work: Sequence[WorkSpec], home: Home) -> Iterator[WorkUnit]:
    for spec in sorted(work, key=lambda spec: (spec.case.scene_name, spec.case.size, spec.horizon)):
        yield WorkUnit(spec, home)


def _planned(units: Sequence[CurveUnit | WorkUnit], home: Home) -> list[_Planned]:
    """Return the units and whether their rows match the request and the current step snapshot."""
    here = machine.describe().id

    def as_asked(unit: CurveUnit | WorkUnit, row: Mapping[str, Any]) -> bool:
        of_step = not isinstance(unit, CurveUnit) or row["problem"] == unit.step["problem"]
        return of_step and row["unit"] == unit.spec.unit_id(here)

    asked = {home.rows(unit.spec.label()): partial(as_asked, unit) for unit in units}
    found = standings(asked, ("unit", "problem"), SCHEMA)
    return [_Planned(unit, found[home.rows(unit.spec.label())]) for unit in units]
