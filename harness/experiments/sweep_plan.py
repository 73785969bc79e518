"""Plan a sweep: find its complete and missing runs from their files.

Nothing is simulated or drawn. A run is complete when its rows exist, and its recording if it has one. Rows are written
after the recording, and a missing picture is drawn from the recording alone. The files therefore show what an
interrupted command has left undone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from springbench.harness.config.sweep_config import RunSpec
from springbench.harness.execution import machine_info
from springbench.harness.experiments.completion_status import COMPLETED, NOT_STARTED, CompletionStatus
from springbench.harness.experiments.provenance import collect_source_parts, compute_source_fingerprint
from springbench.harness.recording.recording_integrity import scan_messages
from springbench.harness.results import row_store

if TYPE_CHECKING:
    import pyarrow as pa

REQUIRED_COLUMNS = ("run_id", "scene", "size", "solver", "status", "source_fingerprint")
"""Columns that are required to identify a run and its status."""

_STATUS_COLUMNS = ("status", "source_fingerprint", "time_limit", "memory_limit")
"""Columns that determine the completion status."""

_LIMIT_STATUSES = ("failed", "time-limit", "killed")
"""Statuses of runs that ended because of their limits."""


@dataclass(frozen=True, slots=True)
class RunFiles:
    """Paths of a run's files."""

    rows_path: Path
    recording_path: Path
    picture_path: Path

    @classmethod
    def for_run(cls, run: RunSpec, folder: Path, machine_id: str | None = None) -> RunFiles:
        """Return the paths of a run in the folder of its sweep.

        Args:
            run: the run.
            folder: folder of the sweep.
            machine_id: machine that executes the run; this machine if None.
        """
        label = run.build_file_stem(machine_id or machine_info.describe_machine().machine_id)
        return cls(
            folder / "rows" / f"{label}.parquet",
            folder / "recordings" / f"{label}.rrd",
            folder / "pictures" / f"{label}.png",
        )

    @property
    def results_folder(self) -> Path:
        """Folder that contains the folder of each sweep."""
        return self.rows_path.parents[2]

    def to_absolute(self) -> RunFiles:
        """Return the files as absolute paths.

        A change of the working folder does not affect them.
        """
        return RunFiles(self.rows_path.absolute(), self.recording_path.absolute(), self.picture_path.absolute())


@dataclass(frozen=True, slots=True)
class PlannedRun:
    """Run of a sweep, its files and its status (`springbench.harness.experiments.completion_status.PlannedUnit`)."""

    run: RunSpec
    files: RunFiles
    completion_status: CompletionStatus

    @property
    def title(self) -> str:
        """Title of the run, for messages."""
        return self.run.title


def plan_runs(runs: Iterable[RunSpec], folder: Path, machine_ids: Sequence[str | None] = (None,)) -> list[PlannedRun]:
    """Return each run with its files and its completion status.

    Args:
        runs: the runs of the sweep.
        folder: folder of the sweep.
        machine_ids: machines that may have executed the runs; None is this machine.
    """
    code_of = _cached_fingerprint()
    planned: list[PlannedRun] = []
    here = machine_info.describe_machine().machine_id
    placed = [(run, [RunFiles.for_run(run, folder, on or here) for on in machine_ids]) for run in runs]
    heads = _read_row_heads([files.rows_path for _, some in placed for files in some])
    for run, some in placed:
        files = next((files for files in some if files.rows_path in heads), some[0])
        state, older, damage = NOT_STARTED, False, ""
        there = heads.get(files.rows_path)
        if isinstance(there, str):
            damage = f"{files.rows_path} {there}"
        elif there is not None:
            state = COMPLETED if there["status"] == "ok" else there["status"]
            limits = there["time_limit"], there["memory_limit"]
            if state in _LIMIT_STATUSES and limits != (run.time_limit, run.memory_limit):
                state = NOT_STARTED  # a failure within other limits is no result for these
            older = there["source_fingerprint"] != code_of(run)
        if state == COMPLETED and run.record:
            damage = _describe_damage(files.recording_path)
            state = NOT_STARTED if damage or not files.recording_path.exists() else COMPLETED
        planned.append(PlannedRun(run, files, CompletionStatus(state, older, damage)))
    return planned


def _read_row_heads(paths: Sequence[Path]) -> dict[Path, dict[str, Any] | str]:
    if not any(map(row_store.has_rows, paths)):
        return {}
    from springbench.harness.results import parquet_rows  # imports pyarrow

    return parquet_rows.read_first_rows(paths, _STATUS_COLUMNS, required_columns=REQUIRED_COLUMNS)


def _describe_damage(recording: Path) -> str:
    """Return why a recording is damaged, without reading all of it.

    The result is empty if it is intact or missing.
    """
    if not recording.exists():
        return ""
    whole = recording.is_file() and scan_messages(recording)[0]
    return "" if whole else f"{recording} is cut before its end"


def _cached_fingerprint() -> Callable[[RunSpec], str]:
    """Return a function that computes source fingerprints, cached by the parts of a run."""
    of_parts = cache(compute_source_fingerprint)
    return lambda run: of_parts(collect_source_parts(run))


def find_stale_run_ids(runs: Iterable[RunSpec], table: pa.Table) -> set[str]:
    """Return the ids of the runs whose rows come from other source code.

    Args:
        runs: planned runs; those without rows count as stale.
        table: rows with the columns `run_id` and `source_fingerprint`.
    """
    code_of = _cached_fingerprint()
    here, made = (
        machine_info.describe_machine().machine_id,
        dict(zip(*(table[c].to_pylist() for c in ("run_id", "source_fingerprint")), strict=True)),
    )
    return {name for run in runs if made.get(name := run.compute_run_id(here)) != code_of(run)}
