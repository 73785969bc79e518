"""Step snapshots, curves and simulations as units of an accuracy config.

Each is a `harness.experiments.core.Unit`. It writes a Parquet file under `<folder>/accuracy` once
the whole unit is measured.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

from harness.base import machine, rows
from harness.base.errors import InputError
from harness.base.progress import ANY_EFFORT, Effort
from harness.base.workers import Limits, Lost, Tick
from harness.config.accuracy import Case, CurveSpec, WorkSpec, moment_name
from harness.experiments.accuracy.accuracy_rows import SCHEMA
from harness.experiments.accuracy.failures import lost as ended
from harness.experiments.accuracy.solves import GradedStep, curve_rows
from harness.experiments.accuracy.work import options, work_rows
from harness.experiments.provenance import provenance
from harness.reference.store import Store
from harness.reference.trajectory import Trajectory

Row = dict[str, Any]

PATIENCE = 3600.0
"""Wall time in addition to the solver's limit, for compiling, scoring and finding minima [s]."""
SHARE = 4.0
"""Wall time of a pass as a multiple of the solver's time limit, since iterates are scored meanwhile."""


@dataclass(frozen=True, slots=True)
class Home:
    """Results of the config of this name.

    Reference solutions are stored next to them, for all configs.
    """

    name: str
    folder: Path

    @property
    def store(self) -> Store:
        """Store of the reference solutions."""
        return references(self.folder.parent)

    def rows(self, label: str) -> Path:
        """Return the path of a file of rows."""
        return self.folder / "accuracy" / f"{label}.parquet"


def references(results: Path) -> Store:
    """Open the store of reference solutions for all configs in one folder of results."""
    return Store(results / ".references")


@dataclass(frozen=True, slots=True)
class StepsUnit:
    """Unit that finds the step snapshots of a case and their minima, one per spec.

    Specs differ in the snapshot.

    A snapshot that could not be found has one row, without a problem. A snapshot that equals another one has no row, so
    that the step is measured once.
    """

    specs: tuple[CurveSpec, ...]
    home: Home
    effort: Effort = ANY_EFFORT

    @property
    def title(self) -> str:
        """Title of the unit, for messages."""
        return f"{self.specs[0].case.title} {self.specs[0].case.integrator}: steps to freeze"

    @property
    def ticks(self) -> int:
        """Number of snapshots."""
        return len(self.specs)

    @property
    def limits(self) -> Limits:
        """Wall-time limit, proportional to the number of snapshots."""
        return Limits(PATIENCE * len(self.specs))

    def do(self, tick: Tick) -> str:
        """Find the snapshots, write their rows and return the outcome as text."""
        told: list[str] = []
        known: set[str] = set()
        for spec in self.specs:
            path = self.home.rows(spec.problem_label())
            try:
                step = _graded(_Asked.of(spec, self.home))
                found = step.rows()
            except InputError:
                raise
            except Exception as error:  # no solver can be graded here; the other steps go on
                found = [_unfound(spec, ended(error))]
                told.append(f"{spec.moment}: {found[0]['status']}: {found[0]['reason']}")
            else:
                if step.frozen.digest in known:
                    continue
                known.add(step.frozen.digest)
            _write_step(path, self.home, found)
            tick(str(spec.moment))
        return "; ".join(told) or "ok"

    def lost(self, lost: Lost) -> str:
        """Write a row for each snapshot of a lost unit, and return a message."""
        why = {"status": lost.status, "reason": str(lost)}
        for spec in self.specs:
            _write_step(self.home.rows(spec.problem_label()), self.home, [_unfound(spec, why)])
        return f"{lost.status}: {lost}"


def _unfound(spec: CurveSpec, why: Row) -> Row:
    """Build the row of a snapshot that could not be found."""
    return why | {"kind": "problem", "moment": moment_name(spec.moment)} | _of_case(spec.case) | provenance()


def _write_step(path: Path, home: Home, found: Sequence[Row]) -> None:
    rows.write(path, [{"sweep": home.name, "unit": row.get("problem")} | row for row in found], SCHEMA)


