"""Step snapshots, curves and simulations as units of an accuracy config.

Each is a `springbench.harness.experiments.experiment_units.ExperimentUnit`. It writes a Parquet file under
`<folder>/accuracy` once the whole unit is measured.
"""

from __future__ import annotations

import json
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

from springbench.harness.config.accuracy_config import BenchmarkCase, CurveSpec, WorkSpec, format_snapshot
from springbench.harness.errors import InputError
from springbench.harness.execution import machine_info
from springbench.harness.execution.isolated_worker import ProgressCallback, TaskFailure, TaskLimits
from springbench.harness.execution.progress_display import UNIT_COST, RunCost
from springbench.harness.experiments.accuracy.accuracy_failures import build_accuracy_failure_columns
from springbench.harness.experiments.accuracy.accuracy_schema import ACCURACY_SCHEMA
from springbench.harness.experiments.accuracy.snapshot_rows import SnapshotEvaluation, build_curve_rows
from springbench.harness.experiments.accuracy.work_precision import build_option_columns, build_work_rows
from springbench.harness.experiments.provenance import build_provenance_columns
from springbench.harness.reference.reference_store import ReferenceStore
from springbench.harness.reference.reference_trajectory import ReferenceTrajectory
from springbench.harness.results import parquet_rows
from springbench.solvers.plugins.plugin_discovery import identify_plugins

ResultRow = dict[str, Any]

CONTACT_STUDY_ERROR = 0.01
"""Smallest relative error that a study with contact is to measure, if its reference is known well enough in time."""
EXTRA_WALL_SECONDS = 3600.0
"""Wall time in addition to the solver's limit, for compiling, scoring and finding minima [s]."""
WALL_TIME_FACTOR = 4.0
"""Wall time of a pass as a multiple of the solver's time limit, since iterates are scored meanwhile."""


@dataclass(frozen=True, slots=True)
class AccuracyResults:
    """Results of the config of this name.

    Reference solutions are stored next to them, for all configs.
    """

    name: str
    folder: Path

    @property
    def reference_store(self) -> ReferenceStore:
        """Store of the reference solutions."""
        return open_reference_store(self.folder.parent)

    def rows_path(self, label: str) -> Path:
        """Return the path of a file of rows."""
        return self.folder / "accuracy" / f"{label}.parquet"


def open_reference_store(results: Path) -> ReferenceStore:
    """Open the store of reference solutions for all configs in one folder of results."""
    return ReferenceStore(results / ".references")


@dataclass(frozen=True, slots=True)
class SnapshotUnit:
    """Unit that finds the step snapshots of a case, and their minima.

    Each of the specs names another snapshot. A snapshot that could not be found has one row, without a problem. A
    snapshot that equals another one has no row, so that the step is measured once.
    """

    curve_specs: tuple[CurveSpec, ...]
    results: AccuracyResults
    cost_estimate: RunCost = UNIT_COST

    @property
    def title(self) -> str:
        """Title of the unit, for messages."""
        return f"{self.curve_specs[0].case.title} {self.curve_specs[0].case.integrator}: step snapshots"

    @property
    def num_progress_steps(self) -> int:
        """Number of snapshots."""
        return len(self.curve_specs)

    @property
    def task_limits(self) -> TaskLimits:
        """Wall-time limit, proportional to the number of snapshots."""
        return TaskLimits(EXTRA_WALL_SECONDS * len(self.curve_specs))

    @property
    def user_code(self) -> frozenset[Hashable]:
        """Identity of the user code that the unit executes."""
        return identify_plugins(self.curve_specs[0].case.find_plugins())

    def execute_unit(self, tick: ProgressCallback) -> str:
        """Find the snapshots, write their rows and return the outcome as text."""
        messages: list[str] = []
        known: set[str] = set()
        for spec in self.curve_specs:
            path = self.results.rows_path(spec.build_problem_stem())
            try:
                step = _load_snapshot_evaluation(_ReferenceRequest.for_snapshot(spec, self.results))
                found = step.build_rows()
            except InputError:
                raise
            except Exception as error:  # no solver can be graded on this step; the other steps continue
                found = [_build_missing_snapshot_row(spec, build_accuracy_failure_columns(error))]
                messages.append(f"{spec.snapshot}: {found[0]['status']}: {found[0]['reason']}")
            else:
                if step.step_snapshot.digest in known:
                    continue
                known.add(step.step_snapshot.digest)
            _write_snapshot_rows(path, self.results, found)
            tick(str(spec.snapshot))
        return "; ".join(messages) or "ok"

    def write_lost_rows(self, task_loss: TaskFailure) -> str:
        """Write a row for each snapshot of a lost unit, and return a message."""
        why = {"status": task_loss.status, "reason": str(task_loss)}
        for spec in self.curve_specs:
            _write_snapshot_rows(
                self.results.rows_path(spec.build_problem_stem()),
                self.results,
                [_build_missing_snapshot_row(spec, why)],
            )
        return f"{task_loss.status}: {task_loss}"


