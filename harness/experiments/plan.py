"""Plan a sweep: find its complete and missing runs from their files.

Nothing is simulated or drawn.

A run is complete when its rows, its recording and its picture exist. Rows are written after the recording, and a
picture is drawn from the recording alone. The files therefore show what an interrupted command has left undone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.base import machine, shelf
from harness.config.sweep import RunSpec
from harness.experiments.code import code, parts
from harness.experiments.resume import DONE, MISSING, Standing
from harness.record.sound import whole_messages

if TYPE_CHECKING:
    import pyarrow as pa

NEEDED = ("run_id", "scene", "size", "solver", "status", "code")
"""Columns that are required to identify a run and its status."""

_TOLD = ("status", "code", "time_limit", "memory_limit")
"""Columns that determine the completion status."""

_LIMITED = ("failed", "time-limit", "killed")
"""Statuses of runs that ended because of their limits."""


@dataclass(frozen=True, slots=True)
class Files:
    """Paths of a run's files."""

    rows: Path
    recording: Path
    picture: Path

    @classmethod
    def of(cls, run: RunSpec, folder: Path, on: str | None = None) -> Files:
        """Return the paths of a run in the folder of its sweep.

        Args:
            run: the run.
            folder: folder of the sweep.
            on: machine that executes the run; this machine if None.
        """
        label = run.label(on or machine.describe().id)
        return cls(
            folder / "rows" / f"{label}.parquet",
            folder / "recordings" / f"{label}.rrd",
            folder / "pictures" / f"{label}.png",
        )

    def absolute(self) -> Files:
        """Return the files as absolute paths.

        A change of the working folder does not affect them.
        """
        return Files(self.rows.absolute(), self.recording.absolute(), self.picture.absolute())


@dataclass(frozen=True, slots=True)
class PlannedRun:
    """Run of a sweep, its files and its status (`harness.experiments.resume.Planned`)."""

    run: RunSpec
    files: Files
    standing: Standing

    @property
    def title(self) -> str:
        """Title of the run, for messages."""
        return self.run.title


def plan(runs: Iterable[RunSpec], folder: Path, machines: Sequence[str | None] = (None,)) -> list[PlannedRun]:
    """Return each run with its files and its completion status.

    Args:
        runs: the runs of the sweep.
        folder: folder of the sweep.
        machines: machines that may have executed the runs; None is this machine.
    """
    code_of = _codes()
    planned: list[PlannedRun] = []
    here = machine.describe().id
    placed = [(run, [Files.of(run, folder, on or here) for on in machines]) for run in runs]
    heads = _heads([files.rows for _, some in placed for files in some])
    for run, some in placed:
        files = next((files for files in some if files.rows in heads), some[0])
        state, older, damage = MISSING, False, ""
        there = heads.get(files.rows)
        if isinstance(there, str):
            damage = f"{files.rows} {there}"
        elif there is not None:
            state = DONE if there["status"] == "ok" else there["status"]
            limits = there["time_limit"], there["memory_limit"]
            if state in _LIMITED and limits != (run.time_limit, run.memory_limit):
                state = MISSING  # who failed within other limits has said nothing of these
            older = there["code"] != code_of(run)
        if state == DONE and run.record:
            damage = _unfit(files.recording)
            state = MISSING if damage or not files.recording.exists() else DONE
        planned.append(PlannedRun(run, files, Standing(state, older, damage)))
    return planned


def _heads(paths: Sequence[Path]) -> dict[Path, dict[str, Any] | str]:
    if not any(map(shelf.there, paths)):
        return {}
    from harness.base import rows  # brings pyarrow along

    return rows.heads(paths, _TOLD, needed=NEEDED)


def _unfit(recording: Path) -> str:
    """Return why a recording is damaged, without reading all of it.

    The result is empty if it is intact or missing.
    """
    if not recording.exists():
        return ""
    whole = recording.is_file() and whole_messages(recording)[0]
    return "" if whole else f"{recording} is cut before its end"


def _codes() -> Callable[[RunSpec], str]:
    """Return a function that computes source fingerprints, cached by the parts of a run."""
    of_parts = cache(code)
    return lambda run: of_parts(parts(run))


def of_other_code(runs: Iterable[RunSpec], table: pa.Table) -> set[str]:
    """Return the ids of the runs whose rows come from other source code."""
    code_of = _codes()
    here, made = machine.describe().id, dict(zip(*(table[c].to_pylist() for c in ("run_id", "code")), strict=True))
    return {name for run in runs if made.get(name := run.run_id(here)) != code_of(run)}