@dataclass(frozen=True, slots=True)
class CurveUnit:
    """Unit that measures the curves of one solver on one step.

    `step` is the first row of the step's file.
    """

    spec: CurveSpec
    home: Home
    step: Mapping[str, Any]
    effort: Effort = ANY_EFFORT

    @property
    def title(self) -> str:
        """Title of the unit, for messages."""
        return f"{self.spec.case.title} {self.step['moment']} {self.spec.solver.name}"

    @property
    def ticks(self) -> int:
        """Number of curves."""
        return len(self.spec.first_guesses)

    @property
    def limits(self) -> Limits:
        """Wall-time limit for all rounds of all curves."""
        how = self.spec.how
        return Limits(PATIENCE + SHARE * how.time_limit * (how.rounds + 2) * self.ticks)

    def do(self, tick: Tick) -> str:
        """Measure the curves, write their rows and return the outcome as text."""
        return _written(self.home, self.spec, self._measured(tick))

    def lost(self, lost: Lost) -> str:
        """Write the rows of a lost unit, and return the outcome as text."""
        return _written(self.home, self.spec, self._without({"status": lost.status, "reason": str(lost)}))

    def _measured(self, tick: Tick) -> list[Row]:
        if self.step["problem"] is None:
            return self._without({key: self.step[key] for key in ("status", "reason")})
        try:
            graded = _graded(_Asked.of(self.spec, self.home))
        except InputError:
            raise
        except Exception as error:
            return self._without(ended(error))
        found = curve_rows(self.spec, graded, self.home.folder, lambda: tick(graded.moment))
        # The curves may have found more minima; the rows of the step are updated before those of its curves exist.
        _write_step(self.home.rows(self.spec.problem_label()), self.home, graded.rows())
        return found

    def _without(self, why: Row) -> list[Row]:
        of_step = {key: self.step[key] for key in ("problem", "moment", "frame")}
        return [of_step | why | {"kind": "curve", "first_guess": guess} for guess in self.spec.first_guesses]


@dataclass(frozen=True, slots=True)
class WorkUnit:
    """Unit that measures one simulation of a scene up to a horizon."""

    spec: WorkSpec
    home: Home
    effort: Effort = ANY_EFFORT

    @property
    def title(self) -> str:
        """Title of the unit, for messages."""
        case = self.spec.case
        return f"{case.title} {case.integrator} dt {case.scene.time_step:.3g} {self.spec.solver.name}"

    @property
    def ticks(self) -> int:
        """Number of rounds."""
        return self.spec.how.rounds

    @property
    def limits(self) -> Limits:
        """Wall-time limit for all rounds."""
        return Limits(PATIENCE + SHARE * self.spec.how.time_limit * (self.spec.how.rounds + 1))

    def do(self, tick: Tick) -> str:
        """Measure the simulation, write its row and return the outcome as text."""
        trajectory = _trajectory(_Asked.of_motion(self.spec, self.home))
        return _written(self.home, self.spec, work_rows(self.spec, trajectory, lambda: tick("rounds")))

    def lost(self, lost: Lost) -> str:
        """Write the row of a lost unit, and return the outcome as text."""
        spec = self.spec
        row: Row = {"kind": "work", "status": lost.status, "reason": str(lost), "horizon": spec.horizon}
        return _written(self.home, spec, [row | options(spec)])


def _written(home: Home, spec: CurveSpec | WorkSpec, found: Sequence[Row]) -> str:
    """Write measured rows with the common columns, and return the outcome as text."""
    shared = {
        "unit": spec.unit_id(machine.describe().id),
        "sweep": home.name,
        **_of_case(spec.case),
        "solver": spec.solver.name,
        "parameters": json.dumps(dict(spec.solver.parameters), sort_keys=True),
        **spec.solver.columns,
        "threads": spec.how.threads,
        **provenance(spec.solver),
    }
    rows.write(home.rows(spec.label()), [shared | row for row in found], SCHEMA)
    bad = next((row for row in found if row["status"] != "ok"), None)
    return f"{bad['status']}: {bad['reason']}" if bad else "ok"


def _of_case(case: Case) -> Row:
    return {
        "scene": case.scene_name,
        "size": case.size,
        "integrator": case.integrator,
        "time_step": case.scene.time_step,
    }


@dataclass(frozen=True, slots=True)
class _Asked:
    """Cache key of a reference request, which is equal for consecutive units."""

    key: tuple[Any, ...]
    spec: Any = field(compare=False)
    store: Store = field(compare=False)

    @classmethod
    def of(cls, spec: CurveSpec, home: Home) -> _Asked:
        return cls((spec.problem_label(), home.folder), spec, home.store)

    @classmethod
    def of_motion(cls, spec: WorkSpec, home: Home) -> _Asked:
        """Build the key of a trajectory, which is equal for all time steps."""
        return cls((spec.case.scene.stepped(1.0).digest, spec.case.size, spec.horizon, home.folder), spec, home.store)


@lru_cache(maxsize=1)
def _graded(asked: _Asked) -> GradedStep:
    return GradedStep.find(asked.spec.case, asked.spec.moment, asked.store)


@lru_cache(maxsize=1)
def _trajectory(asked: _Asked) -> Trajectory | Exception:
    return trajectory_of(asked.spec, asked.store)


def trajectory_of(spec: WorkSpec, store: Store) -> Trajectory | Exception:
    """Return the reference trajectory up to a simulation's horizon, or the error that prevents it.

    Each row checks which errors the reference can resolve. Raises InputError.

    Args:
        spec: the simulation.
        store: store of the reference solutions.
    """
    try:
        return store.trajectory(spec.case.scene, spec.case.size, [spec.horizon], error=1.0)
    except InputError:
        raise
    except Exception as error:
        return error