def _build_missing_snapshot_row(spec: CurveSpec, failure_columns: ResultRow) -> ResultRow:
    """Build the row of a snapshot that could not be found."""
    return (
        failure_columns
        | {"kind": "snapshot", "snapshot": format_snapshot(spec.snapshot)}
        | _build_case_columns(spec.case)
        | build_provenance_columns()
    )


def _write_snapshot_rows(path: Path, results: AccuracyResults, result_rows: Sequence[ResultRow]) -> None:
    parquet_rows.write_rows(
        path,
        [{"sweep": results.name, "unit_id": row.get("problem_digest")} | row for row in result_rows],
        ACCURACY_SCHEMA,
    )


@dataclass(frozen=True, slots=True)
class CurveUnit:
    """Unit that measures the curves of one solver on one step.

    `snapshot_row` is the first row of the step's file.
    """

    spec: CurveSpec
    results: AccuracyResults
    snapshot_row: Mapping[str, Any]

    @property
    def cost_estimate(self) -> RunCost:
        """Cost of one unit; the solvers of a step take times of one magnitude."""
        return RunCost(self.spec.build_problem_stem())

    @property
    def title(self) -> str:
        """Title of the unit, for messages."""
        return f"{self.spec.case.title} {self.snapshot_row['snapshot']} {self.spec.solver.name}"

    @property
    def num_progress_steps(self) -> int:
        """Number of curves."""
        return len(self.spec.initial_guesses)

    @property
    def task_limits(self) -> TaskLimits:
        """Wall-time limit for all rounds of all curves."""
        how = self.spec.measurement
        return TaskLimits(
            EXTRA_WALL_SECONDS + WALL_TIME_FACTOR * how.time_limit * (how.rounds + 2) * self.num_progress_steps
        )

    @property
    def user_code(self) -> frozenset[Hashable]:
        """Identity of the user code that the unit executes."""
        return identify_plugins(self.spec.find_plugins())

    def execute_unit(self, tick: ProgressCallback) -> str:
        """Measure the curves, write their rows and return the outcome as text."""
        return _write_unit_rows(self.results, self.spec, self._measure_rows(tick))

    def write_lost_rows(self, task_loss: TaskFailure) -> str:
        """Write the rows of a lost unit, and return the outcome as text."""
        return _write_unit_rows(
            self.results, self.spec, self._build_failure_rows({"status": task_loss.status, "reason": str(task_loss)})
        )

    def _measure_rows(self, tick: ProgressCallback) -> list[ResultRow]:
        if self.snapshot_row["problem_digest"] is None:
            return self._build_failure_rows({key: self.snapshot_row[key] for key in ("status", "reason")})
        try:
            graded = _load_snapshot_evaluation(_ReferenceRequest.for_snapshot(self.spec, self.results))
        except InputError:
            raise
        except Exception as error:
            return self._build_failure_rows(build_accuracy_failure_columns(error))
        found = build_curve_rows(self.spec, graded, self.results.folder, lambda: tick(graded.snapshot_name))
        # The curves may have found more minima; the rows of the step are updated before those of its curves exist.
        _write_snapshot_rows(self.results.rows_path(self.spec.build_problem_stem()), self.results, graded.build_rows())
        return found

    def _build_failure_rows(self, failure_columns: ResultRow) -> list[ResultRow]:
        of_step = {key: self.snapshot_row[key] for key in ("problem_digest", "snapshot", "frame")}
        return [
            of_step | failure_columns | {"kind": "curve", "initial_guess": guess} for guess in self.spec.initial_guesses
        ]


_ITERATIONS_TO_TOLERANCE = 10
"""Estimated number of iterations of a step that is solved to a tolerance, independent of the limit."""


@dataclass(frozen=True, slots=True)
class WorkPrecisionUnit:
    """Unit that measures one simulation of a scene up to a horizon."""

    spec: WorkSpec
    results: AccuracyResults

    @property
    def cost_estimate(self) -> RunCost:
        """Estimated cost: vertices times steps times iterations."""
        case, options = self.spec.case, self.spec.options
        steps = self.spec.t_end / case.scene.time_step * self.spec.measurement.rounds
        iterations = options["max_iterations"] if options["rtol"] is None else _ITERATIONS_TO_TOLERANCE
        return RunCost(self.spec.solver.name, (case.size or 32) ** 2 * steps * iterations)

    @property
    def title(self) -> str:
        """Title of the unit, for messages."""
        case = self.spec.case
        return f"{case.title} {case.integrator} dt {case.scene.time_step:.3g} {self.spec.solver.name}"

    @property
    def num_progress_steps(self) -> int:
        """Number of rounds."""
        return self.spec.measurement.rounds

    @property
    def task_limits(self) -> TaskLimits:
        """Wall-time limit for all rounds."""
        return TaskLimits(
            EXTRA_WALL_SECONDS
            + WALL_TIME_FACTOR * self.spec.measurement.time_limit * (self.spec.measurement.rounds + 1)
        )

    @property
    def user_code(self) -> frozenset[Hashable]:
        """Identity of the user code that the unit executes."""
        return identify_plugins(self.spec.find_plugins())

    def execute_unit(self, tick: ProgressCallback) -> str:
        """Measure the simulation, write its row and return the outcome as text."""
        trajectory = _load_trajectory(_ReferenceRequest.for_trajectory(self.spec, self.results))
        return _write_unit_rows(self.results, self.spec, build_work_rows(self.spec, trajectory, lambda: tick("rounds")))

    def write_lost_rows(self, task_loss: TaskFailure) -> str:
        """Write the row of a lost unit, and return the outcome as text."""
        spec = self.spec
        row: ResultRow = {"kind": "work", "status": task_loss.status, "reason": str(task_loss), "t_end": spec.t_end}
        return _write_unit_rows(self.results, spec, [row | build_option_columns(spec)])


def _write_unit_rows(results: AccuracyResults, spec: CurveSpec | WorkSpec, result_rows: Sequence[ResultRow]) -> str:
    """Write measured rows with the common columns, and return the outcome as text."""
    shared = {
        "unit_id": spec.compute_unit_id(machine_info.describe_machine().machine_id),
        "sweep": results.name,
        **_build_case_columns(spec.case),
        "solver": spec.solver.name,
        "parameters": json.dumps(dict(spec.solver.parameters), sort_keys=True),
        **spec.solver.metadata_columns,
        "threads": spec.measurement.threads,
        **build_provenance_columns(spec.solver),
    }
    parquet_rows.write_rows(
        results.rows_path(spec.build_file_stem()), [shared | row for row in result_rows], ACCURACY_SCHEMA
    )
    bad = next((row for row in result_rows if row["status"] != "ok"), None)
    return f"{bad['status']}: {bad['reason']}" if bad else "ok"


def _build_case_columns(case: BenchmarkCase) -> ResultRow:
    return {
        "scene": case.scene_name,
        "size": case.size,
        "integrator": case.integrator,
        "time_step": case.scene.time_step,
    }


@dataclass(frozen=True, slots=True)
class _ReferenceRequest:
    """Cache key of a reference request, which is equal for consecutive units."""

    key: tuple[Any, ...]
    spec: Any = field(compare=False)
    reference_store: ReferenceStore = field(compare=False)

    @classmethod
    def for_snapshot(cls, spec: CurveSpec, results: AccuracyResults) -> _ReferenceRequest:
        return cls((spec.build_problem_stem(), results.folder), spec, results.reference_store)

    @classmethod
    def for_trajectory(cls, spec: WorkSpec, results: AccuracyResults) -> _ReferenceRequest:
        """Build the key of a trajectory, which is equal for all time steps."""
        return cls(
            (spec.case.scene.with_time_step(1.0).scene_digest, spec.case.size, spec.t_end, results.folder),
            spec,
            results.reference_store,
        )


@lru_cache(maxsize=1)
def _load_snapshot_evaluation(request: _ReferenceRequest) -> SnapshotEvaluation:
    return SnapshotEvaluation.load_snapshot(request.spec.case, request.spec.snapshot, request.reference_store)


@lru_cache(maxsize=1)
def _load_trajectory(request: _ReferenceRequest) -> ReferenceTrajectory | Exception:
    return load_reference_trajectory(request.spec, request.reference_store)


def load_reference_trajectory(spec: WorkSpec, reference_store: ReferenceStore) -> ReferenceTrajectory | Exception:
    """Return the reference trajectory up to a simulation's horizon, or the error that prevents it.

    The trajectory may be inaccurate: `build_work_rows` checks for each row whether it resolves the error.

    Args:
        spec: the simulation.
        reference_store: store of the reference solutions.

    Raises:
        InputError: the scene is invalid.
    """
    try:
        return reference_store.load_trajectory(
            spec.case.scene, spec.case.size, [spec.t_end], error=1.0, contact_error=CONTACT_STUDY_ERROR
        )
    except InputError:
        raise
    except Exception as error:
        return error
